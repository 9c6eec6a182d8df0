"""What the people on the ground want: Ctrl-C and signals, and commands over the air, as one command per tick."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Coroutine, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

from companion.model.types import GroundCommand, OperatorCommand, Outputs, SafetyAction
from companion.runtime import ipc

WAITING_MAX = 32
"""Commands that wait for their tick; of more than that at once the mildest are refused."""
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
_STOPS = frozenset({OperatorCommand.ABORT, OperatorCommand.LAND, OperatorCommand.HOLD})

_T = TypeVar("_T")


class Dropped(NamedTuple):
    """A command that never has its tick."""

    asked: GroundCommand
    why: str
    """For the operator who gave it."""


class Turn(NamedTuple):
    """What one tick is asked for."""

    command: OperatorCommand
    """For the core."""
    asked: GroundCommand | None
    """The command from the ground that is to be answered after the tick."""
    refused: str | None = None
    """Then the answer, and the core is not asked; None: the answer is what came of it."""


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
        self._holds = 0
        self.hold: int | None = None
        """Number of the hold that stands, as `Sent.hold`; None: it does not hold."""

    def ask(self, commands: Iterable[GroundCommand]) -> list[Dropped]:
        """Commands from the ground in the order in which they came: each has its tick, the gravest first.

        A hold, landing or abort drops every RESUME and START that waits: those were given before it. Returns what is dropped.
        """
        dropped = []
        for asked in commands:
            if asked.command in _STOPS:
                why = f"a {asked.command.value} was commanded after it"
                dropped += [Dropped(one, why) for one in self._waiting if one.command not in _STOPS]
                self._waiting = [one for one in self._waiting if one.command in _STOPS]
            self._waiting.append(asked)
        self._waiting.sort(key=lambda asked: _GRAVEST_FIRST[asked.command])
        dropped += [Dropped(one, "too many commands at once") for one in self._waiting[WAITING_MAX:]]
        del self._waiting[WAITING_MAX:]
        return dropped

    def next(self) -> Turn:
        """What is asked for in this tick.

        A landing that the launcher or a signal asked for stays asked for. A command from the ground lasts one tick, and the same one
        again comes a tick later: the core counts what begins. A RESUME that names another hold than the one that stands is refused.
        """
        waiting = self._waiting
        if self._land.is_set():
            return Turn(OperatorCommand.LAND, waiting.pop(0) if waiting else None)
        if not waiting or waiting[0].command is self._given:
            self._given = OperatorCommand.NONE
            return Turn(OperatorCommand.NONE, None)
        asked = waiting.pop(0)
        if asked.command is OperatorCommand.RESUME and self.hold is not None and asked.hold != self.hold:
            self._given = OperatorCommand.NONE
            meant = f"hold {asked.hold}" if asked.hold else "no hold"
            text = f"resume refused: it names {meant}, now hold {self.hold} stands; look again, then command it anew"
            return Turn(OperatorCommand.NONE, asked, text)
        self._given = asked.command
        return Turn(asked.command, asked)

    def judged(self, command: OperatorCommand, outputs: Outputs) -> int | None:
        """Number the holds: a new one begins with `SafetyAction.HOLD`, and with every command to hold while it stands.

        Args:
            command: of the tick.
            outputs: what the core made of the tick.

        Returns:
            `hold`.
        """
        if outputs.action is not SafetyAction.HOLD:
            self.hold = None
        elif self.hold is None or command is OperatorCommand.HOLD:
            self._holds += 1
            self.hold = self._holds
        return self.hold

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
                message = ipc.receive(self._channel)
                if message is None:  # nobody watches any more
                    asyncio.get_running_loop().remove_reader(self._channel)
                    self._land.set()
                    return
                if message.get("type") == "land":
                    self._land.set()
