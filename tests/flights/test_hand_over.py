"""An error of our own in mid-air: the flight process hands the vehicle to PX4 and goes on feeding it motion capture."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from pathlib import Path

from companion.config.loader import FlightConfig, load_flight
from companion.core.flight_core import FlightCore
from companion.flight import control_loop
from companion.flight import main as app
from companion.launcher.launcher import replace_device_settings
from companion.model.outputs import Outputs
from companion.model.types import Inputs, Outcome
from tests.support import DEADLINE_S, HOVER, LOW_HOVER, PATIENT, World, sandbox_in, set_options

BREAKS_AFTER_S = 2.5


class BreakingCore(FlightCore):
    """The real core, until it meets a bug at height."""

    def step(self, inputs: Inputs) -> Outputs:
        outputs = super().step(inputs)
        if outputs.mission_t_s > BREAKS_AFTER_S:
            raise ZeroDivisionError("a bug")
        return outputs


def fly_with_a_bug() -> None:
    """The flight process: configuration from stdin, folder and socket as arguments, the outcome to stdout."""
    control_loop.FlightCore = BreakingCore  # type: ignore[attr-defined]
    config = FlightConfig.model_validate_json(sys.stdin.read())
    with socket.socket(fileno=int(sys.argv[2])) as channel:
        print(asyncio.run(app.fly(config, Path(sys.argv[1]), channel)).value)


def test_an_internal_error_in_the_air_lands_by_px4(tmp_path: Path) -> None:
    """A full disk under flight.log costs the traceback, not the landing. With room on it, it is there: test_guardian.py."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    options = [word for word in set_options(**PATIENT, **LOW_HOVER) if word != "--set"]
    with sandbox_in(tmp_path) as sandbox, World(sandbox, HOVER) as world, ours, theirs, open("/dev/full", "wb") as full:
        config = replace_device_settings(load_flight(HOVER, overrides=options), world.devices)
        flown = subprocess.run(
            [sys.executable, "-m", __name__, str(tmp_path), str(theirs.fileno())],
            input=config.model_dump_json(),
            stdout=subprocess.PIPE,
            stderr=full,
            pass_fds=(theirs.fileno(),),
            env={**sandbox.environment, "PYTHONPATH": os.getcwd()},
            start_new_session=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert flown.stdout.strip() == Outcome.ABORTED.value
        rest = [message["at_rest"] for message in world.messages if message["type"] == "WorldAtRest"]
        assert rest[-2:] == [False, True], "it armed, and stands disarmed"
        assert not world.crashes


if __name__ == "__main__":
    fly_with_a_bug()
