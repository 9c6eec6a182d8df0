"""What the processes of a flight have reported, and the outcome and the lines for the user that follow from it."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.launcher.guardian_process import GuardianProcess
from companion.launcher.sitl_process import SitlProcess
from companion.model.exit_codes import EXIT_CODES
from companion.model.launcher_messages import (
    FlightEnded,
    FlightEvent,
    HandedOver,
    Message,
    Px4Text,
    RefusedFlight,
    Started,
    Status,
    Unreadable,
)
from companion.model.types import Outcome, PhaseKind
from companion.runtime.subprocesses import holds_traceback, how_it_ended, last_line

LAND_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SAID_BY_CODE = {EXIT_CODES[outcome]: outcome for outcome in (Outcome.COMPLETED, Outcome.ABORTED)}


class FlightReports:
    """Reports of one flight."""

    def __init__(self) -> None:
        self.result: FlightEnded | None = None
        self.recorder_pid: int | None = None
        self.begun = False
        """Whether the flight process has ticked."""
        self.flying = False
        """Whether the flight process is ticking and sending ten status messages per second; False after the flight."""
        self.events: list[dict[str, Any]] = []
        self.failures: list[str] = []
        """Lines about processes that failed."""
        self._handed_over = False
        """Whether the flight process has left the vehicle to PX4's landing."""
        self._refused: Sequence[str] | None = None
        self._critical_events: list[tuple[int, str]] = []
        """Tick and text of the events that end a flight; those of the first tick are the cause, later ones its consequences."""
        self._px4_texts: list[str] = []
        """Texts that PX4 has sent since the flight began."""

    def take(self, message: Message) -> None:
        """Take a message of the flight process."""
        match message:
            case FlightEnded():
                self.result, self.flying = message, False
            case HandedOver():
                self._handed_over = True
            case RefusedFlight():
                self._refused = message.lines
            case Started():
                self.recorder_pid = message.recorder_pid
            case Status():
                self.begun = True
                self.flying = message.kind is not PhaseKind.DONE
            case FlightEvent():
                self.events.append(message.for_summary())
                if message.ends_flight:
                    self._critical_events.append((message.tick, message.text))
            case Px4Text():
                self._px4_texts.append(message.text)
            case Unreadable():
                self.failures.append(f"flight: an internal error: {message.text}")

    def outcome(
        self, code: int, log_path: Path, guardian: GuardianProcess, sitl: SitlProcess | None, *, stop_requested: bool
    ) -> Outcome:
        """Return the outcome, and add the failures of the processes, all of which have ended.

        Args:
            code: exit code of the flight process.
            sitl: the simulated world; None with hardware.
            stop_requested: whether the user has requested a landing.
        """
        expected: int | None
        if self._refused is not None:
            outcome, expected = Outcome.REFUSED, EXIT_CODES[Outcome.REFUSED]
        elif self.result is not None and self.result.outcome is Outcome.CRASHED:
            outcome, expected = Outcome.CRASHED, EXIT_CODES[Outcome.CRASHED]
        elif guardian.outcome is not None:
            outcome, expected = guardian.outcome, None
        elif self.result is not None:
            outcome = self.result.outcome
            expected = EXIT_CODES[outcome]
        elif self.recorder_pid is None and stop_requested and -code in LAND_SIGNALS:
            outcome, expected = Outcome.ABORTED, code  # it has received Ctrl-C itself, before it could leave the group
        elif self.recorder_pid is None and not self._handed_over:
            outcome, expected = Outcome.REFUSED, None  # it never started, so nothing was armed
        elif code in _SAID_BY_CODE:  # this process stood still, and its channel was full
            outcome, expected = _SAID_BY_CODE[code], code
        else:
            outcome, expected = Outcome.LOST, None
        if sitl is not None and sitl.ended:
            self.failures.append(sitl.exit_summary())
        elif guardian.took_over:
            self.failures.append(_takeover_summary(guardian, code, log_path, ended=self.result is not None))
        elif code != expected:
            text = f"flight: the flight process {how_it_ended(code)}{last_line(log_path)}; see {log_path}"
            self.failures.append(text)
        elif holds_traceback(log_path):
            self.failures.append(f"flight: an internal error was logged{last_line(log_path)}; see {log_path}")
        trouble = guardian.failure() if sitl is None or not sitl.ended else None
        if trouble is not None:
            self.failures.append(trouble)
        return outcome

    def user_lines(self, outcome: Outcome, busy: str | None) -> tuple[str, ...]:
        """Return why the flight was refused, which process failed and where its log is."""
        if outcome is not Outcome.REFUSED:
            return tuple(self.failures)
        reasons = self._refused
        if reasons is None:
            said = "; ".join(dict.fromkeys(self._px4_texts))
            reasons = [
                f"{text}; PX4 reported: {said}" if said and "PX4" in text else text
                for tick, text in self._critical_events
                if tick == self._critical_events[0][0]
            ]
        return (*reasons, *(() if busy is None else (busy,)), *self.failures)


def _takeover_summary(guardian: GuardianProcess, code: int, log_path: Path, *, ended: bool) -> str:
    vehicle = {
        Outcome.ABORTED: "the guardian landed the vehicle",
        Outcome.CRASHED: "the vehicle was flipped or tipped over, and the guardian stopped its rotors",
    }.get(guardian.outcome or Outcome.LOST, "the guardian could not confirm a landing")
    hung = guardian.takeover is not None and guardian.takeover.hangs
    what = "hung and was killed" if hung else f"{how_it_ended(code)}{last_line(log_path)}"
    if ended:
        what = "ended its flight while PX4 was armed, as far as it heard"
    return f"flight: the flight process {what}; {vehicle}; see {log_path}"
