"""Turns requests of the core into commands for PX4, paced over time. Pure: time is an argument, nothing is sent here.

The core repeats a request in every tick until the status shows its effect. The queue turns that into one command at a time per kind
of request, with pauses. One kind never waits for another, so LAND is sent even while ARM hangs. A command is sent once: it is repeated
only while the core still makes the request, so that PX4 never receives a command that the newest decision has not made.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.io.px4 import messages
from companion.io.px4.texts import Texts
from companion.model.types import AutopilotRequest

RETRY_S = 0.5
"""Shortest time between two commands of one kind."""
SETTLE_S = 1.5
"""Pause after an accepted command, because the heartbeat that shows its effect is sent once per second."""
ANSWER_DEADLINE_S = 3.0
"""Time without an answer after which that is reported, and longest wait for a command that PX4 reports as in progress."""
_MESSAGES_KEPT = 200


@dataclass(slots=True)
class _Kind:
    not_before_s: float
    waits_since_s: float | None
    """Time of the first command that PX4 has not answered; None if it has answered."""


class RequestQueue:
    """Queue that paces requests and collects the autopilot's messages."""

    def __init__(self) -> None:
        self._kinds: dict[AutopilotRequest, _Kind] = {}
        self._messages: deque[str] = deque(maxlen=_MESSAGES_KEPT)
        self._texts = Texts()

    def claim(self, request: AutopilotRequest, now_s: float) -> bool:
        """Return whether to send this request's command now. `now_s` is on the flight clock."""
        if request is AutopilotRequest.NONE:
            return False
        kind = self._kinds.get(request)
        if kind is None:
            kind = self._kinds[request] = _Kind(now_s, None)
        elif now_s < kind.not_before_s:
            return False
        if kind.waits_since_s is None:
            kind.waits_since_s = now_s
        elif now_s - kind.waits_since_s >= ANSWER_DEADLINE_S:
            self._messages.append(f"{request.name}: no answer within {ANSWER_DEADLINE_S:g} s; requesting it again")
            kind.waits_since_s = now_s
        kind.not_before_s = now_s + RETRY_S
        return True

    def answer(self, command: int, result: int, now_s: float) -> None:
        """Apply a COMMAND_ACK to the request that has waited longest for an answer to this command.

        Args:
            command: MAV_CMD.
            result: MAV_RESULT.
        """
        waiting = [
            (kind.waits_since_s, request.name, kind)
            for request, kind in self._kinds.items()
            if kind.waits_since_s is not None and messages.command(request)[0] == command
        ]
        if not waiting:
            return
        _, name, kind = min(waiting, key=lambda one: one[0])
        if result == messages.MAV_RESULT_IN_PROGRESS:
            kind.not_before_s = now_s + ANSWER_DEADLINE_S
            return
        kind.waits_since_s = None
        if result == 0:
            kind.not_before_s = now_s + SETTLE_S
        else:
            refused = f"{name} refused: {messages.result_text(result)}"
            self._messages.extend(self._texts.once(refused, now_s))

    def hear(self, statustext: Mapping[str, Any], now_s: float) -> None:
        """Store a complete message of the autopilot (`Texts.take`)."""
        self._messages.extend(self._texts.take(statustext, now_s))

    def pending(self) -> int:
        """Return the number of commands without an answer."""
        return sum(kind.waits_since_s is not None for kind in self._kinds.values())

    def take_messages(self, now_s: float) -> list[str]:
        """Return all messages since the last call, oldest first; the newest 200 lines are kept."""
        self._messages.extend(self._texts.overdue(now_s))
        texts = list(self._messages)
        self._messages.clear()
        return texts
