"""An error of our own in mid-air: the flight process hands the vehicle to PX4 and goes on feeding it motion capture."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest

from companion.config.loader import load_flight
from companion.core.flight_core import FlightCore
from companion.flight import main as app
from companion.launcher.launcher import replace_device_settings
from companion.model.types import Inputs, Outcome, Outputs
from companion.preflight import run as before_arming
from tests.support import HOVER, LOW_HOVER, PATIENT, World, sandbox_in, set_options

BREAKS_AFTER_S = 2.5


class BreakingCore(FlightCore):
    """The real core, until it meets a bug at height."""

    def step(self, inputs: Inputs) -> Outputs:
        outputs = super().step(inputs)
        if outputs.mission_t_s > BREAKS_AFTER_S:
            raise ZeroDivisionError("a bug")
        return outputs


@contextlib.contextmanager
def full_disk() -> Iterator[TextIO]:
    """A file that cannot be written, not even when it is closed."""
    full = open("/dev/full", "w", buffering=1, encoding="utf-8")  # noqa: SIM115 - closed below
    try:
        yield full
    finally:
        with contextlib.suppress(OSError):
            full.close()


@pytest.mark.flight
def test_an_internal_error_in_the_air_lands_by_px4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A full disk under flight.log costs the traceback, not the landing. With room on it, it is there: test_guardian.py."""
    monkeypatch.setattr(app, "FlightCore", BreakingCore)
    for room in (app, before_arming):
        monkeypatch.setattr(room, "claim_realtime", lambda priority, **_: "not for the test's own process")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    options = [word for word in set_options(**PATIENT, **LOW_HOVER) if word != "--set"]
    with sandbox_in(tmp_path) as sandbox, World(sandbox, HOVER) as world, ours, theirs, full_disk() as full:
        monkeypatch.setattr(sys, "stderr", full)
        config = replace_device_settings(load_flight(HOVER, overrides=options), world.devices)
        outcome = asyncio.run(app.fly(config, tmp_path, theirs))
        assert outcome is Outcome.ABORTED
        rest = [message["at_rest"] for message in world.messages if message["type"] == "at_rest"]
        assert rest[-2:] == [False, True], "it armed, and stands disarmed"
        assert not world.crashes
    assert "ZeroDivisionError: a bug" not in capfd.readouterr().err, "it went to the disk that is full"
