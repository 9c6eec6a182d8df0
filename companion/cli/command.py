"""`companion command NAME`: send one signed command to one vehicle and print its answer."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import time
from typing import Any

from companion.cli.monitor import add_broker_options, vehicle_option
from companion.config.document import ConfigError
from companion.ground.protocol.access import broker_access
from companion.ground.protocol.messages import Topic
from companion.ground.station.command_sender import FALLBACK_ADVICE, Failed, Sent, ack_text, signer_of
from companion.ground.station.link import BrokerRefused
from companion.ground.station.station import Station
from companion.ground.station.vehicles import LIVE_S
from companion.model.commands import COMMANDS, SAFER_COMMANDS, TABLE
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from companion.model.types import OperatorCommand
from companion.runtime.console import print_error
from companion.runtime.tasks import until_first

FOUND_S = 5.0
"""Timeout for connecting to the broker and for the vehicle's first message."""


def add_parser(commands: Any) -> None:
    command = commands.add_parser(
        "command",
        help="command a vehicle from the ground: " + ", ".join(COMMANDS),
        description="Send one signed command and wait for the vehicle's answer. Exit code 0: done, 3: refused, 5: no answer. "
        + "; ".join(f"{row.command.value}: {row.what}" for row in TABLE)
        + ".",
    )
    command.add_argument("name", choices=list(COMMANDS), metavar="NAME", help="see above")
    command.add_argument(
        "--hold",
        type=int,
        metavar="N",
        help="with resume: number of the hold to end, as in the telemetry (default: the current hold)",
    )
    add_broker_options(command)
    command.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    only = vehicle_option(arguments)
    access = broker_access(arguments.broker, arguments.login, arguments.ca)
    signer = signer_of(access, arguments.operators, arguments.operator)
    if isinstance(signer, str):
        raise ConfigError(f"companion command: {signer}")
    name = OperatorCommand(arguments.name)
    if arguments.hold is not None and (name is not OperatorCommand.RESUME or arguments.hold < 1):
        raise ConfigError(f"--hold {arguments.hold}: expected the number of a hold, 1 or more, and only with resume")
    commander = _Commander(name, only, arguments.hold)
    station = Station(
        access,
        signer,
        None,  # all vehicles, so that the report of a misspelt name can list them
        lambda heard: commander.changed.set(),
        lambda connected, text: commander.changed.set(),
        topics=(Topic.STATE, Topic.ACK, Topic.STREAM),
        in_order=True,
    )
    try:
        asyncio.run(until_first(station.run(), commander.command(station)))
    except BrokerRefused as error:
        print_error(f"companion command: {error}")
        return EXIT_REFUSED
    return commander.code


class _Commander:
    def __init__(self, command: OperatorCommand, only: str | None, hold: int | None) -> None:
        self._command = command
        self._hold = hold
        self._only = only
        self.changed = asyncio.Event()
        self.code = EXIT_LOST
        self._sent = False

    async def command(self, station: Station) -> None:
        """Find the vehicle, send the command, print the result."""
        try:
            async with asyncio.timeout(FOUND_S):
                vehicle = await self._found(station)
        except TimeoutError:
            self._end(EXIT_LOST, f"{self._why_nobody(station)}; {FALLBACK_ADVICE}")
            return
        if vehicle is None:
            return
        ack = await station.commands.send(vehicle, self._command, self._hear, self._hold)
        if ack is None:
            self.code = EXIT_LOST if self._sent else EXIT_REFUSED
        elif ack.accepted:
            self.code = EXIT_OK
            print(f"{vehicle}: {ack_text(ack)}", flush=True)
        else:
            self._end(EXIT_REFUSED, f"{vehicle}: {ack_text(ack)}")

    async def _found(self, station: Station) -> str | None:
        """Return the vehicle to command, None after reporting several; retained messages arrive before the link is connected."""
        connected_s: float | None = None
        while True:
            self.changed.clear()
            known = station.tracker.vehicles
            if station.link.connected:
                connected_s = connected_s or time.monotonic()
                # A flying vehicle has sent an authenticated message by then, whatever its state message says.
                waited = time.monotonic() - connected_s > LIVE_S
                names = [self._only] if self._only is not None else station.tracker.present(time.monotonic())
                if len(names) > 1 and self._command in SAFER_COMMANDS:
                    if not waited:
                        names = []  # a retained state does not prove a flight
                    elif len(proven := station.tracker.proven(time.monotonic())) == 1:
                        others = ", ".join(name for name in names if name not in proven)
                        print_error(
                            f"companion command: sent to {proven[0]}; no authenticated messages from: {others}; "
                            "to command another: --vehicle NAME"
                        )
                        return proven[0]
                if len(names) > 1:
                    self._end(
                        EXIT_BAD_INPUT, f"there are several vehicles ({', '.join(names)}); choose one: --vehicle NAME"
                    )
                    return None
                if names and names[0] in known:
                    vehicle = known[names[0]]
                    if vehicle.proven is not None or (
                        waited and (vehicle.stream is not None or vehicle.ended(time.monotonic()))
                    ):
                        return names[0]
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(LIVE_S):
                    await self.changed.wait()

    def _why_nobody(self, station: Station) -> str:
        if not station.link.connected:
            return station.link.text
        there = [
            f"{name} ({known.state.presence.value if known.state is not None else 'state unknown'})"
            for name, known in sorted(station.tracker.vehicles.items())
        ]
        whom = "a vehicle" if self._only is None else repr(self._only)
        return f"no message from {whom} at the broker within {FOUND_S:g} s" + (
            f"; known: {', '.join(there)}" if there else ""
        )

    def _hear(self, note: Sent | Failed) -> None:
        if isinstance(note, Sent):
            self._sent = True
        else:
            print_error(f"companion command: {note.vehicle}: {note.command.value}: {note.text}")

    def _end(self, code: int, text: str) -> None:
        self.code = code
        print_error(f"companion command: {text}")
