"""Queue of the operator's commands: Ctrl-C, signals and commands from the ground station, one per tick."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
from collections.abc import Callable, Coroutine, Iterable, Iterator
from typing import Any, NamedTuple, TypeVar

from companion.model.commands import COMMANDS, SAFER_COMMANDS, TABLE
from companion.model.launcher_messages import Land
from companion.model.outputs import Outputs
from companion.model.types import GroundCommand, OperatorCommand, PhaseKind, SafetyAction
from companion.runtime import ipc

WAITING_MAX = 32
"""Maximum number of queued commands. If there are more, the least severe are refused."""
_GRAVEST_FIRST = {command: rank for rank, command in enumerate(COMMANDS.values())}
_AGE_MAX_S = {row.command: row.age_max_s for row in TABLE if not row.safer}
"""Age above which a RESUME or START is refused that has waited here or on its way from the recorder."""

_T = TypeVar("_T")


class Dropped(NamedTuple):
    """A command that is dropped before it is executed."""

    asked: GroundCommand
    why: str


class TickCommand(NamedTuple):
    """The command of one tick."""

    command: OperatorCommand
    asked: GroundCommand | None
    """The ground station's command that this tick executes and answers; None if there is none."""
    refused: str | None = None
    """Why the command is refused before it reaches the core; None if the core decides."""


class StartCancelled(Exception):
    """A landing was requested before the flight began."""


class Operator:
    """Collects commands from the launcher's messages, signals to this process, and the ground station."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._land = asyncio.Event()
        self._waiting: list[GroundCommand] = []
        self._given = OperatorCommand.NONE
        self._holds = 0
        self.recheck: Callable[[], Coroutine[Any, Any, str]] | None = None
        """Awaited before a START is passed on; returns why it is refused, or an empty text. None after the rotors have started."""
        self._checking: asyncio.Task[str] | None = None
        self.hold: int | None = None
        """Number of the active hold, as in `Sent.hold`; None if the vehicle does not hold."""

    def ask(self, commands: Iterable[GroundCommand]) -> list[Dropped]:
        """Queue commands from the ground station and return those that are dropped. Each queued command gets its own tick, the most
        severe first. A hold, landing or abort drops every RESUME and START that was queued before it.
        """
        dropped = []
        for asked in commands:
            if asked.command in SAFER_COMMANDS:
                why = f"a {asked.command.value} was commanded later"
                dropped += [Dropped(one, why) for one in self._waiting if one.command not in SAFER_COMMANDS]
                self._waiting = [one for one in self._waiting if one.command in SAFER_COMMANDS]
                self._checking = None
            self._waiting.append(asked)
        self._waiting.sort(key=lambda asked: _GRAVEST_FIRST[asked.command])
        dropped += [Dropped(one, "too many commands at once") for one in self._waiting[WAITING_MAX:]]
        del self._waiting[WAITING_MAX:]
        return dropped

    def next(self, t_s: float) -> TickCommand:
        """Return the command of the tick at `t_s` on the flight clock.

        A landing requested by the launcher or a signal stays requested, and every other command is refused. A command from the ground
        station lasts one tick. If it repeats the previous one, it is delayed by a tick, because the core counts rising edges. A RESUME
        that names a hold other than the active one is refused. A START on the ground waits for the result of `recheck`. A RESUME or
        START that is too old by then is refused: its operator has been told that there was no answer.
        """
        waiting = self._waiting
        if self._land.is_set():
            asked = waiting.pop(0) if waiting else None
            if asked is None or asked.command in (OperatorCommand.LAND, OperatorCommand.ABORT):
                return TickCommand(OperatorCommand.LAND, asked)
            return TickCommand(
                OperatorCommand.LAND, asked, f"{asked.command.value} refused: a landing was commanded before"
            )
        if not waiting or waiting[0].command is self._given:
            self._given = OperatorCommand.NONE
            return TickCommand(OperatorCommand.NONE, None)
        age_s, limit_s = t_s - waiting[0].t_s, _AGE_MAX_S.get(waiting[0].command)
        if limit_s is not None and not age_s <= limit_s:
            asked, self._given, self._checking = waiting.pop(0), OperatorCommand.NONE, None
            text = f"{asked.command.value} refused: it was given {age_s:.1f} s ago (limit {limit_s:.1f} s)"
            return TickCommand(OperatorCommand.NONE, asked, f"{text}; check the situation, then command it again")
        if waiting[0].command is OperatorCommand.START and self.recheck is not None:
            checking = self._checking = self._checking or asyncio.ensure_future(self.recheck())
            self._given = OperatorCommand.NONE
            if not checking.done():
                return TickCommand(OperatorCommand.NONE, None)
            self._checking = None
            if text := checking.result():
                return TickCommand(OperatorCommand.NONE, waiting.pop(0), text)
        asked = waiting.pop(0)
        if asked.command is OperatorCommand.RESUME and self.hold is not None and asked.hold != self.hold:
            self._given = OperatorCommand.NONE
            meant = f"hold {asked.hold}" if asked.hold else "no hold"
            text = f"resume refused: it names {meant}, but hold {self.hold} is active; check the situation, then command it again"
            return TickCommand(OperatorCommand.NONE, asked, text)
        self._given = asked.command
        return TickCommand(asked.command, asked)

    def judged(self, command: OperatorCommand, outputs: Outputs) -> int | None:
        """Update `hold`, the number of the active hold, and return it. A new hold begins with `SafetyAction.HOLD`, and with every
        hold command during it.
        """
        if outputs.phase_kind is not PhaseKind.GROUND:
            self.recheck = None
        if outputs.action is not SafetyAction.HOLD:
            self.hold = None
        elif self.hold is None or command is OperatorCommand.HOLD:
            self._holds += 1
            self.hold = self._holds
        return self.hold

    @contextlib.contextmanager
    def attention(self) -> Iterator[None]:
        """Receive from the channel and handle signals while this context is open."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGHUP):
            loop.add_signal_handler(number, self._land.set)
        loop.add_reader(self._channel, self._listen)
        try:
            yield
        finally:
            loop.remove_reader(self._channel)

    async def unless_land(self, opening: Coroutine[Any, Any, _T]) -> _T:
        """Await `opening` and return its result; cancel it if a landing is requested.

        Raises:
            StartCancelled: a landing was requested first.
        """
        task = asyncio.ensure_future(opening)
        land = asyncio.ensure_future(self._land.wait())
        try:
            await asyncio.wait((task, land), return_when=asyncio.FIRST_COMPLETED)
        finally:
            land.cancel()
            task.cancel()  # has no effect on a finished task
            await asyncio.wait((task, land))  # a device that is opening closes itself again within its own deadline
        if task.cancelled():
            raise StartCancelled
        return task.result()

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                message = ipc.receive(self._channel)
                if message is None:  # no caller waits
                    asyncio.get_running_loop().remove_reader(self._channel)
                    self._land.set()
                    return
                if isinstance(message, Land):
                    self._land.set()
