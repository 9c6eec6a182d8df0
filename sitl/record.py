"""The true course of a flight in the simulated world behind its wires, and the world's report at its end."""

from __future__ import annotations

import dataclasses
from typing import Any

from companion.analysis.pair import BarSample, BarTruth
from companion.config.tether import Tether
from sitl.faults.injector import Faults, Sample, sample
from sitl.plant import Plant
from sitl.world.scene import Scene

COURSE_PERIOD_S, FRAMES_PERIOD_S, BAR_PERIOD_S = 0.01, 0.5, 0.02


class TrueCourse:
    """The true course of a flight with faults, for a campaign's table."""

    def __init__(self) -> None:
        self.modes: list[tuple[float, str | None, bool]] = []
        """(world time, mode, armed) at every change of the autopilot's state."""
        self._points: list[Sample] = []
        """True position, tilt and tether of the vehicle, sampled from the first fault."""
        self._due_s = 0.0
        self._frames: list[tuple[int, float]] = []
        """(number, world time) of some of the motion-capture frames; they relate the clock of a log to world time."""

    def watch_mode(self, t_s: float, mode: str | None, armed: bool) -> None:
        """Record the autopilot's state after a step."""
        if not self.modes or self.modes[-1][1:] != (mode, armed):
            self.modes.append((t_s, mode, armed))

    def watch(self, plant: Plant, faults: Faults, tether: Tether | None, frame: int) -> None:
        """Record the state of the vehicle before a step, if it is due.

        Args:
            faults: faults of the world; sampling begins with the first.
            frame: number of the newest motion-capture frame; 0 without one.
        """
        t_s, frames = plant.t_s, self._frames
        if not frames or (frame > frames[-1][0] and t_s >= frames[-1][1] + FRAMES_PERIOD_S):
            frames.append((frame, t_s))
        if faults.begun_s is not None and t_s >= self._due_s:
            self._due_s = t_s + COURSE_PERIOD_S
            self._points.append(sample(plant.machine, tether))

    def report(self) -> dict[str, Any]:
        """Return the record for the file `world.json`."""
        points = [dataclasses.astuple(point) for point in self._points]
        return {"mocap_frames": self._frames, "modes": self.modes, "course": points}


class BarCourse:
    """The true course of the bar that two machines carry, 50 times a second."""

    def __init__(self) -> None:
        self._rows: list[BarSample] = []
        self._due_s = 0.0
        self._let_go_m: float | None = None

    def watch(self, scene: Scene, frame: int) -> None:
        """Record the bar after a step, if it is due.

        Args:
            frame: number of the newest motion-capture frame.
        """
        bar = scene.bar
        if bar is None or scene.t_s < self._due_s:
            return
        self._due_s = scene.t_s + BAR_PERIOD_S - 1e-6
        self._let_go_m = bar.let_go_m
        at, attitude = bar.pose
        pulls = bar.force_world_n(0), bar.force_world_n(1)
        self._rows.append(BarSample(scene.t_s, frame, at, attitude, pulls, all(bar.gripped)))

    def report(self) -> BarTruth:
        """Return the record for the file of the launcher."""
        return BarTruth(tuple(self._rows), self._let_go_m)


def final_report(plant: Plant) -> dict[str, Any]:
    """Return the truth about the payload, the contact and a crash at the end of a flight, for `summary.json`."""
    machine, armed, payload = plant.machine, plant.armed_t_s, plant.scene.payload
    caught = payload.caught_t_s
    return {
        "thrown": payload.thrown_t_s is not None,
        "caught": caught is not None,
        "caught_after_arming_s": None if caught is None or armed is None else caught - armed,
        "missed": payload.missed,
        "miss_m": payload.miss_m,
        "throws": payload.throws,
        "catches": payload.catches,
        "crashed": machine.crashed,
        "contact": machine.contact.report() if machine.contact is not None else None,
    }
