"""`companion team fly|check`: two flights in one world, from the command to the exit code."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

from companion.analysis.log import FlightLog
from companion.analysis.pair import BarTruth
from companion.analysis.pair_report import write_pair_report
from companion.launcher.team import BAR_FILE
from companion.model.codec import from_jsonable
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from tests.flights.test_px4 import REAL
from tests.support import PREFLIGHT, ROOT, Sandbox, hooked, read_summary, run_here, sandbox_in, set_options

TEAM = ROOT / "configs/teams/carry.yaml"
SHORT = {
    "mission.limits.speed_max_m_s": 1.2,
    "mission.limits.acceleration_max_m_s2": 2.0,
    "mission.limits.jerk_max_m_s3": 15.0,
    "mission.limits.arm_speed_max_deg_s": 180.0,
    "mission.limits.arm_acceleration_max_deg_s2": 400.0,
    "mission.limits.arm_jerk_max_deg_s3": 2000.0,
    "mission.phases[0].height_m": 0.6,
    "mission.phases[0].duration_s": 1.3,
    "mission.phases[1].lower_s": 0.9,
    "mission.phases[2].lift_m": 0.15,
    "mission.phases[2].lift_s": 1.4,
    "mission.phases[2].waypoints": [{"position_m": [-0.9, 0.0], "duration_s": 0.8}],
    "mission.phases[3].rise_m": 0.1,
    "mission.phases[3].rise_s": 0.8,
    "mission.phases[3].apart_m": 0.35,
    "mission.phases[3].apart_s": 1.4,
    "mission.phases[4].speed_m_s": 0.6,
    "left.mission.start.position_m": [-1.0, 1.25],
    "right.mission.start.position_m": [-1.0, -1.25],
}
"""The bar is lifted, moved by 0.1 m and set down. With a turn, and with what happens on the way: tests/sitl/test_pair.py."""
FAST = set_options(**{PREFLIGHT: 1.0, "vehicle.ground.mqtt": None}, **SHORT)
ENDS = ("left", "right")
INTERFACE = "vehicle.devices.mocap.interface=127.0.0.1"
FLY = ("team", "fly", TEAM, "--sitl", "--world", "ideal", "--speed", "max", "--out", "out", *FAST)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("team", "fly", TEAM, "--out", "out"), "expected --sitl; on hardware each vehicle flies its part"),
        (("team", "fly", TEAM, "--sitl", "px4", "--out", "out"), "unknown arguments: px4"),
        (
            ("team", "fly", TEAM, "--sitl=px5", "--out", "out"),
            "companion team fly: argument --sitl: expected --sitl, --sitl=stub or --sitl=px4, got 'px5'",
        ),
        (
            ("team", "fly", "carrry", "--sitl", "--out", "out"),
            "team carrry: expected carry or a file, found neither (did you mean carry?)",
        ),
        ((*FLY, "--real-time"), "--speed max: expected not together with --real-time"),
        (("team", "fly", TEAM, "--real-time"), "expected --sitl; on hardware each vehicle flies its part"),
        (("team", "fly", TEAM, "--sitl", "--out", " "), "--out: expected the name of a folder, got an empty one"),
        (
            (*FLY, "--set", "right.world.faults=[{kind: bus_delay, t_s: 1.0}]"),
            "right: world.faults: bus_delay: the servo bus takes no time in simulated time; add --real-time",
        ),
        (
            (*FLY, "--set", "vehicle.ground.foxglove=127.0.0.1:8765"),
            "both members have ground.foxglove 127.0.0.1:8765; give each a port of its own",
        ),
        (
            (*FLY, "--set", "left.mission.start.takeoff=by_operator"),
            "left: mission.start.takeoff is by_operator (--wait-for-start), but start could not be commanded",
        ),
        (
            ("fly", "carry", "--sitl", "--out", "out"),
            "this vehicle flies alone: fly a team file with `companion team fly`",
        ),
        (("fly", TEAM, "--member", "left", "--sitl", "--out", "out"), "in the simulated world both fly"),
        (
            (
                "fly",
                TEAM,
                "--member",
                "left",
                "--out",
                "out",
                "--set",
                INTERFACE,
                "--set",
                "vehicle.devices.team.key_file=k",
            ),
            "devices.team.partner: missing; expected the IPv4 address of the other vehicle's computer",
        ),
        (
            ("check", TEAM, "--member", "right", "--set", INTERFACE, "--set", "vehicle.devices.team.partner=127.0.0.2"),
            "devices.team.key_file: missing; expected the file of the key",
        ),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[object, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = run_here(*arguments)
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1 and said in ended.err_lines[0], ended.err
    assert not list(tmp_path.iterdir())


def test_on_the_vehicle_a_member_flies_its_own_end(sandbox: Sandbox) -> None:
    """Nothing answers there: the flight is refused, with the member's configuration in its folder."""
    (sandbox.cwd / "team.key").write_bytes(bytes(range(32)))
    here = {"server": "127.0.0.1", "interface": "127.0.0.1", "transport": "unicast", "command_port": 9}
    link = {"vehicle.devices.team.partner": "127.0.0.1", "vehicle.devices.team.key_file": "team.key"}
    options = set_options(**{f"vehicle.devices.mocap.{key}": value for key, value in here.items()}, **link)
    ended = sandbox.run("fly", TEAM, "--member", "right", "--out", "out", *options)
    assert ended.code != EXIT_BAD_INPUT, ended
    config = json.loads((sandbox.cwd / "out/config.json").read_text(encoding="utf-8"))
    assert config["vehicle"]["devices"]["mocap"]["rigid_body_id"] == 2
    assert [phase["end"] for phase in config["mission"]["phases"] if phase["type"] == "grip"] == ["right"]


def test_the_files_are_checked_without_a_flight() -> None:
    ended = run_here("team", "check", TEAM)
    assert (ended.code, ended.err) == (EXIT_OK, "")
    assert "both members can fly mission 'carry' together" in ended.out


@pytest.mark.parametrize("autopilots", ["--sitl", pytest.param("--sitl=px4", marks=REAL)], ids=["stubs", "px4"])
def test_a_team_carries_its_bar_over_wires(sandbox: Sandbox, autopilots: str) -> None:
    ended = sandbox.run(*FLY[:3], autopilots, *FLY[4:], "--no-report", "--seed", "1")
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_OK, ended
    assert "landing commanded" not in ended.out, "the one that is ready first asks nothing of the other"
    summary = summary_in(sandbox.cwd / "out")
    assert summary["outcome"] == "completed"
    assert {end: member["outcome"] for end, member in summary["members"].items()} == {
        "left": "completed",
        "right": "completed",
    }
    team = summary["team"]
    assert 0.0 < team["bar_p_rms_m"] < 0.1
    assert 0.0 < team["bar_tilt_rms_deg"] < 5.0
    assert 0.0 < team["internal_force_rms_n"] < 10.0
    assert 0.3 < team["share"] < 0.7
    assert team["let_go"] < 0.1
    for end in ENDS:
        for name in ("flight.mcap", "summary.json", "flight.log", "guardian.log"):
            assert (sandbox.cwd / "out" / end / name).exists()
    assert (sandbox.cwd / "out/team.key").stat().st_mode & 0o077 == 0
    assert_the_report_shows_both(sandbox.cwd / "out", summary)


def assert_the_report_shows_both(out: Path, summary: dict[str, Any]) -> None:
    truth = from_jsonable(BarTruth, json.loads((out / "left" / BAR_FILE).read_text(encoding="utf-8")))
    left, right = (FlightLog.read(out / end / "flight.mcap") for end in ("left", "right"))
    page = write_pair_report(summary, truth, left, right, out).read_text(encoding="utf-8")
    assert f"{1e3 * summary['team']['bar_p_rms_m']:.2f} mm RMS" in page
    assert 'href="left/report.html"' not in page, "it was not written"
    movie = json.loads(page.split("id='movie'>")[1].split("</script>")[0])
    vehicles = [[shape for shape in frame[1:] if len(shape) > 20] for frame in movie["frames"]]
    assert len(movie["frames"]) > 50 and all(vehicles)
    assert [len(curve) > 50 for curve in movie["curves"]] == [True, True]
    assert (out / "bar.png").stat().st_size > 10_000


def summary_in(out: Path) -> dict[str, Any]:
    """The summary of both, and of each in it as it stands in the member's folder."""
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["members"] == {end: read_summary(out / end) for end in ENDS}
    return summary


def test_a_member_whose_flight_process_dies_is_landed_by_its_guardian_and_the_other_one_by_ctrl_c(
    tmp_path: Path,
) -> None:
    """It dies of an error in the core. The other one hears the guardian until it ends: tests/io/test_team_link.py. Killed while they
    carry, it lands both: tests/sitl/test_pair.py.
    """
    (tmp_path / "sitecustomize.py").write_text(_RIGHT_BREAKS, encoding="utf-8")
    with sandbox_in(tmp_path / "sandbox", hooked(tmp_path)) as sandbox:
        with sandbox.start(*FLY, "--no-report") as running:
            running.wait_for("the guardian has taken over")
            running.signal(signal.SIGINT)
            ended = running.end()
        sandbox.assert_nobody_left()
        summary = summary_in(sandbox.cwd / "out")
        written = (sandbox.cwd / "out/right/flight.log").read_text(encoding="utf-8")
    assert {end: member["outcome"] for end, member in summary["members"].items()} == {
        "left": "aborted",
        "right": "aborted",
    }
    assert ended.code == EXIT_ABORTED
    died = "right: flight: the flight process ended with exit code 70 (ZeroDivisionError: a bug); the guardian landed the vehicle"
    assert died in ended.err
    assert "Traceback" in written
    assert summary["members"]["right"]["events"][-1]["id"] == "guardian_landed"


_RIGHT_BREAKS = """
import sys

if "companion.flight.main" in sys.orig_argv and "out/right" in " ".join(sys.orig_argv):
    import companion.core.flight_core

    class Breaking(companion.core.flight_core.FlightCore):
        def step(self, inputs):
            outputs = super().step(inputs)
            if outputs.mission_t_s > 0.3:
                raise ZeroDivisionError("a bug")
            return outputs

    companion.core.flight_core.FlightCore = Breaking
"""


def test_a_member_that_is_refused_keeps_the_other_on_the_ground(sandbox: Sandbox) -> None:
    text = TEAM.read_text(encoding="utf-8").replace("../missions", str(ROOT / "configs/missions"))
    (sandbox.cwd / "flat.yaml").write_text(f"{text}      world.battery_start: 0.05\n", encoding="utf-8")
    ended = sandbox.run("team", "fly", "flat.yaml", *FLY[3:], "--no-report")
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_REFUSED
    assert "right: battery: 5%" in ended.err
    members = summary_in(sandbox.cwd / "out")["members"]
    assert (members["left"]["outcome"], members["right"]["outcome"]) == ("aborted", "refused")
    assert not {"armed", "takeoff"} & {event["id"] for event in members["left"]["events"]}


def test_without_its_world_a_team_is_lost_and_nothing_is_left(sandbox: Sandbox) -> None:
    with sandbox.start(*FLY, "--no-report") as running:
        running.wait_for("wait\n")
        os.kill(sandbox.pid_of("sitl"), signal.SIGKILL)
        ended = running.end()
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_LOST
    lines = [f"{end}: sitl: the simulated world was ended by SIGKILL; see out/left/sitl.log" for end in ENDS]
    assert ended.err_lines == lines
    assert summary_in(sandbox.cwd / "out")["outcome"] == "lost"
    for end in ENDS:
        assert FlightLog.read(sandbox.cwd / "out" / end / "flight.mcap").closed
