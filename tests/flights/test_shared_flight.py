"""One flight over wires at which several tests look: a vehicle without force sensor, tether and net, whose poses another program sends
to PX4, flown by a law of another package, whose guardian dies in the air, whose terminal goes away then, and whose first request to
disarm is lost.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from tests.plugins.installed import on_path, write_distribution
from tests.support import HOVER, ROOT, Ended, Sandbox, hooked, read_summary, run_here, sandbox_in, set_options


@dataclass(frozen=True)
class Flown:
    """The one flight of this file, after it has ended."""

    sandbox: Sandbox
    site: Path
    """Where the law of another package is installed."""
    ended: Ended
    disarms: int
    """Requests to disarm that PX4 has received."""

    @property
    def events(self) -> list[str]:
        return [event["id"] for event in read_summary(self.sandbox.cwd / "out")["events"]]

    @property
    def log(self) -> FlightLog:
        return FlightLog.read(self.sandbox.cwd / "out/flight.mcap")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    folder = tmp_path_factory.mktemp("shared")
    # The example as pip installs it: tests/plugins/test_example.py.
    site = folder / "site"
    shutil.copytree(ROOT / "examples/law/lab_lqr", site / "lab_lqr", ignore=shutil.ignore_patterns("__pycache__"))
    write_distribution(site, "lab-lqr", "0.1.0", {"lqr": "lab_lqr:LqrLaw"})
    disarms = folder / "disarms"
    (site / "sitecustomize.py").write_text(_DEAF_ONCE.format(file=str(disarms)), encoding="utf-8")
    absent = set_options(**{"vehicle.devices.force": None, "vehicle.tether": None, "vehicle.tool": None})
    external = ("--set", "vehicle.devices.mocap.type=external")
    with sandbox_in(folder / "sandbox", hooked(site)) as sandbox:
        with sandbox.start(
            "fly", HOVER, "--sitl", "--controller", "lqr", "--out", "out", *absent, *external
        ) as running:
            running.wait_for("  take-off\n")
            os.kill(int((sandbox.cwd / "out/guardian.pid").read_text()), signal.SIGKILL)
            running.close_output()
            ended = running.end()
        sandbox.assert_nobody_left()
        yield Flown(sandbox, site, ended, int(disarms.read_text(encoding="utf-8")))


def test_a_guardian_that_dies_in_the_air_is_reported_and_the_flight_goes_on(flown: Flown) -> None:
    """Nobody reads standard output any more."""
    assert flown.ended.code == EXIT_OK, flown.ended
    assert flown.ended.err_lines == ["guardian: the guardian process was ended by SIGKILL; see out/guardian.log"]
    assert "guardian_lost" in flown.events


def test_a_lost_request_to_disarm_is_made_again_and_the_flight_ends_disarmed(flown: Flown) -> None:
    """It leaves as one datagram, which may be lost."""
    assert flown.ended.code == EXIT_OK, flown.ended
    assert flown.disarms >= 2, "the first one was lost"
    assert read_summary(flown.sandbox.cwd / "out")["outcome"] == "completed"
    status = flown.log.inputs[-1].status
    assert status is not None and not status.armed


def test_it_flies_on_poses_that_another_program_sends_to_px4(flown: Flown) -> None:
    """The simulated world sends them, on a link of its own; the companion has the report of PX4's estimator alone."""
    assert flown.ended.code == EXIT_OK, flown.ended
    assert all(inputs.mocap is None for inputs in flown.log.inputs)
    assert read_summary(flown.sandbox.cwd / "out")["latency_ms"]["mocap_to_setpoint"]["p99"] is None


def test_it_flies_without_force_sensor_tether_and_net(flown: Flown) -> None:
    """The simulated world then opens no port for the force sensor, and the flight waits for none."""
    assert flown.ended.code == EXIT_OK, flown.ended
    rows = json.loads((flown.sandbox.cwd / "out/preflight.json").read_text(encoding="utf-8"))["rows"]
    assert not [name for name in flown.events if name.startswith(("force", "tether", "retract"))]
    wanted = ["takeoff", "touchdown"]
    assert [name for name in flown.events if name in wanted] == wanted
    assert {"force.device", "tether.line"} <= {row["id"] for row in rows if row["level"] == "warn" and not row["ok"]}
    assert not any(row["id"].startswith(("force.", "tether.")) for row in rows if row["ok"])


def test_a_law_of_another_package_flies_it_and_the_log_is_replayed_where_it_is_installed(flown: Flown) -> None:
    assert flown.ended.code == EXIT_OK, flown.ended
    flight = flown.log.metadata["flight"]
    assert (flight["law"], flight["law_distribution"], flight["law_version"]) == ("lqr", "lab-lqr", "0.1.0")
    with on_path(flown.site):
        replayed = run_here("replay", flown.sandbox.cwd / "out/flight.mcap")
    assert replayed.code == EXIT_OK, (replayed.out, replayed.err)
    without = run_here("replay", flown.sandbox.cwd / "out/flight.mcap")
    assert without.code == EXIT_BAD_INPUT
    assert without.err.endswith(
        "was flown by control law 'lqr' of lab-lqr 0.1.0, but it is not installed; install that version to replay it\n"
    )


_DEAF_ONCE = """
import sys

if "sitl" in sys.orig_argv:
    from sitl.autopilot.receive import Receiver

    class Heard:
        disarms = 0

    handle = Receiver.handle

    def deaf_once(self, link, message):
        if message.get_type() == "COMMAND_LONG" and message.command == 400 and message.param1 == 0.0:
            Heard.disarms += 1
            with open({file!r}, "w") as file:
                file.write(str(Heard.disarms))
            if Heard.disarms == 1:
                return
        handle(self, link, message)

    Receiver.handle = deaf_once
"""
