"""When a request of the core becomes a command on the wire. Pure: the clock comes in, nothing goes out.

The core repeats a request in every tick until the status shows it done. The desk turns that into one command at a time per kind of
request, with pauses: a kind never waits for another, so LAND goes out while ARM hangs.
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
"""Sent as one plain message: MAVSDK repeats a command for 2 s until it is answered, and what the core no longer requests must not
stop rotors. The core requests again in every tick for as long as its rule holds."""
RETRY_S = 0.5
"""Least time between two commands of one kind."""
SETTLE_S = 1.5
"""Pause after an accepted command: the heartbeat that shows it done comes once a second."""
ANSWER_DEADLINE_S = 3.0
"""MAVSDK gives a command up after about 2 s; past this its answer is lost and the request may be made again."""
_MESSAGES_KEPT = 200


@dataclass(slots=True)
class _Kind:
    sent_s: float
    pending: bool
    not_before_s: float


class RequestDesk:
    """Paces requests and keeps what the autopilot said. Safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kinds: dict[AutopilotRequest, _Kind] = {}
        self._messages: deque[str] = deque(maxlen=_MESSAGES_KEPT)
        self._texts = Texts()

    def claim(self, request: AutopilotRequest, now_s: float) -> bool:
        """True: send this request's command now, and report by `answer`. `now_s` is on the flight clock."""
        if request is AutopilotRequest.NONE:
            return False
        with self._lock:
            kind = self._kinds.get(request)
            if kind is not None:
                if kind.pending and request not in SENT_ONCE:
                    if now_s < kind.sent_s + ANSWER_DEADLINE_S:
                        return False
                    self._messages.append(f"{request.name}: no answer within {ANSWER_DEADLINE_S:g} s, asking again")
                elif now_s < kind.not_before_s:
                    return False
            self._kinds[request] = _Kind(sent_s=now_s, pending=True, not_before_s=now_s + RETRY_S)
            return True

    def answer(self, request: AutopilotRequest, refusal: str | None, now_s: float) -> None:
        """The autopilot accepted (None) or refused, with the reason in words."""
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
        """A COMMAND_ACK to arming or disarming came: it answers the requests of `SENT_ONCE` that wait for one."""
        for request in SENT_ONCE:
            with self._lock:
                kind = self._kinds.get(request)
                waits = kind is not None and kind.pending
            if waits:
                self.answer(request, refusal, now_s)

    def hear(self, statustext: Mapping[str, Any], now_s: float) -> None:
        """Keep what the autopilot said by itself, once it is complete (`Texts.take`)."""
        with self._lock:
            self._messages.extend(self._texts.take(statustext, now_s))

    def pending(self) -> int:
        """How many commands still wait for their answer."""
        with self._lock:
            return sum(kind.pending for kind in self._kinds.values())

    def take_messages(self, now_s: float) -> list[str]:
        """Everything said since the last call, oldest first; the newest 200 lines are kept."""
        with self._lock:
            self._messages.extend(self._texts.overdue(now_s))
            messages = list(self._messages)
            self._messages.clear()
            return messages
