"""Commands from the ground: signed, sent, and followed until the vehicle has answered."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.commands import make_command
from companion.ground.protocol.keys import load_operators, own_file
from companion.ground.protocol.messages import Ack, CommandName, Topic, encode
from companion.ground.protocol.proof import Signer
from companion.ground.station.link import Link, LinkError
from companion.ground.station.vehicles import Vehicle, Watch

ANSWER_S = 1.5
"""For the vehicle's `Ack`."""
TRIES = 3
"""Of a command that makes things safer, each with a nonce of its own. Others are sent once: who asks for a start that was lost asks
again himself."""
REPEATED = frozenset({CommandName.HOLD, CommandName.LAND, CommandName.ABORT})
INSTEAD = "use Ctrl-C or the pilot's switch"
NO_ANSWER = f"no answer from the vehicle within {ANSWER_S:g} s: {INSTEAD}"


def signer_of(
    access: BrokerAccess, operators_file: str | None, operator: str | None, *, view_only: bool = False
) -> Signer | str:
    """Who commands from here, or why nobody does.

    Args:
        access: a plain connection to a broker elsewhere carries no commands: the vehicle would hear none that came that way.
        operators_file: file of operators and their keys; None: this user's own.
        operator: name in the file; None: the only one in it.
        view_only: nobody shall.

    Raises:
        ConfigError: the file or the name is wrong.
    """
    if view_only:
        return "this monitor was started with --view-only"
    if not access.trusted:
        return f"{access.address} is another computer and the way there is plain; commands need mqtts:// or a broker on this computer"
    if operators_file is None and not access.address.loopback and not own_file().exists():
        return "no key of an operator is here, and one that is made here is known to no vehicle; name a file: --operators FILE"
    operators = load_operators(operators_file)
    if operator is None:
        if len(operators.names) != 1:
            return f"{operators.source} holds several operators ({', '.join(operators.names)}); say who you are: --operator NAME"
        operator = operators.names[0]
    return Signer(operator, operators.key(operator))


@dataclass(frozen=True, slots=True)
class Sent:
    """A command went out."""

    vehicle: str
    command: CommandName
    nonce: str


@dataclass(frozen=True, slots=True)
class Failed:
    """A command, or one try of it, came to nothing."""

    vehicle: str
    command: CommandName
    text: str


Tell = Callable[["Sent | Failed"], None]


def told(ack: Ack) -> str:
    """An answer as people read it: ``hold: holding``, ``resume refused: too little tether left``."""
    name = ack.command.value
    if ack.accepted:
        return f"{name}: {ack.text}"
    return ack.text if ack.text.startswith(f"{name} refused") else f"{name} refused: {ack.text}"


class Orders:
    """Gives commands of one operator to any vehicle that is watched.

    Args:
        link: to the broker.
        watch: knows session and clock of each vehicle.
        signer: the operator, or why there is none.
    """

    def __init__(self, link: Link, watch: Watch, signer: Signer | str) -> None:
        self._link = link
        self._watch = watch
        self._signer = signer
        self._waiting: dict[str, asyncio.Future[Ack]] = {}
        self._newest: dict[str, object] = {}

    @property
    def operator(self) -> str | None:
        """Who commands from here."""
        return self._signer.operator if isinstance(self._signer, Signer) else None

    @property
    def why_not(self) -> str | None:
        """Why nobody commands from here; None: somebody does."""
        return self._signer if isinstance(self._signer, str) else None

    def heard(self, ack: Ack) -> None:
        """Take every `Ack` that comes in; those to this operator are proven (`Watch`)."""
        answer = self._waiting.get(ack.nonce)
        if answer is not None and not answer.done():
            answer.set_result(ack)

    async def give(self, vehicle: str, command: CommandName, tell: Tell, hold: int | None = None) -> Ack | None:
        """Give a command; over when the vehicle has answered, or all tries are used up.

        A newer command for the same vehicle, or a new flight, ends the tries of an older one.

        Args:
            vehicle: its name.
            command: what is asked for.
            tell: hears of every try as it goes out, and of every one that failed.
            hold: number of the hold that a RESUME is to end, as the operator saw it; None: the one that stands by the newest message.

        Returns:
            The vehicle's answer; None: there was none, `tell` knows why.
        """
        problem = self._impossible(vehicle)
        if problem is not None or not isinstance(self._signer, Signer):
            tell(Failed(vehicle, command, problem or str(self._signer)))
            return None
        session = _session(self._watch.vehicles.get(vehicle))
        order = self._newest[vehicle] = object()
        answer: asyncio.Future[Ack] = asyncio.get_running_loop().create_future()
        nonces: list[str] = []
        tries = TRIES if command in REPEATED else 1
        try:
            for number in range(1, tries + 1):
                problem = await self._try(self._signer, vehicle, command, hold, session, answer, nonces, tell)
                if problem is None:
                    return answer.result()
                current = _session(self._watch.vehicles.get(vehicle))
                on = number < tries and self._newest[vehicle] is order and current == session
                tell(Failed(vehicle, command, problem + (f" (sent again, {number + 1} of {tries})" if on else "")))
                if not on:
                    return None
        finally:
            for nonce in nonces:
                del self._waiting[nonce]
            if self._newest[vehicle] is order:
                del self._newest[vehicle]
        return None

    async def _try(
        self,
        signer: Signer,
        vehicle: str,
        command: CommandName,
        hold: int | None,
        session: str | None,
        answer: asyncio.Future[Ack],
        nonces: list[str],
        tell: Tell,
    ) -> str | None:
        """One try, `ANSWER_S` long at most; None: the answer is there, otherwise what went wrong."""
        known = self._watch.vehicles.get(vehicle)
        proven = None if known is None else known.proven
        if proven is None or proven.session != session:  # was there a moment ago
            return f"a new flight of {vehicle} has begun"
        t_ms, ends = proven.now_ms(time.monotonic()), 0
        if command is CommandName.RESUME:
            ends = proven.hold if hold is None else hold
        try:
            signed = make_command(command, vehicle, session, signer.operator, signer.key, t_ms, ends)
        except ValueError as error:
            return f"no command can be made for what calls itself {vehicle}: {error}"
        nonces.append(signed.nonce)
        self._waiting[signed.nonce] = answer
        tell(Sent(vehicle, command, signed.nonce))
        problem = NO_ANSWER
        try:
            async with asyncio.timeout(ANSWER_S):
                try:
                    await self._link.publish(Topic.COMMAND.of(vehicle), encode(signed))
                except LinkError as error:
                    problem = f"{error}; {INSTEAD}"
                await asyncio.shield(answer)  # an earlier try may still be answered
        except TimeoutError:
            return problem
        return None

    def _impossible(self, vehicle: str) -> str | None:
        """Why no command can be made, or would be heard; None: it is sent.

        What nobody has proven never speaks against a command as long as proven messages come in.
        """
        known = self._watch.vehicles.get(vehicle)
        if known is None or (known.session is None and known.proven is None):
            return f"nothing is known of a vehicle {vehicle!r:.60}"
        if known.proven is not None and known.proven.live(time.monotonic()):
            return None
        if known.ended:
            return f"the flight of {vehicle} has ended"
        if known.state is not None and known.state.session == known.session and not known.state.commands:
            return f"{vehicle} hears no commands: {known.state.text or 'switched off'}; {INSTEAD}"
        if known.proven is not None:
            return None
        if known.stream is None:
            return f"nothing was heard from {vehicle} yet, so no command can be dated; {INSTEAD}"
        text = "it does not have this key, or another program speaks for it"
        return f"no message of {vehicle} is proven for {self.operator}: {text}; {INSTEAD}"


def _session(known: Vehicle | None) -> str | None:
    return None if known is None or known.proven is None else known.proven.session
