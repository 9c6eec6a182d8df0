"""Commands from the ground: signed, published, and repeated until the vehicle answers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.commands import make_command
from companion.ground.protocol.keys import default_operators_file, load_operators
from companion.ground.protocol.messages import Ack, Topic
from companion.ground.protocol.proof import Signer
from companion.ground.station.link import Link, LinkError
from companion.ground.station.vehicles import Vehicle, VehicleTracker
from companion.model.codec import to_json
from companion.model.commands import SAFER_COMMANDS
from companion.model.types import OperatorCommand

ANSWER_S = 1.5
"""Timeout for the vehicle's `Ack`."""
ATTEMPTS = 3
"""Attempts to send a command that makes the flight safer, each with its own nonce. Other commands are sent once."""
FALLBACK_ADVICE = "use Ctrl-C or the pilot's switch"
NO_ANSWER = f"no answer from the vehicle within {ANSWER_S:g} s: {FALLBACK_ADVICE}"


def signer_of(
    access: BrokerAccess, operators_file: str | None, operator: str | None, *, view_only: bool = False
) -> Signer | str:
    """Return the operator who signs commands at this station, or why commands are not possible.

    Args:
        access: settings of the broker; a vehicle accepts no commands over an unencrypted connection to another computer.
        operators_file: file of operators and their keys; None for this user's own file.
        operator: name in the file; None for the only one.
        view_only: whether commands are disabled.

    Raises:
        ConfigError: the file cannot be used, or it does not contain the name.
    """
    if view_only:
        return "this monitor was started with --view-only"
    if not access.trusted:
        return (
            f"the connection to {access.address} is not encrypted; commands need mqtts:// or a broker on this computer"
        )
    if operators_file is None and not access.address.loopback and not default_operators_file().exists():
        return "this computer has no operator key that the vehicle knows; give a file: --operators FILE"
    operators = load_operators(operators_file)
    if operator is None:
        if len(operators.names) != 1:
            return f"{operators.source} lists several operators ({', '.join(operators.names)}); choose one: --operator NAME"
        operator = operators.names[0]
    return Signer(operator, operators.key(operator))


@dataclass(frozen=True, slots=True)
class Sent:
    """A command was published."""

    vehicle: str
    command: OperatorCommand
    nonce: str


@dataclass(frozen=True, slots=True)
class Failed:
    """A command, or one attempt of it, has failed."""

    vehicle: str
    command: OperatorCommand
    text: str


Notify = Callable[["Sent | Failed"], None]


def ack_text(ack: Ack) -> str:
    """Return an ack for display, such as ``hold: holding`` or ``resume refused: too little tether left``."""
    name = ack.command.value
    if ack.accepted:
        return f"{name}: {ack.text}"
    return ack.text if ack.text.startswith(f"{name} refused") else f"{name} refused: {ack.text}"


class CommandSender:
    """Sends commands of one operator to any known vehicle.

    Args:
        signer: the operator, or why there is none.
    """

    def __init__(self, link: Link, watch: VehicleTracker, signer: Signer | str) -> None:
        self._link = link
        self._tracker = watch
        self._signer = signer
        self._waiting: dict[str, asyncio.Future[Ack]] = {}
        self._newest: dict[str, object] = {}
        """The newest command for each vehicle, while it is under way."""

    @property
    def operator(self) -> str | None:
        """Name of the operator who signs commands here, or None."""
        return self._signer.operator if isinstance(self._signer, Signer) else None

    @property
    def view_only_reason(self) -> str | None:
        """Reason why this station cannot send commands; None if it can."""
        return self._signer if isinstance(self._signer, str) else None

    def on_ack(self, ack: Ack) -> None:
        """Process an `Ack`; `VehicleTracker` has verified it if it is for this operator."""
        answer = self._waiting.get(ack.nonce)
        if answer is not None and not answer.done():
            answer.set_result(ack)

    async def send(self, vehicle: str, command: OperatorCommand, notify: Notify, hold: int | None = None) -> Ack | None:
        """Send a command; return when the vehicle has answered or all attempts have failed. A newer command for the same vehicle,
        or a new flight, ends the attempts.

        Args:
            notify: called when an attempt is sent, and when one fails.
            hold: number of the hold that a RESUME ends, as the operator saw it; None for the hold of the newest message.

        Returns:
            The vehicle's answer, or None if there was none; `notify` has received the reason.
        """
        problem = self._problem(vehicle)
        if problem is not None or not isinstance(self._signer, Signer):
            notify(Failed(vehicle, command, problem or str(self._signer)))
            return None
        session = _session(self._tracker.vehicles.get(vehicle))
        order = self._newest[vehicle] = object()
        answer: asyncio.Future[Ack] = asyncio.get_running_loop().create_future()
        nonces: list[str] = []
        tries = ATTEMPTS if command in SAFER_COMMANDS else 1
        try:
            for number in range(1, tries + 1):
                problem = await self._attempt(self._signer, vehicle, command, hold, session, answer, nonces, notify)
                if problem is None:
                    return answer.result()
                current = _session(self._tracker.vehicles.get(vehicle))
                on = number < tries and self._newest.get(vehicle) is order and current == session
                notify(Failed(vehicle, command, problem + (f" (sent again, {number + 1} of {tries})" if on else "")))
                if not on:
                    return None
        finally:
            for nonce in nonces:
                del self._waiting[nonce]
            if self._newest.get(vehicle) is order:
                del self._newest[vehicle]
        return None

    async def _attempt(
        self,
        signer: Signer,
        vehicle: str,
        command: OperatorCommand,
        hold: int | None,
        session: str | None,
        answer: asyncio.Future[Ack],
        nonces: list[str],
        notify: Notify,
    ) -> str | None:
        """Make one attempt of at most `ANSWER_S`; return None if the answer has arrived, else why the attempt failed."""
        known = self._tracker.vehicles.get(vehicle)
        proven = None if known is None else known.proven
        if proven is None or proven.session != session:  # the vehicle was known when the command was given
            return f"a new flight of {vehicle} has started"
        t_ms, ends = proven.now_ms(time.monotonic(), known is not None and known.simulated), 0
        if command is OperatorCommand.RESUME:
            ends = proven.hold if hold is None else hold
        try:
            signed = make_command(command, vehicle, session, signer.operator, signer.key, t_ms, ends)
        except ValueError as error:
            return f"no command can be created for {vehicle}: {error}"
        nonces.append(signed.nonce)
        self._waiting[signed.nonce] = answer
        notify(Sent(vehicle, command, signed.nonce))
        problem = NO_ANSWER
        try:
            async with asyncio.timeout(ANSWER_S):
                try:
                    await self._link.publish(Topic.COMMAND.of(vehicle), to_json(signed))
                except LinkError as error:
                    problem = f"{error}; {FALLBACK_ADVICE}"
                await asyncio.shield(answer)  # an earlier attempt may still be answered
        except TimeoutError:
            return problem
        return None

    def _problem(self, vehicle: str) -> str | None:
        """Return why a command cannot be created or would be rejected, or None. While proven messages arrive, unproven ones never
        block a command.
        """
        known = self._tracker.vehicles.get(vehicle)
        if known is None or (known.session is None and known.proven is None):
            return f"no vehicle {vehicle!r:.60} is known"
        if known.proven is not None and known.proven.live(time.monotonic()):
            return None
        if known.ended(time.monotonic()):
            return f"the flight of {vehicle} has ended"
        if known.state is not None and known.state.session == known.session and not known.state.commands:
            return f"{vehicle} accepts no commands: {known.state.text or 'disabled'}; {FALLBACK_ADVICE}"
        if known.proven is not None:
            return None
        if known.stream is None:
            return f"no message from {vehicle} has arrived, so a command cannot be dated; {FALLBACK_ADVICE}"
        text = "the vehicle does not have that key, or another program uses its name"
        return f"no message from {vehicle} could be verified with {self.operator}'s key: {text}; {FALLBACK_ADVICE}"


def _session(known: Vehicle | None) -> str | None:
    return None if known is None or known.proven is None else known.proven.session
