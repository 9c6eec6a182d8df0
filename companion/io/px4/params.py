"""Reads many of PX4's parameters with a window of requests, and writes one value with verification.

Several PARAM_REQUEST_READ by name are under way at a time, because PX4 1.16 does not answer those for a name that it does not have. A
parameter counts as absent if PX4 does not answer although it answers requests that were sent later.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import struct
from collections import deque
from collections.abc import Iterable
from typing import Any

from companion.io.px4 import messages
from companion.io.px4.link import device_error
from companion.io.px4.questions import Questions
from companion.px4.params_file import single
from companion.runtime.clock import Clock

WINDOW = 8
"""Largest number of outstanding requests: their answers fit into PX4's transmit buffer together with the telemetry."""
ANSWER_S = 0.4
"""Timeout after which a request is repeated."""
ASKS = 4
"""A name counts as absent after this many requests without an answer while PX4 answers others."""
READ_DEADLINE_S = 10.0
"""Longest time in which PX4 answers no further name; a whole export has 900."""
ALWAYS_THERE = "MAV_SYS_ID"
"""Parameter that every PX4 has. Its answer shows that PX4 has received the requests sent before."""

_NAME = re.compile(r"[A-Z0-9_]{1,16}")
_PAYLOAD = {0xFE: 6, 0xFD: 10}
"""Offset of the payload in a frame of MAVLink 1 and 2."""
_INT32_MIN, _INT32_MAX = -(2**31), 2**31 - 1

Value = float | int


class ParamQueries:
    """Decides when to request which name. No I/O: time is an argument, names are the result."""

    def __init__(self, names: Iterable[str]) -> None:
        self.answered: set[str] = set()
        self.absent: set[str] = set()
        self._names = tuple(dict.fromkeys(names))
        self._waiting = deque(self._names)
        self._sent_s: dict[str, float] = {}
        self._unheard = dict.fromkeys(self._names, 0)
        self._heard_s = -math.inf
        self._alive_sent_s = -math.inf

    @property
    def settled(self) -> int:
        """Return the number of names that are answered or absent."""
        return len(self.answered) + len(self.absent)

    @property
    def done(self) -> bool:
        """Return whether every name is answered or absent."""
        return self.settled == len(self._names)

    def due(self, now_s: float) -> list[str]:
        """Return the names to request at `now_s`, with ALWAYS_THERE last if PX4 must show that it still answers."""
        for name in [name for name, sent_s in self._sent_s.items() if now_s >= sent_s + ANSWER_S]:
            # A missing answer counts only if PX4 has answered since.
            self._unheard[name] += self._heard_s > self._sent_s.pop(name)
            if self._unheard[name] >= ASKS:
                self.absent.add(name)
            else:
                self._waiting.append(name)
        asks = []
        while self._waiting and len(self._sent_s) < WINDOW:
            name = self._waiting.popleft()
            self._sent_s[name] = now_s
            asks.append(name)
        if asks and now_s >= self._alive_sent_s + ANSWER_S:
            self._alive_sent_s = now_s
            asks.append(ALWAYS_THERE)
        return asks

    def heard(self, name: str, now_s: float) -> None:
        """Process a PARAM_VALUE of `name`."""
        self._heard_s = now_s
        if name in self._unheard:
            self._sent_s.pop(name, None)
            if name in self._waiting:
                self._waiting.remove(name)
            self.absent.discard(name)
            self.answered.add(name)


def value_of(message: Any) -> tuple[str, Value]:
    """Return the name and the value in a PARAM_VALUE: an int where PX4 stores one, whose bytes it sends in place of the float."""
    frame = message.get_msgbuf()
    wire = frame[_PAYLOAD[frame[0]] :][:4]  # a float in Python would change the bytes of some integers
    value: Value = struct.unpack("<f" if message.param_type == messages.MAV_PARAM_TYPE_REAL32 else "<i", wire)[0]
    return message.param_id, value


class ParamTransfer:
    """Reads and writes parameters over an open link."""

    def __init__(self, clock: Clock, questions: Questions) -> None:
        self._clock = clock
        self._questions = questions
        self._address = questions.address

    async def read(self, names: Iterable[str]) -> dict[str, Value]:
        """Return values by name, int or float as PX4 stores them; names that PX4 does not have are left out.

        Raises:
            DeviceError: an invalid name, or no further answer within the deadline.
        """
        wanted = tuple(dict.fromkeys(names))
        for name in wanted:
            if _NAME.fullmatch(name) is None:
                expected = "a parameter name with 1 to 16 of the characters A-Z, 0-9 and _"
                raise device_error(self._address, expected, repr(name), "correct the name")
        queries, got = ParamQueries(wanted), dict[str, Value]()
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def take(message: Any) -> None:
            name, value = value_of(message)
            queries.heard(name, self._clock())
            got[name] = value
            changed.set()

        listening = self._questions.inbox.listening(messages.PARAM_VALUE_ID, take)
        try:
            with listening:
                async with asyncio.timeout(READ_DEADLINE_S) as deadline:
                    settled = 0
                    while not queries.done:
                        if queries.settled > settled:
                            settled = queries.settled
                            deadline.reschedule(loop.time() + READ_DEADLINE_S)
                        for name in queries.due(self._clock()):
                            self._questions.send(*messages.param_request_read(name, self._questions.system_id))
                        changed.clear()
                        with contextlib.suppress(TimeoutError):  # then check which requests are overdue
                            async with asyncio.timeout(ANSWER_S / 4):
                                await changed.wait()
        except TimeoutError:
            expected = f"PX4's parameters ({len(wanted)} names, the first {wanted[0]})"
            found = f"{len(queries.answered)}, and no other within {READ_DEADLINE_S:g} s"
            raise device_error(self._address, expected, found, "check the link") from None
        return {name: got[name] for name in wanted if name in queries.answered}

    async def write(self, name: str, value: Value) -> Value:
        """Write one value, read it back and return the value that PX4 now holds.

        Raises:
            DeviceError: PX4 has no such parameter, its type cannot hold the value, or PX4 refuses the value or keeps a different one.
        """
        before = (await self.read([name])).get(name)
        if before is None:
            fix = "check the name against PX4's version"
            raise device_error(self._address, f"PX4's parameter {name}", "no such parameter", fix)
        wanted = self._storable(name, value, integer=isinstance(before, int))
        question = messages.param_set(name, wanted, self._questions.system_id)
        expected = f"PX4 to accept {name} = {wanted:g}"
        await self._questions.ask(
            expected, question, messages.PARAM_VALUE_ID, lambda message: value_of(message)[0] == name or None
        )
        after = (await self.read([name])).get(name)
        if after != wanted:
            fix = "PX4 clipped or rejected the value; choose one within the parameter's range"
            raise device_error(self._address, f"{name} = {wanted:g} after writing", f"{after}", fix)
        return after

    def _storable(self, name: str, value: Value, *, integer: bool) -> Value:
        if integer:
            if math.isfinite(value) and value == int(value) and _INT32_MIN <= value <= _INT32_MAX:
                return int(value)
            raise device_error(self._address, f"a whole number for {name}, an INT32", f"{value}", "correct the value")
        try:
            return single(float(value))
        except OverflowError:
            expected = f"a number that fits into single precision for {name}, a REAL32"
            raise device_error(self._address, expected, f"{value}", "correct the value") from None
