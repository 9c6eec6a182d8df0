"""Signed commands: how the ground makes one, and how the vehicle decides whether to believe it.

A command is signed with its operator's key, end to end: what stands between ground and vehicle (broker, logins, TLS) may fail or be
open, and nobody without a key commands the vehicle. The signature is HMAC-SHA256 (RFC 2104) over `canonical`.

What a key cannot prove is checked beside it: the command is of this flight (session), made now (the vehicle's own flight clock, which
the ground takes from `Stream` messages that the vehicle has proven), for the first time (nonce), and not one of very many (rate). None
of it is touched by a message that is not well signed, so nobody without a key can have a genuine command refused.

A command that was refused once is never accepted later, whatever the reason was.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, TypeAlias

from companion.config.ground import VEHICLE_NAME
from companion.ground.protocol.keys import OPERATOR_NAME, SAFER, Operators
from companion.ground.protocol.messages import COMMAND_MAX_BYTES, VERSION, Command, CommandName
from companion.ground.protocol.strict_json import WireError, parse
from companion.model.codec import RecordError, from_jsonable

DOMAIN = "companion command 2"
"""First line of every signed text: a signature made for anything else is none of a command."""
AHEAD_MAX_S = 0.5
"""A command may be so much ahead of the vehicle's clock."""
REFUSED_MAX = 512
"""Nonces of refused commands that are kept for each operator and command. Beyond that a time is kept: see `_Heard.refuse`."""
ANSWERS_PER_S = 20
"""Refused commands that are answered: replaying old ones makes no flood of answers."""
_NOTHING = (float("inf"), float("-inf"))
"""A range of dates that holds none."""
_T_MS_MAX = 2**53
_TEXT_MAX = 160
_SESSION = re.compile(r"[\x21-\x7e]{1,64}")
_HOLD_MAX = 2**31
_NONCE = re.compile(r"[0-9a-f]{32}")
_MAC = re.compile(r"[0-9a-f]{64}")


class Limits(NamedTuple):
    """How fresh and how frequent a command has to be."""

    age_max_s: float
    per_s: int
    """Accepted per operator and second."""


LIMITS = {
    CommandName.HOLD: Limits(5.0, 20),
    CommandName.LAND: Limits(5.0, 20),
    CommandName.ABORT: Limits(5.0, 20),
    CommandName.RESUME: Limits(2.0, 1),
    CommandName.START: Limits(2.0, 1),
}
"""Each command has a rate of its own: however many HOLDs there are, LAND gets through."""


class Reason(StrEnum):
    """Why a command was refused."""

    OVERSIZED = "oversized"
    MALFORMED = "malformed"
    WRONG_VERSION = "wrong_version"
    WRONG_VEHICLE = "wrong_vehicle"
    UNKNOWN_OPERATOR = "unknown_operator"
    BAD_SIGNATURE = "bad_signature"
    WRONG_SESSION = "wrong_session"
    EARLY = "early"
    STALE = "stale"
    FROM_THE_FUTURE = "from_the_future"
    REPLAYED = "replayed"
    OVERTAKEN = "overtaken"
    RETAINED = "retained"
    TOO_MANY = "too_many"
    NOT_ALLOWED = "not_allowed"


@dataclass(frozen=True, slots=True)
class Accepted:
    """Genuine, fresh, of this flight, for the first time, by somebody who may."""

    command: Command


@dataclass(frozen=True, slots=True)
class Refused:
    """Not to be followed."""

    reason: Reason
    text: str
    """One line for people, printable; may quote what was sent."""
    command: Command | None = None
    """Set if it was well signed and its sender is to be told by an `Ack`. None: anybody may have sent it, or it is a copy of one
    that was answered, or `ANSWERS_PER_S` are used up."""


Verdict: TypeAlias = Accepted | Refused


def canonical(command: Command) -> bytes:
    """What is signed: `DOMAIN`, then every field but ``mac`` in the record's order, one per line, the last with its line end too.

    Raises:
        ValueError: a field could be read in two ways, or is none that a command may have.
    """
    problem = _unspeakable(command)
    if problem is not None:
        raise ValueError(problem)
    return (
        f"{DOMAIN}\n{command.v}\n{command.vehicle}\n{command.session}\n{command.operator}\n{command.command.value}\n"
        f"{command.t_ms}\n{command.hold}\n{command.nonce}\n"
    ).encode("ascii")


def sign(command: Command, key: bytes) -> Command:
    """The command with its signature, whatever stood there before.

    Raises:
        ValueError: it has a field that no command may have.
    """
    return replace(command, mac=_mac(command, key))


def make_command(
    name: CommandName, vehicle: str, session: str, operator: str, key: bytes, t_ms: int, hold: int = 0
) -> Command:
    """A signed command with a nonce of its own; `companion.ground.protocol.messages.encode` makes the payload.

    Args:
        name: what is asked for.
        vehicle: the vehicle's name in topics.
        session: `State.session` or `Stream.session` of the flight that is meant.
        operator: who asks.
        key: the operator's, `Operators.key`.
        t_ms: the vehicle's flight clock now, `FlightClock.now_ms`.
        hold: number of the hold that a RESUME is to end, `Stream.hold`; 0: none.

    Raises:
        ValueError: a field that no command may have; says which.
    """
    unsigned = Command(VERSION, vehicle, session, operator, name, t_ms, hold, secrets.token_hex(16), "")
    return sign(unsigned, key)


def _mac(command: Command, key: bytes) -> str:
    return hmac.digest(key, canonical(command), hashlib.sha256).hex()


def _unspeakable(command: Command) -> str | None:
    """None, or what is wrong with a field of the signed text."""
    if VEHICLE_NAME.fullmatch(command.vehicle) is None:
        return f"vehicle: {command.vehicle!r:.60} is no vehicle's name"
    if _SESSION.fullmatch(command.session) is None:
        return f"session: {command.session!r:.60} is no session"
    if OPERATOR_NAME.fullmatch(command.operator) is None:
        return f"operator: {command.operator!r:.60} is no operator's name"
    if not -_T_MS_MAX < command.t_ms < _T_MS_MAX:
        return "t_ms: out of range"
    if not 0 <= command.hold < _HOLD_MAX:
        return "hold: out of range"
    if _NONCE.fullmatch(command.nonce) is None:
        return f"nonce: {command.nonce!r:.60}, expected 32 hexadecimal digits in lower case"
    return None


class _Heard:
    """What is remembered of one operator's commands of one name. Bounded, however many come."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.accepted_t_s: deque[float] = deque(maxlen=limits.per_s)
        """Flight clock at which the newest were accepted."""
        self._followed: dict[str, float] = {}
        """Nonce, and the flight clock at which the command is stale in any case. The rate bounds how many there are."""
        self._refused: dict[str, float] = {}
        """The same of those that were refused, at most `REFUSED_MAX`."""
        self._closed_t_s = {False: _NOTHING, True: _NOTHING}
        """Oldest and newest date of refused commands whose nonces found no room: nothing between is accepted any more. Those from
        the future (True) are kept apart, lest they close what is dated between now and then."""

    @property
    def size(self) -> int:
        """Nonces that are kept."""
        return len(self._followed) + len(self._refused)

    def knows(self, command: Command) -> bool:
        """Whether it was accepted or refused before, or may have been."""
        nonce, t_s = command.nonce, command.t_ms / 1000.0
        closed = any(from_t_s <= t_s <= until_t_s for from_t_s, until_t_s in self._closed_t_s.values())
        return closed or nonce in self._followed or nonce in self._refused

    def follow(self, command: Command, now_t_s: float) -> None:
        self.accepted_t_s.append(now_t_s)
        self._followed[command.nonce] = command.t_ms / 1000.0 + self.limits.age_max_s

    def refuse(self, command: Command, now_t_s: float) -> None:
        if len(self._refused) < REFUSED_MAX:
            self._refused[command.nonce] = command.t_ms / 1000.0 + self.limits.age_max_s
        else:
            t_s = command.t_ms / 1000.0
            future = t_s - now_t_s > AHEAD_MAX_S
            from_t_s, until_t_s = self._closed_t_s[future]
            self._closed_t_s[future] = min(from_t_s, t_s), max(until_t_s, t_s)

    def sweep(self, now_t_s: float) -> None:
        """Forget what is stale: the clock never goes back, so it stays stale."""
        stale_t_s = now_t_s - self.limits.age_max_s - 1.0  # well beyond what rounding can bring back
        for future, (from_t_s, until_t_s) in self._closed_t_s.items():
            self._closed_t_s[future] = _NOTHING if until_t_s < stale_t_s else (max(from_t_s, stale_t_s), until_t_s)
        self._followed = {nonce: until for nonce, until in self._followed.items() if until >= now_t_s}
        self._refused = {nonce: until for nonce, until in self._refused.items() if until >= now_t_s}


class Verifier:
    """The vehicle's judge of what comes in on its ``command`` topic. No I/O and no clock; it remembers what it has judged.

    Args:
        operators: who may command.
        vehicle: own name in topics.
        session: of this flight.
    """

    def __init__(self, operators: Operators, vehicle: str, session: str) -> None:
        self.operators = operators
        self._vehicle = vehicle
        self._session = session
        self._now_t_s = float("-inf")
        self._swept_t_s = float("-inf")
        self._stopped_t_s = float("-inf")
        """Newest date of an accepted HOLD, LAND or ABORT, whoever gave it."""
        self._heard = {
            (name, command): _Heard(limits) for name in operators.names for command, limits in LIMITS.items()
        }
        """Each command of each operator has its own room: no flood of one takes that of another."""
        self._answered: deque[float] = deque(maxlen=ANSWERS_PER_S)

    def check(self, payload: bytes, retained: bool, now_t_s: float | None) -> Verdict:
        """Judge one message; never raises, whatever the payload.

        Args:
            payload: as it came.
            retained: the broker had kept it: it may be of any age, and whoever comes next would hear it again.
            now_t_s: flight clock, s; None: it has not begun. It never goes back here: of two calls the later time counts.
        """
        if len(payload) > COMMAND_MAX_BYTES:
            return Refused(Reason.OVERSIZED, f"{len(payload)} bytes, at most {COMMAND_MAX_BYTES} expected")
        try:
            command = _parsed(payload)
        except RecursionError:  # nested nearly as deep as the parser goes: too deep to be shown
            return Refused(Reason.MALFORMED, "nested too deep")
        if isinstance(command, Refused):
            return command
        if command.vehicle != self._vehicle:
            return Refused(Reason.WRONG_VEHICLE, f"for {command.vehicle}, this is {self._vehicle}")
        key = self.operators.find(command.operator)
        if key is None:
            return Refused(Reason.UNKNOWN_OPERATOR, f"{command.operator} is none of this vehicle's operators")
        if not hmac.compare_digest(_mac(command, key), command.mac):
            return Refused(Reason.BAD_SIGNATURE, f"not signed with the key of {command.operator}")
        if now_t_s is not None:
            self._now_t_s = max(self._now_t_s, now_t_s)
        if self._now_t_s - self._swept_t_s >= 1.0:
            self._swept_t_s = self._now_t_s
            for heard in self._heard.values():
                heard.sweep(self._now_t_s)
        return self._judge(command, retained)

    def _judge(self, command: Command, retained: bool) -> Verdict:
        """Of a command that its operator has made, whenever that was. One that could come again is remembered, accepted or not."""
        heard = self._heard[command.operator, command.command]
        now_t_s, t_s = self._now_t_s, command.t_ms / 1000.0
        who = f"{command.command.value} of {command.operator}"
        if command.session != self._session:
            return self._answer(Reason.WRONG_SESSION, f"{who} is for another flight", command)
        if now_t_s - t_s > heard.limits.age_max_s:
            text = f"{who} is {now_t_s - t_s:.1f} s old, at most {heard.limits.age_max_s:.1f} s expected"
            return self._answer(Reason.STALE, text, command)
        if heard.knows(command):
            return Refused(Reason.REPLAYED, f"{who} was heard before")
        if retained:
            heard.refuse(command, now_t_s)
            return Refused(Reason.RETAINED, "a command that the broker kept; commands are sent, never retained")
        problem = self._problem(command, heard, who)
        if problem is not None:
            heard.refuse(command, now_t_s)
            return self._answer(*problem, command)
        heard.follow(command, now_t_s)
        if command.command in SAFER:
            self._stopped_t_s = max(self._stopped_t_s, t_s)
        return Accepted(command)

    def _problem(self, command: Command, heard: _Heard, who: str) -> tuple[Reason, str] | None:
        """Why a command that was never heard before is refused; None: it is not."""
        now_t_s, t_s = self._now_t_s, command.t_ms / 1000.0
        if now_t_s == float("-inf"):
            return Reason.EARLY, "the flight has not begun"
        if t_s - now_t_s > AHEAD_MAX_S:
            text = f"{who} is {t_s - now_t_s:.1f} s ahead of the flight's clock, at most {AHEAD_MAX_S:.1f} s expected"
            return Reason.FROM_THE_FUTURE, text
        if not self.operators.may(command.operator, command.command):
            return Reason.NOT_ALLOWED, f"{command.operator} may make things safer only, not {command.command.value}"
        if command.command not in SAFER and t_s < self._stopped_t_s:
            return Reason.OVERTAKEN, f"{who} was given before a hold, land or abort that was accepted"
        accepted_t_s = heard.accepted_t_s
        if len(accepted_t_s) == heard.limits.per_s and now_t_s - accepted_t_s[0] < 1.0:
            return Reason.TOO_MANY, f"{who}: more than {heard.limits.per_s} a second"
        return None

    def _answer(self, reason: Reason, text: str, command: Command) -> Refused:
        if len(self._answered) == ANSWERS_PER_S and self._now_t_s - self._answered[0] < 1.0:
            return Refused(reason, text)
        self._answered.append(self._now_t_s)
        return Refused(reason, text, command)


def _parsed(payload: bytes) -> Command | Refused:
    """The command as it claims to be, every field in range; or why it is none."""
    try:
        data = parse(payload)
    except WireError as error:
        return Refused(Reason.MALFORMED, str(error))
    if not isinstance(data, dict):
        return Refused(Reason.MALFORMED, "no JSON object")
    version = data.get("v")
    if type(version) is int and version != VERSION:
        return Refused(Reason.WRONG_VERSION, f"version {version}, expected {VERSION}")
    try:
        command = from_jsonable(Command, data)
    except RecordError as error:
        return Refused(Reason.MALFORMED, _shown(str(error)))
    problem = _unspeakable(command)
    if problem is not None:
        return Refused(Reason.MALFORMED, _shown(problem))
    if _MAC.fullmatch(command.mac) is None:
        return Refused(Reason.MALFORMED, "mac: expected 64 hexadecimal digits in lower case")
    return command


def _shown(text: str) -> str:
    """Printable and short, whatever is quoted in it."""
    return text.encode("ascii", "backslashreplace").decode("ascii")[:_TEXT_MAX]


class FlightClock:
    """What a ground station knows of the flight clock of one session. A new session wants a new one.

    A message says what the clock was when it was sent, so it shows the clock late, never early: of all that were heard lately the one
    with the largest difference to the local clock was the fastest, and the others do not set the clock back.
    """

    LATELY_S = 10.0

    def __init__(self) -> None:
        self._heard: deque[tuple[float, float]] = deque()
        """(local time, flight clock - local clock): later in time, smaller in difference."""

    def heard(self, t_s: float, monotonic_s: float) -> None:
        """Take the time of one message.

        Args:
            t_s: `Stream.t_s`.
            monotonic_s: local monotonic clock when it was received, s.
        """
        difference_s = t_s - monotonic_s
        heard = self._heard
        while heard and heard[-1][1] <= difference_s:
            heard.pop()
        heard.append((monotonic_s, difference_s))
        while heard[0][0] < monotonic_s - self.LATELY_S:
            heard.popleft()

    def now_ms(self, monotonic_s: float) -> int | None:
        """The flight clock now, ms; None as long as nothing was heard. Goes on when the vehicle has fallen silent."""
        return None if not self._heard else int((monotonic_s + self._heard[0][1]) * 1000.0)
