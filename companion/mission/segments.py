"""Phases on a plan's clock. At most two repetitions of a repeated mission are planned; the second is replayed in place of all
later ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from companion.config.mission import Mission
from companion.model.types import PhaseKind


@dataclass(frozen=True, slots=True)
class Segment:
    """One phase with its start and end on the plan's clock."""

    name: str
    kind: PhaseKind
    start_s: float
    end_s: float
    index: int
    """Number of the phase in the mission, from 0; -1 in a plan without a mission."""
    repetition: int = 0
    """Number of the repetition, from 1; 0 for a phase that is flown once."""


@dataclass(frozen=True, slots=True)
class Repeats:
    """Repetitions after the second, which are not planned: the second is replayed from where the previous one ended."""

    count: int
    """Number of all repetitions, 3 or more."""
    first: int
    """Index of the first segment of the second repetition."""
    begin_s: float
    """Start of the second repetition, s."""
    period_s: float
    names: tuple[str, ...]
    """Names of the repeated phases, without a count."""

    @property
    def left_out_s(self) -> float:
        """Return the total duration of the repetitions after the second, s, in whose place the second is replayed."""
        return (self.count - 2) * self.period_s

    @property
    def end_s(self) -> float:
        """Return the end of the last repetition on the plan's clock, s."""
        return self.begin_s + self.period_s + self.left_out_s

    def before(self, t_s: float) -> int:
        """Return by how many periods the second repetition was before this time: 0 before the third, `count` - 2 after the last."""
        whole = int((t_s - self.begin_s) / self.period_s)
        return 0 if whole < 1 else min(whole, self.count - 2)


def flown_phases(mission: Mission) -> list[tuple[int, int]]:
    """Return (phase index, repetition) in planned order. At most two repetitions are planned; the second is replayed in place of all
    later ones. The repetition is 0 for a phase that is flown once.
    """
    last = len(mission.phases) - 1
    middle = range(1, last)
    if mission.repeat == 1:
        return [(index, 0) for index in range(last + 1)]
    return [(0, 0), *((index, 1) for index in middle), *((index, 2) for index in middle), (last, 0)]


def repeats_of(mission: Mission, segments: Sequence[Segment], names: tuple[str, ...]) -> Repeats | None:
    """Return the repetitions after the second, or None if there are none."""
    if mission.repeat < 3:
        return None
    second = [number for number, segment in enumerate(segments) if segment.repetition == 2]
    begin_s = segments[second[0]].start_s
    return Repeats(
        count=mission.repeat,
        first=second[0],
        begin_s=begin_s,
        period_s=segments[second[-1]].end_s - begin_s,
        names=names,
    )


def counted(name: str, repetition: int, count: int) -> str:
    """Return the name of a phase for display."""
    return f"{name} ({repetition} of {count})" if repetition else name
