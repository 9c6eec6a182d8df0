"""`companion monitor --text`: the vehicle in a terminal, over SSH too; without a terminal one line a second."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import termios
import time
import tty
from collections import deque
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import Ack, CommandName, Topic
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import Failed, Sent, told
from companion.ground.station.station import Station
from companion.ground.station.tasks import until_first
from companion.ground.station.text_view import Around, Note, frame, line
from companion.ground.station.vehicles import Heard, Vehicle
from companion.runtime.console import terminal_console

PERIOD_S = 0.125
LINE_PERIOD_S = 1.0
CONFIRM_S = 3.0
"""Within which the key of a command that needs it is pressed again."""
KEYS_MAX = 100
AT_ONCE = {"h": CommandName.HOLD, "l": CommandName.LAND, "a": CommandName.ABORT}
CONFIRMED = {"r": CommandName.RESUME, "s": CommandName.START}


async def watch_in_terminal(access: BrokerAccess, signer: Signer | str, only: str | None) -> None:
    """Watch until the `q` key, or until cancelled.

    Raises:
        BrokerRefused: the broker does not want us.
    """
    console = terminal_console()
    if not console.is_terminal:
        lines = _Lines()
        station = Station(access, signer, only, lambda heard: None, lines.on_change)
        await until_first(station.run(), lines.run(station))
        return
    screen = _Screen(console)
    station = Station(access, signer, only, screen.on_heard, lambda connected, text: None)
    await until_first(station.run(), screen.run(station))


class _Lines:
    """For pipes."""

    def on_change(self, connected: bool, text: str) -> None:
        print(text, flush=True)

    async def run(self, station: Station) -> None:
        print(station.link.text, flush=True)
        while True:
            await asyncio.sleep(LINE_PERIOD_S)
            clock = time.strftime("%H:%M:%S")
            for vehicle in list(station.watch.vehicles.values()):
                print(f"{clock} {line(vehicle, time.monotonic())}", flush=True)


class _Screen:
    """For people."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._notes: deque[Note] = deque(maxlen=10)
        self._chosen: str | None = None
        self._asked: tuple[CommandName, float, tuple[object, ...]] | None = None
        """What waits for its key to be pressed again, since when, and whom it was for then (`_meant`)."""
        self._keys: deque[str] = deque(maxlen=KEYS_MAX)
        self._pressed = asyncio.Event()

    def on_heard(self, heard: Heard) -> None:
        """Acks are shown, whoever commanded."""
        if heard.topic is Topic.ACK:
            ack: Ack = heard.record
            text = f"{heard.vehicle}: {told(ack)} ({ack.operator})"
            self._notes.append(Note(text, "bold green" if ack.accepted else "bold red"))

    async def run(self, station: Station) -> None:
        with contextlib.ExitStack() as stack:
            stack.enter_context(self._key_presses())
            live = stack.enter_context(Live(console=self._console, auto_refresh=False, screen=True))
            async with asyncio.TaskGroup() as errands:
                while True:
                    while self._keys:
                        key = self._keys.popleft()
                        if key == "q":
                            return
                        command = self._command(key, station)
                        vehicle = self._vehicle(station)
                        if command is not None and vehicle is not None:
                            hold = _hold(vehicle) if command is CommandName.RESUME else None
                            errands.create_task(station.orders.give(vehicle.name, command, self._on_note, hold))
                    live.update(frame(self._vehicle(station), time.monotonic(), self._around(station)), refresh=True)
                    await self._key_or_period()

    def _vehicle(self, station: Station) -> Vehicle | None:
        """The one that is shown: as chosen, else the first one that is there."""
        known = station.watch.vehicles
        if self._chosen not in known:
            there = station.watch.there(time.monotonic()) or sorted(known)
            self._chosen = there[0] if there else None
        return known.get(self._chosen) if self._chosen is not None else None

    def _command(self, key: str, station: Station) -> CommandName | None:
        """What a key asks for, now."""
        if key == "n":
            names = sorted(station.watch.vehicles)
            if self._chosen in names:
                self._chosen = names[(names.index(self._chosen) + 1) % len(names)]
        if key in AT_ONCE:
            return AT_ONCE[key]
        command = CONFIRMED.get(key)
        asked, self._asked = self._asked, None
        if command is None:
            return None
        now_s, meant = time.monotonic(), _meant(self._vehicle(station))
        if asked is not None and asked[0] is command and now_s - asked[1] < CONFIRM_S and asked[2] == meant:
            return command
        self._asked = (command, now_s, meant)
        self._notes.append(Note(f"{command.value}? press {key} again within {CONFIRM_S:g} s", "bold yellow"))
        return None

    def _on_note(self, note: Sent | Failed) -> None:
        if isinstance(note, Sent):
            self._notes.append(Note(f"{note.vehicle}: {note.command.value} sent ..."))
        else:
            self._notes.append(Note(f"{note.vehicle}: {note.command.value}: {note.text}", "bold red"))

    def _around(self, station: Station) -> Around:
        names = sorted(station.watch.vehicles)
        return Around(
            station.link.text,
            station.link.connected,
            station.orders.operator,
            station.orders.why_not,
            tuple(names) if len(names) > 1 else (),
            station.watch.rubbish,
            tuple(self._notes),
        )

    async def _key_or_period(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PERIOD_S):
                await self._pressed.wait()
        self._pressed.clear()

    @contextlib.contextmanager
    def _key_presses(self) -> Iterator[None]:
        """Keys come one by one while this is open; the terminal is as it was afterwards."""
        if not sys.stdin.isatty():
            yield
            return
        loop, file = asyncio.get_running_loop(), sys.stdin.fileno()
        before = termios.tcgetattr(file)

        def read() -> None:
            try:
                data = os.read(file, 64)
            except OSError:
                data = b""
            if not data:
                loop.remove_reader(file)
            self._keys.extend(data.decode("ascii", "ignore").lower())
            self._pressed.set()

        tty.setcbreak(file)
        loop.add_reader(file, read)
        try:
            yield
        finally:
            loop.remove_reader(file)
            termios.tcsetattr(file, termios.TCSADRAIN, before)


def _meant(vehicle: Vehicle | None) -> tuple[object, ...]:
    """Vehicle, flight and hold that are shown."""
    if vehicle is None:
        return ()
    session = vehicle.session if vehicle.proven is None else vehicle.proven.session
    return vehicle.name, session, _hold(vehicle)


def _hold(vehicle: Vehicle | None) -> int:
    """Number of the hold that is shown; 0: none."""
    return 0 if vehicle is None or vehicle.stream is None else vehicle.stream.hold or 0
