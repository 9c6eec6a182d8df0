"""The same flights on the stub and on a real PX4 (SITL): one file for both. The real one: `PX4_SITL=... pytest -m px4`."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from companion.analysis.log import FlightLog
from companion.config.loader import load_flight
from companion.launcher.sitl_process import PX4_FOLDER
from companion.model.exit_codes import EXIT_ABORTED, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from companion.model.types import AutopilotRequest, PhaseKind
from companion.safety.stop import StopModel
from sitl.px4.process import MODEL, VARIABLE, Instance, find
from tests.support import (
    CATCH,
    DEADLINE_S,
    HOVER,
    HOVERS_S,
    SHORT_CATCH,
    Ended,
    Sandbox,
    read_summary,
    sandbox_in,
    set_options,
)

REAL = [
    pytest.mark.px4,
    pytest.mark.skipif(
        not os.environ.get(VARIABLE), reason=f"{VARIABLE} names no real PX4: the px4 binary or the folder of its build"
    ),
]
E_P_MAX_M = 0.02
"""After the catch of 0.2 kg; measured: 7 mm on the stub, 9 to 13 mm on PX4 1.16.1."""
E_Q_MAX_DEG = 2.0
LINE_TO_THE_WALL = (
    "mission.catch=null",
    "mission.limits.speed_max_m_s=1.2",
    "mission.limits.acceleration_max_m_s2=1.2",
    "mission.phases=[{type: takeoff, height_m: 1.0, duration_s: 3.0}, "
    "{type: line, to_m: [1.5, 0, 1.0], duration_s: 6.7}, {type: land, speed_m_s: 0.35}]",
)
"""Rotors 0.25 m from the wall at its end; 0.1 s less and the mission check refuses it."""
NEAREST_STOP_S = 10.1
"""After arming, on that line: the predicted stop is nearest to the wall."""
ENDED = {
    "kill_flight": "flight: the flight process was ended by SIGKILL",
    "stop_flight": "flight: the flight process hung and was killed",
    "hold_gil": "flight: the flight process hung and was killed",
}
GUARDIAN_LANDS = ["guardian_land", "guardian_touchdown", "guardian_landed"]
STOPPED_WITHIN_S = 2.5
"""After a flip was certain, as the flight process hears it: a heartbeat comes once a second, a lost command again after 0.5 s."""
LANDED_M = 0.4
"""Of the body's origin, which stands 0.3 m high."""


def faults(*kinds: str) -> pytest.MarkDecorator:
    """Every fault on the real PX4. On the stub one of them, since its guardian is the same in every test: test_lockstep.py."""
    return pytest.mark.parametrize(("autopilot", "kind"), [pytest.param("px4", kind, marks=REAL) for kind in kinds])


def event_ids(summary: dict[str, Any]) -> list[str]:
    return [event["id"] for event in summary["events"]]


def witness(sandbox: Sandbox) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((sandbox.cwd / "out/world.json").read_text())
    return read


def assert_landed_where_it_was(sandbox: Sandbox) -> None:
    """The world's own word: on its feet, rotors off, not far from where the fault met it."""
    world = witness(sandbox)
    assert not world["crashed"]
    assert not world["armed"]
    (_, (x0, y0, _), *_), (_, (x1, y1, z1), *_) = world["course"][0], world["course"][-1]
    assert z1 < LANDED_M
    assert abs(x1 - x0) < 1.0 and abs(y1 - y0) < 0.5
    assert world["modes"][-1][2] is False
    assert "LAND" in [mode for _, mode, _ in world["modes"]]


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])  # the stub's: test_ground_commands.py
def test_the_catch(sandbox: Sandbox, autopilot: str) -> None:
    ended = sandbox.run("fly", CATCH, f"--sitl={autopilot}", "--out", "out")
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_OK, (ended.out, ended.err)
    summary = read_summary(sandbox.cwd / "out")
    assert summary["autopilot"]["kind"] == autopilot
    assert re.fullmatch(r"1\.\d+(\.\d+)?", summary["autopilot"]["version"])
    assert [event for event in event_ids(summary) if event in {"takeoff", "catch"}] == ["takeoff", "catch"]
    assert summary["rms"]["post"]["e_p_m"] < E_P_MAX_M
    assert summary["rms"]["post"]["e_q_deg"] < E_Q_MAX_DEG


@faults("kill_flight", "stop_flight")
def test_the_guardian_lands_after_the_catch(sandbox: Sandbox, autopilot: str, kind: str) -> None:
    fault = f"world.faults=[{{kind: {kind}, after: catch, t_s: 0.1}}]"
    ended = sandbox.run("fly", SHORT_CATCH, f"--sitl={autopilot}", "--out", "out", "--set", fault)
    sandbox.assert_nobody_left()
    assert_landed_by_the_guardian(sandbox, ended, kind)


def assert_landed_by_the_guardian(sandbox: Sandbox, ended: Ended, kind: str) -> None:
    out = sandbox.cwd / "out"
    assert not list(out.glob("tmp*")), "temporary files of the killed flight process"
    assert ended.code == EXIT_ABORTED, (ended.out, ended.err)
    assert len(ended.err_lines) == 1, ended.err
    assert ended.err.startswith(ENDED[kind]) and "; the guardian landed the vehicle; see out/flight.log" in ended.err
    summary = read_summary(out)
    assert summary["outcome"] == "aborted"
    events = [event for event in summary["events"] if event["id"].startswith("guardian")]
    assert [event["id"] for event in events] == ["guardian_took_over", *GUARDIAN_LANDS] == event_ids(summary)[-4:]
    assert events == sorted(events, key=lambda event: float(event["t_s"]))
    assert_landed_where_it_was(sandbox)
    assert_log_reaches_the_take_over(sandbox)
    assert_stopped_as_modelled(sandbox, kind)


@faults("kill_flight", "stop_flight")
def test_the_guardian_stops_before_the_wall(sandbox: Sandbox, autopilot: str, kind: str) -> None:
    """The fastest line to the wall that the mission check accepts, and the fault where the predicted stop is nearest to it."""
    fault = f"world.faults=[{{kind: {kind}, t_s: {NEAREST_STOP_S}}}]"
    ended = sandbox.run("fly", CATCH, f"--sitl={autopilot}", "--out", "out", "--set", *LINE_TO_THE_WALL, fault)
    assert ended.code == EXIT_ABORTED, (ended.out, ended.err)
    assert_stopped_as_modelled(sandbox, kind)
    vehicle = load_flight(HOVER).vehicle
    reach_m = max(x for _, (x, _, _), *_ in witness(sandbox)["course"]) + vehicle.airframe.radius_m
    assert reach_m <= vehicle.room.x_m[1]


def assert_stopped_as_modelled(sandbox: Sandbox, kind: str) -> None:
    """It drifts no farther than the stop model says for its speed when the fault began."""
    seen = witness(sandbox)
    fault = seen["flight_fault"]
    assert fault["kind"] == kind
    times_s = [t_s for t_s, *_ in seen["course"]]
    drifts_m = [math.dist(seen["course"][0][1][:2], position[:2]) for _, position, *_ in seen["course"]]
    speed_m_s = drifts_m[1] / (times_s[1] - times_s[0])
    assert speed_m_s > 0.3
    safety = load_flight(HOVER).vehicle.safety
    assert max(drifts_m) <= StopModel(safety).distance_m(speed_m_s)
    assert fault["worst_tilt_deg"] < 30.0


@faults("kill_flight", "hold_gil")
def test_with_setpoints_straight_onto_the_link_the_guardian_lands_as_well(
    sandbox: Sandbox, autopilot: str, kind: str
) -> None:
    """The other setpoint path, without MAVSDK's Offboard plugin."""
    fault = f"world.faults=[{{kind: {kind}, after: catch, t_s: 0.1}}]"
    path = "vehicle.devices.autopilot.setpoint_path=direct"
    ended = sandbox.run("fly", SHORT_CATCH, f"--sitl={autopilot}", "--out", "out", "--set", fault, path)
    sandbox.assert_nobody_left()
    assert_landed_by_the_guardian(sandbox, ended, kind)


def assert_log_reaches_the_take_over(sandbox: Sandbox) -> None:
    """Closed in order by the recorder, which outlives the flight process, and whole up to its end."""
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert log.closed
    assert log.missing_ticks() == 0
    assert log.outputs[-1].phase_kind is PhaseKind.FLIGHT
    [took_over] = [e for e in read_summary(sandbox.cwd / "out")["events"] if e["id"] == "guardian_took_over"]
    assert took_over["t_s"] - log.outputs[-1].t_s < 0.5
    with open(sandbox.cwd / "out/flight.mcap", "rb") as file:
        lines = b"".join(message.data for _, _, message in make_reader(file).iter_messages(topics=["/log"]))
    assert b"guardian_landed" in lines, "the log goes on to the end"


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])  # the stub's: in the fast loop
def test_motion_capture_that_comes_back_too_late_is_a_landing(sandbox: Sandbox, autopilot: str) -> None:
    fault = "world.faults=[{kind: mocap_loss, after: catch, t_s: 0.1, duration_s: 2.0}]"
    ended = sandbox.run("fly", SHORT_CATCH, f"--sitl={autopilot}", "--out", "out", "--set", fault)
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_ABORTED, (ended.out, ended.err)
    assert "mocap_lost" in event_ids(read_summary(sandbox.cwd / "out"))
    assert_landed_where_it_was(sandbox)


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])  # the stub's: in the fast loop
def test_a_dead_link_is_landed_by_px4_itself(sandbox: Sandbox, autopilot: str) -> None:
    """Nothing gets through: the offboard-loss failsafe."""
    fault = f"world.faults=[{{kind: link_loss, t_s: {HOVERS_S}}}]"
    ended = sandbox.run("fly", HOVER, f"--sitl={autopilot}", "--out", "out", "--set", fault)
    sandbox.assert_nobody_left()
    assert ended.code in (EXIT_ABORTED, EXIT_LOST), (ended.out, ended.err)  # PX4 lands without vision here
    world = witness(sandbox)
    assert "LAND" in [mode for _, mode, _ in world["modes"]]
    assert not world["armed"]


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])  # the stub's: test_tipped_over.py
def test_a_rotor_lost_in_the_air_is_a_flip_and_the_others_are_stopped(sandbox: Sandbox, autopilot: str) -> None:
    """LAND comes first and does not help: PX4 refuses a plain DISARM in the air, and its rotors went on in the wreck."""
    fault = "world.faults=[{kind: motor_weak, size: 1.0, t_s: 7.0}]"
    # High enough to turn over before it is down.
    high = set_options(**{"mission.phases[0].height_m": 1.6, "mission.phases[0].duration_s": 5.0})
    ended = sandbox.run("fly", HOVER, f"--sitl={autopilot}", "--out", "out", "--set", fault, *high)
    sandbox.assert_nobody_left()
    assert ended.code == EXIT_LOST, (ended.out, ended.err)
    summary = read_summary(sandbox.cwd / "out")
    ids = event_ids(summary)
    assert ids.index("tilt") < ids.index("crashed")
    assert "guardian_took_over" not in ids
    assert not witness(sandbox)["armed"]
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    [flipped] = [event for event in summary["events"] if event["id"] == "crashed"]
    stopped_s = next(
        i.t_s for i in log.inputs if i.t_s > flipped["t_s"] and i.status is not None and not i.status.armed
    )
    assert stopped_s - flipped["t_s"] < STOPPED_WITHIN_S
    assert AutopilotRequest.DISARM not in {o.request for o in log.outputs}


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])  # the stub's: test_ladder_flights.py
def test_a_pilot_who_takes_over_after_touch_down_is_not_disarmed(sandbox: Sandbox, autopilot: str) -> None:
    """PX4's land detector takes its time, and in the middle of that the pilot switches to Hold: FORCE_DISARM left all the same."""
    slow = ("--set", "world.px4_params={LNDMC_TRIG_TIME: 5.0}")
    fault = "world.faults=[{kind: pilot_takeover, t_s: 8.5, size: 3.0}]"
    ended = sandbox.run("fly", HOVER, f"--sitl={autopilot}", "--out", "out", *slow, "--set", fault)
    sandbox.assert_nobody_left()
    if ended.code == EXIT_REFUSED and "LNDMC_TRIG_TIME" in ended.err:
        pytest.skip("PX4 1.18 has no LNDMC_TRIG_TIME: its land detector always takes 1 s")
    assert ended.code == EXIT_ABORTED, (ended.out, ended.err)
    ids = event_ids(read_summary(sandbox.cwd / "out"))
    assert ids.index("touchdown") < ids.index("pilot_took_over")
    log = FlightLog.read(sandbox.cwd / "out/flight.mcap")
    assert not {o.request for o in log.outputs} & {AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM}
    assert not witness(sandbox)["crashed"]


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])
def test_a_px4_that_dies_in_the_air_is_one_clear_line(sandbox: Sandbox, autopilot: str) -> None:
    with sandbox.start("fly", HOVER, f"--sitl={autopilot}", "--out", "out") as running:
        running.wait_for("take-off")
        px4 = [pid for pid, command in sandbox.survivors().items() if "init.d-posix/rcS" in command]
        assert len(px4) == 1
        os.kill(px4[0], signal.SIGKILL)
        ended = running.end()
    sandbox.assert_nobody_left()
    assert ended.code != EXIT_OK
    log = sandbox.cwd / "out" / PX4_FOLDER / "px4.log"
    assert re.search(rf"PX4: px4 -i \d was ended by SIGKILL; see {re.escape(str(log))}", ended.err), ended.err


def test_without_a_px4_the_flight_is_refused_within_seconds_with_how_to_get_one(tmp_path: Path) -> None:
    nowhere = {VARIABLE: "", "PATH": str(tmp_path)}
    with sandbox_in(tmp_path / "sandbox", nowhere) as sandbox:
        ended = sandbox.run("fly", HOVER, "--sitl=px4", "--out", "out")
        sandbox.assert_nobody_left()
    assert "waiting up to 10 s on TCP 456" in ended.out
    waiting = ended.out.partition("started by hand")[2]
    assert "same folder, because PX4 stores its parameters there" in waiting
    # Beside a PX4 that another program runs, instance 0 is taken.
    assert "make px4_sitl_default none" in waiting or re.search(r"none_iris px4 -i [1-9]", waiting)
    assert ended.code == EXIT_REFUSED, (ended.out, ended.err)
    assert len(ended.err_lines) == 1, ended.err
    for said in (
        "within 10 s, found no connection",
        "PX4_SITL",
        "none_iris px4 -i ",
        "same folder",
        "px4_sitl_default none",
    ):
        assert said in ended.err


_OLD_WORLD = """
import sys

if "sitl" in sys.orig_argv:
    from sitl.px4.hil_link import SimulatorLink

    send = SimulatorLink.send
    SimulatorLink.send = lambda self, imu, *rest: send(self, imu._replace(t_s=imu.t_s + 1000.0), *rest)
"""
"""The world's clock as a PX4 finds it that comes 1000 s late."""


@contextlib.contextmanager
def px4_by_hand(number: int, rootfs: Path) -> Iterator[subprocess.Popen[bytes]]:
    """As a person starts it, in a folder of its own."""
    installation = find()
    assert installation is not None
    rootfs.mkdir(exist_ok=True)
    command = [str(installation.binary), "-i", str(number), "-d", str(installation.etc)]
    environment = {**os.environ, "PX4_SIM_MODEL": MODEL}
    with (
        open(rootfs / "px4.txt", "ab") as said,
        subprocess.Popen(command, cwd=rootfs, env=environment, stdin=subprocess.DEVNULL, stdout=said) as process,
    ):
        try:
            yield process
        finally:
            process.kill()
            for left in (f"/tmp/px4_lock-{number}", f"/tmp/px4-sock-{number}"):
                Path(left).unlink(missing_ok=True)


@pytest.mark.parametrize("autopilot", [pytest.param("px4", marks=REAL)])
def test_a_px4_started_by_hand_that_comes_late_flies(tmp_path: Path, autopilot: str) -> None:
    """Ended when the world asks for it, started once more in the same folder."""
    (tmp_path / "sitecustomize.py").write_text(_OLD_WORLD, encoding="utf-8")
    by_hand = {
        VARIABLE: "",
        "PATH": str(tmp_path / "empty"),
        "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}",
    }
    with Instance.claim() as free:
        number = free.number  # the world will find the same
    with sandbox_in(tmp_path / "sandbox", by_hand) as sandbox:
        with sandbox.start("fly", HOVER, f"--sitl={autopilot}", "--out", "out") as running:
            running.wait_for(f"on TCP 456{number} for a PX4")
            with px4_by_hand(number, tmp_path / "rootfs") as px4:
                running.wait_for("start it again in the same folder")
                px4.terminate()
                px4.wait(DEADLINE_S)
            with px4_by_hand(number, tmp_path / "rootfs"):
                ended = running.end()
                again = sandbox.run("fly", HOVER, f"--sitl={autopilot}", "--out", "again")
        sandbox.assert_nobody_left()
    assert ended.code == EXIT_OK, (ended.out, ended.err)
    assert again.code == EXIT_REFUSED and len(again.err_lines) == 1, (again.out, again.err)
    assert f"instance {number} runs without a simulator: one that has flown must be started again" in again.err
    assert f"start it with `PX4_SIM_MODEL={MODEL} px4 -i {number}`" in again.err


def test_a_name_that_is_no_px4_refuses_the_flight_in_one_line(tmp_path: Path) -> None:
    with sandbox_in(tmp_path / "sandbox", {VARIABLE: str(tmp_path / "nowhere")}) as sandbox:
        ended = sandbox.run("fly", HOVER, "--sitl=px4", "--out", "out")
        sandbox.assert_nobody_left()
    assert ended.code == EXIT_REFUSED
    assert len(ended.err_lines) == 1, ended.err
    assert ended.err.startswith(f"sitl: {VARIABLE}=")
