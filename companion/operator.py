"""What the people on the ground want: Ctrl-C and signals, and commands over the air, as one command per tick."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Coroutine, Iterable, Iterator
from typing import Any, TypeVar

from companion import status
from companion.types import GroundCommand, OperatorCommand

WAITING_MAX = 32
"""Commands that wait for their tick; of more than that at once the mildest are sent back."""
_GRAVEST_FIRST = {
    command: rank
    for rank, command in enumerate(
        (
            OperatorCommand.ABORT,
            OperatorCommand.LAND,
            OperatorCommand.HOLD,
            OperatorCommand.RESUME,
            OperatorCommand.START,
        )
    )
}

_T = TypeVar("_T")


class GivenUp(Exception):
    """A landing was asked for before the flight began."""


class Operator:
    """The launcher's messages, the signals sent to this process, and what came over the air.

    Args:
        channel: to the launcher.
    """

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._land = asyncio.Event()
        self._waiting: list[GroundCommand] = []
        self._given = OperatorCommand.NONE

    def ask(self, commands: Iterable[GroundCommand]) -> list[GroundCommand]:
        """Commands from the ground: each has its tick, the gravest first. Those that there is no room for are given back."""
        self._waiting += commands
        self._waiting.sort(key=lambda asked: _GRAVEST_FIRST[asked.command])
        too_many = self._waiting[WAITING_MAX:]
        del self._waiting[WAITING_MAX:]
        return too_many

    def next(self) -> tuple[OperatorCommand, GroundCommand | None]:
        """What is asked for in this tick, and the command from the ground that is to be answered after it.

        A landing that the launcher or a signal asked for stays asked for. A command from the ground lasts one tick, and the same one
        again comes a tick later: the core counts what begins.
        """
        waiting = self._waiting
        if self._land.is_set():
            return OperatorCommand.LAND, waiting.pop(0) if waiting else None
        if not waiting or waiting[0].command is self._given:
            self._given = OperatorCommand.NONE
            return OperatorCommand.NONE, None
        asked = waiting.pop(0)
        self._given = asked.command
        return asked.command, asked

    @contextlib.contextmanager
    def attention(self) -> Iterator[None]:
        """While inside, the channel and the signals are listened to."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._land.set)
        loop.add_reader(self._channel, self._listen)
        try:
            yield
        finally:
            loop.remove_reader(self._channel)

    async def unless_land(self, opening: Coroutine[Any, Any, _T]) -> _T:
        """The result of `opening`, which is cancelled when a landing is asked for.

        Raises:
            GivenUp: a landing was asked for first.
        """
        task = asyncio.ensure_future(opening)
        land = asyncio.ensure_future(self._land.wait())
        try:
            await asyncio.wait((task, land), return_when=asyncio.FIRST_COMPLETED)
        finally:
            land.cancel()
            task.cancel()  # does nothing to one that is done
            await asyncio.wait((task, land))  # an edge that is opening takes itself back, within a deadline of its own
        if task.cancelled():
            raise GivenUp
        return task.result()

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                message = status.receive(self._channel)
                if message is None:  # nobody watches any more
                    asyncio.get_running_loop().remove_reader(self._channel)
                    self._land.set()
                    return
                if message.get("type") == "land":
                    self._land.set()
