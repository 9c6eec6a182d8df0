"""A flight that hovers over real wires while something is measured."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from tests.support import PATIENT, ROOT, set_options

MISSION = ROOT / "configs/missions/hover.yaml"
HOVER = "hold"
"""Phase of the mission that is extended."""
START_TIMEOUT_S, END_TIMEOUT_S = 60.0, 180.0
BATTERY_MARGIN = 4.0
"""Battery life as a multiple of the hover."""
LIMITS: dict[str, object] = {
    **{key: value for key, value in PATIENT.items() if "mqtt" not in key},
    "vehicle.safety.arm_timeout_s": 0.5,
    "vehicle.safety.force_timeout_s": 0.6,
    "vehicle.safety.guardian_timeout_s": 0.4,
    "vehicle.safety.link_lag_max_s": 0.3,
    "vehicle.safety.loop_stalled_s": 0.6,
    "vehicle.safety.mocap_timeout_s": 0.4,
    "vehicle.safety.vehicle_timeout_s": 0.6,
    "vehicle.devices.arm.watchdog_ms": 400,
}
"""Limits of docs/internals/soak.md, wider than the vehicle file's, because a shared machine stalls now and then. The lateness is
measured, not the reaction of the flight to it.
"""


class NoFlight(Exception):
    """The flight did not begin to hover; the text is its output."""


def start_hover(folder: Path, hover_s: float, broker_url: str, *, report: bool = True) -> subprocess.Popen[bytes]:
    """Start `companion fly` in its own process group, with its output in fly.txt and its files in flight/ in the folder."""
    command = [
        *(
            sys.executable,
            "-m",
            "companion",
            "fly",
            str(MISSION),
            "--sitl",
            "--real-time",
            "--world",
            "ideal",
            "--mqtt",
            broker_url,
        ),
        *("--out", str(folder / "flight"), *([] if report else ["--no-report"])),
        *set_options(**LIMITS),
        *set_options(**{"mission.phases[1].duration_s": hover_s, "world.battery_life_s": BATTERY_MARGIN * hover_s}),
    ]
    with output_path(folder).open("wb") as said:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=said,
            start_new_session=True,
            cwd=ROOT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )


def output_path(folder: Path) -> Path:
    """Return the file with the flight's output."""
    return folder / "fly.txt"


def await_hover(flight: subprocess.Popen[bytes], folder: Path) -> None:
    """Wait until the flight hovers.

    Raises:
        NoFlight: the flight has ended, or the deadline has passed.
    """
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while f"  {HOVER}" not in (said := output_path(folder).read_text(encoding="utf-8", errors="replace")):
        if flight.poll() is not None or time.monotonic() > deadline_s:
            raise NoFlight(said.strip() or "it said nothing")
        time.sleep(0.1)
