"""Phases on a plan's clock. Of a mission that repeats two repetitions are planned; the second stands for all further ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from companion.config.mission import Mission
from companion.model.types import PhaseKind


@dataclass(frozen=True, slots=True)
class Segment:
    """One phase on the plan's clock."""

    name: str
    kind: PhaseKind
    start_s: float
    end_s: float
    index: int
    """Number of the phase in the mission, from 0; -1 in a plan without a mission."""
    repetition: int = 0
    """Of a mission that repeats, from 1; 0: flown once."""


@dataclass(frozen=True, slots=True)
class Repeats:
    """The second repetition stands for all further ones: each begins where the one before it ended, and flies the same."""

    count: int
    """Of all repetitions, 3 or more."""
    first: int
    """Among the segments: the first one of the second repetition."""
    begin_s: float
    """Of the second repetition."""
    period_s: float
    names: tuple[str, ...]
    """Of the phases that repeat, without a count."""

    @property
    def left_out_s(self) -> float:
        """Time of the repetitions for which the second one stands."""
        return (self.count - 2) * self.period_s

    @property
    def end_s(self) -> float:
        """Of the last repetition, on the plan's clock."""
        return self.begin_s + self.period_s + self.left_out_s

    def before(self, t_s: float) -> int:
        """How many repetitions for which the second one stands are over at a time."""
        whole = int((t_s - self.begin_s) / self.period_s)
        return 0 if whole < 1 else min(whole, self.count - 2)


def flown_phases(mission: Mission) -> list[tuple[int, int]]:
    """Numbers of the phases in the order in which they are planned, each with its repetition: the third repetition is the second."""
    last = len(mission.phases) - 1
    middle = range(1, last)
    if mission.repeat == 1:
        return [(index, 0) for index in range(last + 1)]
    return [(0, 0), *((index, 1) for index in middle), *((index, 2) for index in middle), (last, 0)]


def repeats_of(mission: Mission, segments: Sequence[Segment], names: tuple[str, ...]) -> Repeats | None:
    """What the second repetition stands for; None: for itself alone."""
    if mission.repeat < 3:
        return None
    second = [number for number, segment in enumerate(segments) if segment.repetition == 2]
    begin_s = segments[second[0]].start_s
    return Repeats(mission.repeat, second[0], begin_s, segments[second[-1]].end_s - begin_s, names)


def counted(name: str, repetition: int, count: int) -> str:
    """The name of a phase as people see it."""
    return f"{name} ({repetition} of {count})" if repetition else name
