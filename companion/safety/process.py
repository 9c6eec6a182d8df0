"""Tracker of the companion's own processes and of the operator's commands, and the predicates of their rules.

The rows of these rules, with the actions and the texts for the operator, are in `companion.safety.rules`.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.model.types import Inputs, OperatorCommand
from companion.safety.flight_context import HOLDS, Values


class ProcessTracker:
    """Tracks the control loop, the recorder, the guardian and the operator's commands."""

    def __init__(self) -> None:
        self._command = OperatorCommand.NONE
        self.command = OperatorCommand.NONE
        """The command that begins in this tick; one that lasts for several ticks counts once."""
        self.gap_s = 0.0
        self.recorder_dropped = 0
        self.guardian_ready: bool | None = None

    def update(self, i: Inputs, gap_s: float) -> None:
        """Update with the inputs of one tick."""
        begins, self._command = i.command is not self._command, i.command
        self.command = i.command if begins else OperatorCommand.NONE
        self.gap_s, self.recorder_dropped, self.guardian_ready = gap_s, i.recorder_dropped, i.guardian_ready


def loop_late(p: ProcessTracker, thresholds: tuple[float, float]) -> Values | None:
    """Fires if the tick is late by more than the first threshold but not the second."""
    return (p.gap_s * 1e3, thresholds[0] * 1e3) if thresholds[0] < p.gap_s <= thresholds[1] else None


def loop_stalled(p: ProcessTracker, thresholds: tuple[float, float]) -> Values | None:
    """Fires if the tick is late by more than both thresholds."""
    if not (p.gap_s > thresholds[0] and p.gap_s > thresholds[1]):
        return None
    return (p.gap_s * 1e3, max(thresholds) * 1e3)


def recorder_drops(p: ProcessTracker, _: None) -> Values | None:
    """Fires if the recorder has dropped samples."""
    return HOLDS if p.recorder_dropped else None


def guardian_lost(p: ProcessTracker, _: None) -> Values | None:
    """Fires if a guardian is configured but not ready."""
    return HOLDS if p.guardian_ready is False else None


def commanded(command: OperatorCommand) -> Callable[[ProcessTracker, None], Values | None]:
    """Return the predicate that holds if this command begins in this tick."""

    def predicate(p: ProcessTracker, _: None) -> Values | None:
        return HOLDS if p.command is command else None

    return predicate
