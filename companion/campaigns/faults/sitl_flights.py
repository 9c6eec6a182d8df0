"""Faults flown over the real protocols: one `companion fly --sitl` per fault, evaluated from its log and the simulated world's own
record.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, Self

from companion.analysis.log import FlightLog, LogError
from companion.campaigns.faults.judge import FaultFlight, Point, row_of, ticks_of
from companion.campaigns.faults.variants import Variant
from companion.campaigns.process import Message
from companion.config.loader import FlightConfig
from companion.model.exit_codes import EXIT_BAD_INPUT
from companion.model.types import Event, Inputs, Outcome, SafetyAction, Severity
from companion.safety.touchdown import HEIGHT_MARGIN_M
from companion.sitl_config.faults import FlightPhase
from companion.sitl_config.loader import SitlConfig

FLIGHT_TIMEOUT_S = 240.0
LEAVE_TIMEOUT_S = 60.0
"""Timeout from the request to land to the end of the process."""
WITNESS = "world.json"
"""File in the flight's folder in which a simulated world with faults writes its record."""
NEAR_FRAMES = 3
"""Number of consecutive frame numbers that are looked for in the log, because a tick logs only its newest frame. The first one
found is used.
"""
_POLL_S = 0.5


class WireFlights:
    """Flies with `companion fly --sitl`, `jobs` flights at a time.

    Args:
        options: arguments of `companion fly` that all flights share, the mission first.
        out: folder in which every flight gets a folder of its own.
    """

    def __init__(
        self,
        flights: Sequence[tuple[Variant, FlightPhase]],
        options: Sequence[str],
        config: SitlConfig,
        out: Path,
        jobs: int,
    ) -> None:
        self._flights = list(flights)
        self._options = list(options)
        self._config = config
        self._out = out
        self._jobs = jobs
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stop_asked = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.ask_to_stop()

    def ask_to_stop(self) -> None:
        """Land the flying vehicles and start no further flights. May be called in a signal handler."""
        self._stop_asked = True
        for process in tuple(self._running):
            process.send_signal(signal.SIGINT)

    def results(self) -> Iterator[Message]:
        """Yield the result of each flight as it ends."""
        with ThreadPoolExecutor(self._jobs) as pool:
            waiting = {pool.submit(self._fly, n, variant, phase) for n, (variant, phase) in enumerate(self._flights)}
            while waiting:
                # With a timeout, so that a stop signal is handled in the meantime.
                done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                yield from (message for future in done if (message := future.result()) is not None)

    def _fly(self, number: int, variant: Variant, phase: FlightPhase) -> Message | None:
        if self._stop_asked:
            return None
        begun_s = time.monotonic()
        folder = self._out / f"{number:02d}-{variant.kind}-{phase}"
        faults = f"world.faults={json.dumps([variant.fault(phase)])}"
        command = [
            sys.executable,
            "-P",
            "-m",
            "companion",
            "fly",
            *self._options,
            "--sitl",
            "--speed",
            "max",
            "--set",
            faults,
        ]
        with open(self._out / f"{folder.name}.txt", "wb") as console:
            process = subprocess.Popen(
                [*command, "--out", str(folder)], stdin=subprocess.DEVNULL, stdout=console, stderr=console
            )
        self._running.add(process)
        try:
            code = self._wait(process)
        finally:
            self._running.discard(process)
        if self._stop_asked:
            return None
        if code == EXIT_BAD_INPUT or code is None:
            last = (self._out / f"{folder.name}.txt").read_text(encoding="utf-8", errors="replace").strip()
            record = _lost("the process did not end" if code is None else last.rpartition("\n")[2])
        else:
            record = flown(folder, self._config)
        row = row_of(variant, phase, record, self._config.vehicle)
        row |= {"world_seed": self._config.world.seed, "model_error": self._config.world.model_error}
        return {"index": number, "row": row, "wall_s": time.monotonic() - begun_s}

    @staticmethod
    def _wait(process: subprocess.Popen[bytes]) -> int | None:
        """Return the process's exit code, or None if it had to be killed."""
        for timeout_s, number in ((FLIGHT_TIMEOUT_S, signal.SIGINT), (LEAVE_TIMEOUT_S, signal.SIGKILL)):
            try:
                return process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                process.send_signal(number)
        process.wait()
        return None


def _lost(why: str) -> FaultFlight:
    return FaultFlight(
        outcome=Outcome.LOST.value, begun_s=None, course=(), ticks=(), events=(), landed=False, caught=False, error=why
    )


def flown(folder: Path, config: FlightConfig) -> FaultFlight:
    """Read the record of a flight from its folder; without a record the outcome is `lost`."""
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        world = json.loads((folder / WITNESS).read_text(encoding="utf-8"))
        log = FlightLog.read(folder / "flight.mcap") if (folder / "flight.mcap").exists() else None
    except (OSError, ValueError, LogError) as error:
        return _lost(str(error))
    begun_s = world["fault_begun_s"]
    ticks, events = ticks_of(log.outputs if log is not None else ()), _events(log, summary)
    offset_s = _offset_s(log.inputs if log is not None else (), world["mocap_frames"], begun_s or 0.0)
    course = [
        Point(
            t_s=t_s + offset_s,
            position_world_m=(x, y, z),
            tilt_rad=tilt_rad,
            slack_m=slack_m,
            tension_n=abs(tension_n),
            contact_n=contact_n,
        )
        for t_s, (x, y, z), tilt_rad, slack_m, tension_n, contact_n in world["course"]
    ]
    low_m = config.vehicle.airframe.ground_clearance_m + HEIGHT_MARGIN_M
    landed = bool(course) and course[-1].position_world_m[2] < low_m and not world["armed"]
    outcome = Outcome.CRASHED.value if world["crashed"] else summary["outcome"]
    fault_s = None if begun_s is None else begun_s + offset_s
    return FaultFlight(
        outcome=outcome,
        begun_s=fault_s,
        course=course,
        ticks=ticks,
        events=events,
        landed=landed,
        caught=bool(world["caught"]),
    )


def _offset_s(inputs: Sequence[Inputs], frames: Sequence[tuple[int, float]], begun_s: float) -> float:
    """Return the flight clock minus the world's clock, from the motion-capture frame nearest to the fault in both records."""
    stamps = {i.mocap.frame_number: i.mocap.stamp_s for i in inputs if i.mocap is not None}
    for number, world_s in sorted(frames, key=lambda frame: abs(frame[1] - begun_s)):
        for near in range(number, number + NEAR_FRAMES):
            if near in stamps:
                return stamps[near] - world_s
    return 0.0


def _events(log: FlightLog | None, summary: dict[str, Any]) -> list[Event]:
    """Return the events: the core's from the log, the guardian's (and the core's if its recorder died) from the summary."""
    found = [event for o in log.outputs for event in o.events] if log is not None else []
    known = {event.id for event in found}
    for event in summary["events"]:
        if event["id"] not in known:
            severity, action = Severity(event["severity"]), SafetyAction(event["action"])
            found.append(Event(t_s=event["t_s"], id=event["id"], severity=severity, action=action, text=""))
    return sorted(found, key=lambda event: event.t_s)


def default_jobs() -> int:
    """Return the number of simultaneous flights: each needs about two cores."""
    return max(1, (os.cpu_count() or 1) // 2)
