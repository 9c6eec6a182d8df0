"""`companion monitor --text`: shows the vehicle in a terminal, also over SSH; without a terminal it prints one line per second."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from collections.abc import Iterator

from rich.console import Console
from rich.live import Live

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import Ack, Topic
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import Failed, Sent, ack_text
from companion.ground.station.station import Station
from companion.ground.station.text_view import Notice, StationStatus, render, status_line
from companion.ground.station.vehicles import ReceivedRecord, Vehicle
from companion.model.commands import SAFER_COMMANDS, TABLE
from companion.model.types import OperatorCommand
from companion.runtime.console import terminal_console
from companion.runtime.tasks import until_first
from companion.runtime.terminal import pressed, raw_keys

PERIOD_S = 0.125
LINE_PERIOD_S = 1.0
CONFIRM_KEY = "y"
"""Confirms a command. It is another key than the command's, because a terminal does not tell a repeated key from a held one."""
APART_S, CONFIRM_S = 0.25, 3.0
"""Shortest and longest time after a command's key at which `CONFIRM_KEY` confirms it. Keys that arrive faster are pasted: "easy" must
not start a flight.
"""
KEYS_MAX = 100
KEYS = {row.key: row.command for row in TABLE}


async def watch_in_terminal(access: BrokerAccess, signer: Signer | str, only: str | None) -> None:
    """Show the vehicles until the `q` key is pressed, or until cancelled.

    Raises:
        BrokerRefused: the broker refuses the connection.
    """
    console = terminal_console()
    if not console.is_terminal:
        lines = _Lines()
        station = Station(access, signer, only, lambda received: None, lines.on_change)
        await until_first(station.run(), lines.run(station))
        return
    screen = _Screen(console)
    station = Station(access, signer, only, screen.on_record, lambda connected, text: None)
    await until_first(station.run(), screen.run(station))


class _Lines:
    """Prints lines, for pipes."""

    def on_change(self, connected: bool, text: str) -> None:
        print(text, flush=True)

    async def run(self, station: Station) -> None:
        print(station.link.text, flush=True)
        while True:
            await asyncio.sleep(LINE_PERIOD_S)
            clock = time.strftime("%H:%M:%S")
            for vehicle in list(station.tracker.vehicles.values()):
                print(f"{clock} {status_line(vehicle, time.monotonic())}", flush=True)


class _Screen:
    """Full-screen display with keys."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._notices: deque[Notice] = deque(maxlen=10)
        self._chosen: str | None = None
        self._unconfirmed: tuple[OperatorCommand, float, tuple[object, ...]] | None = None
        """Command that awaits `CONFIRM_KEY`, when the wait began, and its target at that time (`_target`)."""
        self._keys: deque[str] = deque(maxlen=KEYS_MAX)
        self._pressed = asyncio.Event()

    def on_record(self, received: ReceivedRecord) -> None:
        """Show acks to all operators."""
        if received.topic is Topic.ACK:
            ack: Ack = received.record
            text = f"{received.vehicle}: {ack_text(ack)} ({ack.operator})"
            self._notices.append(Notice(text, "bold green" if ack.accepted else "bold red"))

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
                            hold = _hold(vehicle) if command is OperatorCommand.RESUME else None
                            errands.create_task(station.commands.send(vehicle.name, command, self._on_progress, hold))
                    live.update(
                        render(self._vehicle(station), time.monotonic(), self._station_status(station)), refresh=True
                    )
                    await self._key_or_period()

    def _vehicle(self, station: Station) -> Vehicle | None:
        """Return the displayed vehicle: the selected one, else the first one present."""
        known = station.tracker.vehicles
        if self._chosen not in known:
            there = station.tracker.present(time.monotonic()) or sorted(known)
            self._chosen = there[0] if there else None
        return known.get(self._chosen) if self._chosen is not None else None

    def _command(self, key: str, station: Station) -> OperatorCommand | None:
        """Return the command to send for this key press. None if the key has no command or the command still needs confirmation."""
        if key == "n":
            names = sorted(station.tracker.vehicles)
            if self._chosen in names:
                self._chosen = names[(names.index(self._chosen) + 1) % len(names)]
        command, vehicle = KEYS.get(key), self._vehicle(station)
        unconfirmed, self._unconfirmed = self._unconfirmed, None
        if command is not None and vehicle is None:
            self._notices.append(Notice(f"{command.value}: not sent, because no vehicle is heard", "bold yellow"))
            return None
        if command in SAFER_COMMANDS:
            return command
        now_s, target = time.monotonic(), _target(vehicle)
        if command is not None:
            self._unconfirmed = (command, now_s, target)
            text = f"{command.value}? press {CONFIRM_KEY} after {APART_S:g} to {CONFIRM_S:g} s"
            self._notices.append(Notice(text, "bold yellow"))
        elif key == CONFIRM_KEY and unconfirmed is not None:
            asked, asked_s, asked_target = unconfirmed
            if APART_S <= now_s - asked_s < CONFIRM_S and asked_target == target:
                return asked
            self._notices.append(Notice(f"{asked.value}: not confirmed; begin again", "bold yellow"))
        return None

    def _on_progress(self, note: Sent | Failed) -> None:
        if isinstance(note, Sent):
            self._notices.append(Notice(f"{note.vehicle}: {note.command.value} sent ..."))
        else:
            self._notices.append(Notice(f"{note.vehicle}: {note.command.value}: {note.text}", "bold red"))

    def _station_status(self, station: Station) -> StationStatus:
        names = sorted(station.tracker.vehicles)
        return StationStatus(
            broker=station.link.text,
            connected=station.link.connected,
            operator=station.commands.operator,
            view_only_reason=station.commands.view_only_reason,
            others=tuple(names) if len(names) > 1 else (),
            rejected=station.tracker.rejected,
            notices=tuple(self._notices),
        )

    async def _key_or_period(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PERIOD_S):
                await self._pressed.wait()
        self._pressed.clear()

    @contextlib.contextmanager
    def _key_presses(self) -> Iterator[None]:
        """Context in which keys are read one by one; restores the terminal afterwards."""
        with raw_keys() as terminal:
            if terminal is None:
                yield
                return
            loop = asyncio.get_running_loop()

            def read() -> None:
                keys = ""
                with contextlib.suppress(OSError):
                    keys = pressed(terminal)
                if not keys:
                    loop.remove_reader(terminal)
                self._keys.extend(keys.lower())
                self._pressed.set()

            loop.add_reader(terminal, read)
            try:
                yield
            finally:
                loop.remove_reader(terminal)


def _target(vehicle: Vehicle | None) -> tuple[object, ...]:
    if vehicle is None:
        return ()
    session = vehicle.session if vehicle.proven is None else vehicle.proven.session
    return vehicle.name, session, _hold(vehicle)


def _hold(vehicle: Vehicle | None) -> int:
    return 0 if vehicle is None or vehicle.stream is None else vehicle.stream.hold or 0
