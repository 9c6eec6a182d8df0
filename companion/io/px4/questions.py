"""Asks PX4 over the driver's link. A question is repeated until its answer arrives; all times are those of the event loop.

MAVSDK asks as well, but its threads repeat and give up on the computer's clock: a simulated flight on a busy computer, whose time
runs slower, would be refused for answers that were on their way.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, TypeVar

from companion.io.px4 import messages
from companion.io.px4.inbox import Inbox
from companion.io.px4.link import device_error

REPEAT_S = 0.5
ASKS = 10

_T = TypeVar("_T")


class Questions:
    """Asks one question at a time.

    Args:
        address: as in `devices.autopilot.address`, for errors.
        send: sends a message, given by id and payload.
    """

    def __init__(self, address: str, system_id: int, inbox: Inbox, send: Callable[[int, bytes], bool]) -> None:
        self.address = address
        self.system_id = system_id
        self.inbox = inbox
        self.send = send
        self._one = asyncio.Lock()

    async def ask(
        self, expected: str, question: tuple[int, bytes], answer_id: int, answer: Callable[[Any], _T | None]
    ) -> _T:
        """Send `question` until a message is its answer, and return what `answer` makes of that.

        Args:
            expected: what PX4 is asked for, for the error.
            question: id and payload of a message.
            answer: returns None for a message that is not the answer.

        Raises:
            DeviceError: no answer to any of the repetitions.
        """
        answered: asyncio.Future[_T] = asyncio.get_running_loop().create_future()

        def hear(message: Any) -> None:
            found = answer(message)
            if found is not None and not answered.done():
                answered.set_result(found)

        async with self._one:
            with self.inbox.listening(answer_id, hear):
                for _ in range(ASKS):
                    self.send(*question)
                    done, _ = await asyncio.wait([answered], timeout=REPEAT_S)
                    if done:
                        return answered.result()
        found = f"no answer within {ASKS * REPEAT_S:g} s"
        raise device_error(self.address, expected, found, "check the link")

    async def command(self, expected: str, number: int, param1: float, param2: float = 0.0) -> int:
        """Send a MAV_CMD with its first two parameters and return its MAV_RESULT; raises the errors of `ask`."""

        def result(ack: Any) -> int | None:
            final = ack.command == number and ack.result != messages.MAV_RESULT_IN_PROGRESS
            return int(ack.result) if final else None

        question = messages.command_long(number, param1, param2, self.system_id)
        return await self.ask(expected, question, messages.COMMAND_ACK_ID, result)
