"""Signed commands: created by the ground station, verified by the vehicle.

A command is signed with its operator's key, end to end: even if everything between ground and vehicle (broker, logins, TLS) is
compromised, the vehicle accepts no command without a key. The signature is HMAC-SHA256 (RFC 2104) over `canonical`.

A signature does not prove that a command is current. So the vehicle also checks that the command names this flight (session), is
recent according to the vehicle's own flight clock (which the ground station reads from proven `Stream` messages), is new (nonce)
and within a rate limit. A message without a valid signature changes none of this state, so a sender without a key cannot cause a
genuine command to be refused.

A refused command is never accepted later, whatever the reason for the refusal.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeAlias

from msgspec.structs import replace

from companion.config.ground import VEHICLE_NAME
from companion.ground.protocol.keys import OPERATOR_NAME, Operators
from companion.ground.protocol.messages import COMMAND_MAX_BYTES, VERSION, Command
from companion.ground.protocol.strict_json import StrictJsonError, parse
from companion.model.codec import RecordError, from_jsonable
from companion.model.commands import SAFER_COMMANDS, TABLE, CommandRow
from companion.model.types import OperatorCommand

DOMAIN = "companion command 2"
"""First line of every signed text; it makes a signature for any other purpose invalid for commands."""
AHEAD_MAX_S = 0.5
"""Largest time by which a command may be ahead of the vehicle's clock."""
REFUSED_MAX = 512
"""Maximum number of nonces of refused commands kept per operator and command name; after that, a range of times is kept
(`_History.add_refused`).
"""
ACKS_PER_S = 20
"""Limit of acks for refused commands, so that replayed commands do not cause a flood of acks."""
_NOTHING = (float("inf"), float("-inf"))
"""An empty range of times."""
_T_MS_MAX = 2**53
_TEXT_MAX = 160
_SESSION = re.compile(r"[\x21-\x7e]{1,64}")
_HOLD_MAX = 2**31
_NONCE = re.compile(r"[0-9a-f]{32}")
_MAC = re.compile(r"[0-9a-f]{64}")


class Reason(StrEnum):
    """Reason for refusing a command."""

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
    """The command is genuine, recent, new and for this flight, and its operator is allowed to give it."""

    command: Command


@dataclass(frozen=True, slots=True)
class Refused:
    """The command must not be executed."""

    reason: Reason
    text: str
    """One printable line for the operator; may quote the payload."""
    command: Command | None = None
    """The command if signed and to be answered by an `Ack`: not from an unknown sender, not a copy, below `ACKS_PER_S`."""


Verdict: TypeAlias = Accepted | Refused


def canonical(command: Command) -> bytes:
    """Return the signed text: `DOMAIN`, then every field except ``mac`` in the record's order, one per line, each with a line end.

    Raises:
        ValueError: a field is out of range or ambiguous.
    """
    problem = _field_problem(command)
    if problem is not None:
        raise ValueError(problem)
    return (
        f"{DOMAIN}\n{command.v}\n{command.vehicle}\n{command.session}\n{command.operator}\n{command.command.value}\n"
        f"{command.t_ms}\n{command.hold}\n{command.nonce}\n"
    ).encode("ascii")


def sign(command: Command, key: bytes) -> Command:
    """Return the command with its signature; an existing signature is replaced.

    Raises:
        ValueError: a field is out of range.
    """
    return replace(command, mac=_mac(command, key))


def make_command(
    name: OperatorCommand, vehicle: str, session: str, operator: str, key: bytes, t_ms: int, hold: int = 0
) -> Command:
    """Return a signed command with a new nonce; `companion.model.codec.to_json` makes the payload.

    Args:
        session: `State.session` or `Stream.session` of the flight.
        t_ms: current flight clock of the vehicle, `FlightClock.now_ms`.
        hold: number of the hold that a RESUME ends, `Stream.hold`; 0 for other commands.

    Raises:
        ValueError: a field is out of range; the message names it.
    """
    unsigned = Command(
        v=VERSION,
        vehicle=vehicle,
        session=session,
        operator=operator,
        command=name,
        t_ms=t_ms,
        hold=hold,
        nonce=secrets.token_hex(16),
        mac="",
    )
    return sign(unsigned, key)


def _mac(command: Command, key: bytes) -> str:
    return hmac.digest(key, canonical(command), hashlib.sha256).hex()


def _field_problem(command: Command) -> str | None:
    if command.command is OperatorCommand.NONE:
        return "command: 'none', expected a command"
    if VEHICLE_NAME.fullmatch(command.vehicle) is None:
        return f"vehicle: {command.vehicle!r:.60} is not a vehicle name"
    if _SESSION.fullmatch(command.session) is None:
        return f"session: {command.session!r:.60} is not a session id"
    if OPERATOR_NAME.fullmatch(command.operator) is None:
        return f"operator: {command.operator!r:.60} is not an operator name"
    if not -_T_MS_MAX < command.t_ms < _T_MS_MAX:
        return "t_ms: out of range"
    if not 0 <= command.hold < _HOLD_MAX:
        return "hold: out of range"
    if _NONCE.fullmatch(command.nonce) is None:
        return f"nonce: {command.nonce!r:.60}, expected 32 hexadecimal digits in lower case"
    return None


class _History:
    """Bounded history of one operator's commands of one name."""

    def __init__(self, limits: CommandRow) -> None:
        self.limits = limits
        self.accepted_t_s: deque[float] = deque(maxlen=limits.per_s)
        """Flight clock of the newest accepted commands."""
        self._accepted: dict[str, float] = {}
        """Nonces of accepted commands, with the flight clock at which each becomes stale. Bounded by the rate limit."""
        self._refused: dict[str, float] = {}
        """Nonces of refused commands, at most `REFUSED_MAX`, with the flight clock at which each becomes stale."""
        self._closed_range_t_s = {False: _NOTHING, True: _NOTHING}
        """Oldest and newest time of refused commands whose nonces were not kept: no command from this range is accepted. Commands
        from the future (True) have a separate range, so that they do not block the time until then.
        """

    @property
    def size(self) -> int:
        """Number of nonces that are kept."""
        return len(self._accepted) + len(self._refused)

    def contains(self, command: Command) -> bool:
        """Whether the command was, or may have been, accepted or refused before."""
        nonce, t_s = command.nonce, command.t_ms / 1000.0
        closed = any(from_t_s <= t_s <= until_t_s for from_t_s, until_t_s in self._closed_range_t_s.values())
        return closed or nonce in self._accepted or nonce in self._refused

    def add_accepted(self, command: Command, now_t_s: float) -> None:
        self.accepted_t_s.append(now_t_s)
        self._accepted[command.nonce] = command.t_ms / 1000.0 + self.limits.age_max_s

    def add_refused(self, command: Command, now_t_s: float) -> None:
        if len(self._refused) < REFUSED_MAX:
            self._refused[command.nonce] = command.t_ms / 1000.0 + self.limits.age_max_s
        else:
            t_s = command.t_ms / 1000.0
            future = t_s - now_t_s > AHEAD_MAX_S
            from_t_s, until_t_s = self._closed_range_t_s[future]
            self._closed_range_t_s[future] = min(from_t_s, t_s), max(until_t_s, t_s)

    def forget_stale(self, now_t_s: float) -> None:
        """Forget stale commands; they stay stale because the clock never goes back."""
        stale_t_s = now_t_s - self.limits.age_max_s - 1.0  # a margin well above rounding errors
        for future, (from_t_s, until_t_s) in self._closed_range_t_s.items():
            self._closed_range_t_s[future] = (
                _NOTHING if until_t_s < stale_t_s else (max(from_t_s, stale_t_s), until_t_s)
            )
        self._accepted = {nonce: until for nonce, until in self._accepted.items() if until >= now_t_s}
        self._refused = {nonce: until for nonce, until in self._refused.items() if until >= now_t_s}


class Verifier:
    """Verifies messages of the vehicle's ``command`` topic, of which it keeps a history. No I/O and no clock."""

    def __init__(self, operators: Operators, vehicle: str, session: str) -> None:
        self.operators = operators
        self._vehicle = vehicle
        self._session = session
        self._now_t_s = float("-inf")
        self._swept_t_s = float("-inf")
        self._stopped_t_s = float("-inf")
        """Newest time of an accepted HOLD, LAND or ABORT of any operator."""
        self._histories = {(name, row.command): _History(row) for name in operators.names for row in TABLE}
        """One history per operator and command, so that a flood of one does not affect another."""
        self._answered_t_s: deque[float] = deque(maxlen=ACKS_PER_S)

    def check(self, payload: bytes, retained: bool, now_t_s: float | None) -> Verdict:
        """Verify one message; never raises, whatever the payload.

        Args:
            retained: whether the broker had retained the message; if so its age is unknown, and later subscribers would receive it
                again.
            now_t_s: flight clock, s; None before it starts. The verifier uses the latest time of all calls.
        """
        if len(payload) > COMMAND_MAX_BYTES:
            return Refused(Reason.OVERSIZED, f"{len(payload)} bytes, expected at most {COMMAND_MAX_BYTES}")
        try:
            command = _parsed(payload)
        except RecursionError:  # nested nearly as deep as the parser allows
            return Refused(Reason.MALFORMED, "nested too deeply")
        if isinstance(command, Refused):
            return command
        if command.vehicle != self._vehicle:
            return Refused(Reason.WRONG_VEHICLE, f"for {command.vehicle}; this is {self._vehicle}")
        key = self.operators.find_key(command.operator)
        if key is None:
            return Refused(Reason.UNKNOWN_OPERATOR, f"{command.operator} is not an operator of this vehicle")
        if not hmac.compare_digest(_mac(command, key), command.mac):
            return Refused(Reason.BAD_SIGNATURE, f"not signed with the key of {command.operator}")
        if now_t_s is not None:
            self._now_t_s = max(self._now_t_s, now_t_s)
        if self._now_t_s - self._swept_t_s >= 1.0:
            self._swept_t_s = self._now_t_s
            for history in self._histories.values():
                history.forget_stale(self._now_t_s)
        return self._verify_signed(command, retained)

    def _verify_signed(self, command: Command, retained: bool) -> Verdict:
        """Verify a correctly signed command of any age. A command that could be sent again is remembered, whether accepted or not."""
        history = self._histories[command.operator, command.command]
        now_t_s, t_s = self._now_t_s, command.t_ms / 1000.0
        who = f"{command.command.value} of {command.operator}"
        if command.session != self._session:
            return self._refuse(Reason.WRONG_SESSION, f"{who} is for another flight", command)
        if now_t_s - t_s > history.limits.age_max_s:
            text = f"{who} is {now_t_s - t_s:.1f} s old (limit {history.limits.age_max_s:.1f} s)"
            return self._refuse(Reason.STALE, text, command)
        if history.contains(command):
            return Refused(Reason.REPLAYED, f"{who} was received before")
        if retained:
            history.add_refused(command, now_t_s)
            return Refused(Reason.RETAINED, "the broker had retained the command; commands are never retained")
        problem = self._problem(command, history, who)
        if problem is not None:
            history.add_refused(command, now_t_s)
            return self._refuse(*problem, command)
        history.add_accepted(command, now_t_s)
        if command.command in SAFER_COMMANDS:
            self._stopped_t_s = max(self._stopped_t_s, t_s)
        return Accepted(command)

    def _problem(self, command: Command, history: _History, who: str) -> tuple[Reason, str] | None:
        now_t_s, t_s = self._now_t_s, command.t_ms / 1000.0
        if now_t_s == float("-inf"):
            return Reason.EARLY, "the flight has not started"
        if t_s - now_t_s > AHEAD_MAX_S:
            text = f"{who} is {t_s - now_t_s:.1f} s ahead of the flight clock (limit {AHEAD_MAX_S:.1f} s)"
            return Reason.FROM_THE_FUTURE, text
        if not self.operators.is_allowed(command.operator, command.command):
            return (
                Reason.NOT_ALLOWED,
                f"{command.operator} may only give hold, land and abort, not {command.command.value}",
            )
        if command.command not in SAFER_COMMANDS and t_s < self._stopped_t_s:
            return Reason.OVERTAKEN, f"{who} is older than an accepted hold, land or abort"
        accepted_t_s = history.accepted_t_s
        if len(accepted_t_s) == history.limits.per_s and now_t_s - accepted_t_s[0] < 1.0:
            return Reason.TOO_MANY, f"{who}: more than {history.limits.per_s} a second"
        return None

    def _refuse(self, reason: Reason, text: str, command: Command) -> Refused:
        if len(self._answered_t_s) == ACKS_PER_S and self._now_t_s - self._answered_t_s[0] < 1.0:
            return Refused(reason, text)
        self._answered_t_s.append(self._now_t_s)
        return Refused(reason, text, command)


def _parsed(payload: bytes) -> Command | Refused:
    """Return the payload's command if every field is in range, otherwise the refusal."""
    try:
        data = parse(payload)
    except StrictJsonError as error:
        return Refused(Reason.MALFORMED, str(error))
    if not isinstance(data, dict):
        return Refused(Reason.MALFORMED, "not a JSON object")
    version = data.get("v")
    if type(version) is int and version != VERSION:
        return Refused(Reason.WRONG_VERSION, f"version {version}, expected {VERSION}")
    try:
        command = from_jsonable(Command, data)
    except RecordError as error:
        return Refused(Reason.MALFORMED, _shown(str(error)))
    problem = _field_problem(command)
    if problem is not None:
        return Refused(Reason.MALFORMED, _shown(problem))
    if _MAC.fullmatch(command.mac) is None:
        return Refused(Reason.MALFORMED, "mac: expected 64 hexadecimal digits in lower case")
    return command


def _shown(text: str) -> str:
    return text.encode("ascii", "backslashreplace").decode("ascii")[:_TEXT_MAX]
