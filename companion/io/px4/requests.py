"""Turns requests of the core into commands for PX4, paced over time. Pure: time is an argument, nothing is sent here.

The core repeats a request in every tick until the status shows its effect. The queue turns that into one command at a time per kind
of request, with pauses. One kind never waits for another, so LAND is sent even while ARM hangs.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.io.px4.texts import Texts
from companion.model.types import AutopilotRequest

SENT_ONCE = frozenset({AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM})
"""Requests that are sent as a single message without MAVSDK's repetition: MAVSDK repeats an unanswered command for 2 s, and a request
that the core no longer makes must not stop the rotors. The core repeats the request in every tick while its rule is active.
"""
RETRY_S = 0.5
"""Shortest time between two commands of one kind."""
SETTLE_S = 1.5
"""Pause after an accepted command, because the heartbeat that shows its effect is sent once per second."""
ANSWER_DEADLINE_S = 3.0
"""Time after which an answer counts as lost and the request may be repeated; MAVSDK abandons a command after about 2 s."""
_MESSAGES_KEPT = 200


@dataclass(slots=True)
class _Kind:
    sent_s: float
    pending: bool
    not_before_s: float


class RequestQueue:
    """Queue that paces requests and collects the autopilot's messages. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: dict[AutopilotRequest, _Kind] = {}
        self._messages: deque[str] = deque(maxlen=_MESSAGES_KEPT)
        self._texts = Texts()

    def claim(self, request: AutopilotRequest, now_s: float) -> bool:
        """Return whether to send this request's command now; if so, report its result with `answer`. `now_s` is on the flight
        clock.
        """
        if request is AutopilotRequest.NONE:
            return False
        with self._lock:
            kind = self._kinds.get(request)
            if kind is not None:
                if kind.pending and request not in SENT_ONCE:
                    if now_s < kind.sent_s + ANSWER_DEADLINE_S:
                        return False
                    self._messages.append(
                        f"{request.name}: no answer within {ANSWER_DEADLINE_S:g} s; requesting it again"
                    )
                elif now_s < kind.not_before_s:
                    return False
            self._kinds[request] = _Kind(sent_s=now_s, pending=True, not_before_s=now_s + RETRY_S)
            return True

    def answer(self, request: AutopilotRequest, refusal: str | None, now_s: float) -> None:
        """Record the autopilot's answer: `refusal` is the reason, or None if it accepted."""
        with self._lock:
            kind = self._kinds.get(request)
            if kind is None:
                return
            kind.pending = False
            if refusal is None:
                kind.not_before_s = now_s + SETTLE_S
            else:
                self._messages.extend(self._texts.once(f"{request.name} refused: {refusal}", now_s))

    def answer_sent_once(self, refusal: str | None, now_s: float) -> None:
        """Apply the COMMAND_ACK of an arm or disarm command to all outstanding requests in `SENT_ONCE`."""
        for request in SENT_ONCE:
            with self._lock:
                kind = self._kinds.get(request)
                waits = kind is not None and kind.pending
            if waits:
                self.answer(request, refusal, now_s)

    def hear(self, statustext: Mapping[str, Any], now_s: float) -> None:
        """Store a complete message of the autopilot (`Texts.take`)."""
        with self._lock:
            self._messages.extend(self._texts.take(statustext, now_s))

    def pending(self) -> int:
        """Return the number of outstanding commands."""
        with self._lock:
            return sum(kind.pending for kind in self._kinds.values())

    def take_messages(self, now_s: float) -> list[str]:
        """Return all messages since the last call, oldest first; the newest 200 lines are kept."""
        with self._lock:
            self._messages.extend(self._texts.overdue(now_s))
            messages = list(self._messages)
            self._messages.clear()
            return messages
