"""The link between the vehicles of a team: 50 times a second each sends the other its state, one UDP datagram an announcement.

A datagram is `MAGIC`, the sender's session, the receiver's session, a counter (each little endian, 64 bits), the state as MessagePack,
and the first 16 bytes of the HMAC-SHA256 of sender, receiver and everything before. Only who has the key can announce.

A session is a random number that a process draws when it opens the link. An announcement counts only if it names the session of the
process that receives it: a recording from before that process was started, of this or another flight, proves nothing. Such a datagram
is answered, so that the two learn each other's sessions within two announcements. Within a session the counter increases strictly, and
a session that another has replaced has ended: a datagram that is repeated, or sent back, is rejected. No clock is involved, so that a
process that is started again is heard at once, whatever the computer's time is. The guardian has a session of its own and takes that
of the other vehicle from the flight process's heartbeats. The sender's port does not matter, because the guardian's is another.

In simulated time both vehicles share the clock, and the counter is simulated time: a datagram arrives `SIMULATED_DELAY_S` after it was
sent, however early it lies in the socket, so that it does not matter which of two processes works first at one instant.
"""

from __future__ import annotations

import errno
import hashlib
import hmac
import math
import secrets
import socket
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, Self

from companion.io.arrival import arrived_s
from companion.io.mocap import sockets
from companion.io.protocols import DeviceError
from companion.model.codec import RecordError, from_packet, to_packet
from companion.model.observations import LinkCounts
from companion.model.team import PartnerState, TeamState
from companion.runtime import simulated_time
from companion.runtime.clock import Clock

PERIOD_S: Final = 0.02
SIMULATED_DELAY_S: Final = 0.002
KEY_BYTES_MIN: Final = 32
LOST_S: Final = 0.3
"""Silence of a session after which another one is answered."""
MAGIC: Final = b"CTL2"
"""First bytes of a datagram; the digit is the version."""
_HEAD: Final = struct.Struct("<4sQQQ")
_PROOF_BYTES: Final = 16
_BYTES_MAX: Final = 512
_DOMAIN: Final = "companion team 2"
_EPSILON_S: Final = 1e-9


@dataclass(frozen=True, slots=True)
class TeamSettings:
    """`devices.team` of the vehicle file, with the same keys."""

    port: int
    partner: str | None
    partner_port: int
    key_file: str | None


def read_key(settings: TeamSettings) -> bytes:
    """Return the key that both vehicles share.

    Raises:
        DeviceError: there is none, or it is too short.
    """
    expected = f"expected a file with {KEY_BYTES_MIN} random bytes or more, the same on both vehicles"
    if settings.key_file is None:
        raise DeviceError(f"devices.team.key_file: missing; {expected}")
    try:
        key = Path(settings.key_file).expanduser().read_bytes()
    except OSError as error:
        raise DeviceError(f"devices.team.key_file: {settings.key_file}: {error.strerror}; {expected}") from None
    if len(key) < KEY_BYTES_MIN:
        raise DeviceError(f"devices.team.key_file: {settings.key_file}: has {len(key)} bytes; {expected}")
    return key


class TeamSender:
    """Sends this vehicle's state, from any port.

    Raises:
        DeviceError: address or key is missing, the key is too short, or there is no way to the other vehicle.
    """

    def __init__(self, settings: TeamSettings) -> None:
        if settings.partner is None:
            raise DeviceError(
                "devices.team.partner: missing; expected the IPv4 address of the other vehicle's computer"
            )
        self.key, self._to = read_key(settings), (settings.partner, settings.partner_port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
                route.connect(self._to)
                self.own_ip = str(route.getsockname()[0])
        except OSError as error:
            self.close()
            raise DeviceError(f"team {settings.partner}:{settings.partner_port}: {error.strerror}") from None
        self.partner_ip = settings.partner
        self._direction = direction(self.own_ip, *self._to)
        self.session = 1 + secrets.randbits(62)
        self.answers = 0
        """Session of the other vehicle's process; 0 if it is unknown."""
        self._counter = 0
        self._due_s = -math.inf
        self.sent = self.unsent = 0

    def announce(self, said: TeamState, t_s: float) -> None:
        """Send the state, unless less than `PERIOD_S` have passed since the last; never waits.

        Args:
            t_s: time on any clock that increases.
        """
        if t_s < self._due_s:
            return
        self._due_s = t_s + PERIOD_S - _EPSILON_S
        self._counter = max(self._counter + 1, _simulated_ns())
        announcement = Announcement(self.session, self.answers, self._counter, said)
        try:
            self._socket.sendto(encoded(announcement, self.key, self._direction), self._to)
            self.sent += 1
        except OSError:  # the network is down, or an ICMP error from an earlier datagram
            self.unsent += 1

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Announcement(NamedTuple):
    """Content of a datagram."""

    session: int
    answers: int
    """Session of the receiver, as far as the sender knows; 0 if it does not."""
    counter: int
    said: TeamState


class TeamLink:
    """The flight process's end of the link; implements `companion.io.protocols.Team`."""

    def __init__(self, settings: TeamSettings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._simulated = simulated_time.current()
        self._counts = LinkCounts()
        self._partner_session, self._counter = 0, -1
        """Session of the newest announcement, and its counter."""
        self._ended: set[int] = set()
        """Sessions that have been replaced by another."""
        self._arriving: list[tuple[float, Announcement]] = []
        """Announcements in the order of their arrival, the newest last; those of the future have not arrived yet."""
        self._newest: PartnerState | None = None

    async def __aenter__(self) -> Self:
        """Open both directions.

        Raises:
            DeviceError: the key is missing or too short, there is no way to the other vehicle, or the port is in use.
        """
        settings = self._settings
        self._sender = sender = TeamSender(settings)
        try:
            self._socket = sockets.open_udp(sender.own_ip, settings.port)
        except OSError as error:
            sender.close()
            used = "another program holds the port; close it or change devices.team.port"
            found = used if error.errno == errno.EADDRINUSE else error.strerror
            raise DeviceError(f"team {sender.own_ip}:{settings.port}: {found}") from None
        self._direction = direction(sender.partner_ip, *self._socket.getsockname())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._sender.close()
        self._socket.close()

    @property
    def port(self) -> int:
        """Return the port at which this vehicle receives."""
        return int(self._socket.getsockname()[1])

    def counts(self) -> LinkCounts:
        """Return the numbers of announcements and of rejected datagrams."""
        return self._counts._replace(sent=self._sender.sent, unsent=self._sender.unsent)

    def announce(self, said: TeamState) -> None:
        """Send this vehicle's state; called in each tick. Never waits."""
        self._sender.announce(said, self._clock())

    def newest(self) -> PartnerState | None:
        """Return the newest announcement of the other vehicle that has arrived, or None before the first. Never waits."""
        for datagram in sockets.waiting(self._socket):
            if datagram.sender_ip != self._sender.partner_ip:
                self._count("foreign")
            elif isinstance(found := decoded(datagram.data, self._sender.key, self._direction), str):
                self._count(found)
            else:
                at_s = arrived_s(datagram.ancillary, self._clock)
                if self._simulated is not None:
                    at_s = found.counter * 1e-9 + SIMULATED_DELAY_S
                self._arriving.append((at_s, found))
        now_s = self._clock() + _EPSILON_S
        while self._arriving and self._arriving[0][0] <= now_s:
            self._hear(*self._arriving.pop(0))
        return self._newest

    @property
    def partner_session(self) -> int:
        """Return the session of the newest announcement; 0 before the first."""
        return self._partner_session

    def _hear(self, at_s: float, heard: Announcement) -> None:
        """Accept an announcement, or count why not."""
        session, answers, counter, said = heard
        if answers != self._sender.session:
            self._count("unanswered")
            if self._newest is None or at_s - self._newest.stamp_s > LOST_S:
                self._sender.answers = session
        elif session in self._ended or (session == self._partner_session and counter <= self._counter):
            self._count("repeated")
        else:
            self._count("received")
            if session != self._partner_session:
                self._ended.add(self._partner_session)
            self._partner_session = self._sender.answers = session
            self._counter = counter
            self._newest = PartnerState(stamp_s=at_s, said=said)

    def _count(self, name: str) -> None:
        self._counts = self._counts._replace(**{name: getattr(self._counts, name) + 1})


def direction(sender_ip: str, receiver_ip: str, receiver_port: int) -> bytes:
    """Return what the proof covers in front of the datagram: a datagram that is sent back has another."""
    return f"{_DOMAIN}\n{sender_ip}\n{receiver_ip}:{receiver_port}\n".encode()


def encoded(announcement: Announcement, key: bytes, way: bytes) -> bytes:
    """Return the datagram of an announcement; `way` is that of `direction`."""
    session, answers, counter, said = announcement
    text = _HEAD.pack(MAGIC, session, answers, counter) + to_packet(said)
    return text + _proof(way + text, key)


def decoded(datagram: bytes, key: bytes, way: bytes) -> Announcement | str:
    """Return the announcement of a datagram, or the field of `LinkCounts` that counts why it is rejected."""
    text, proof = datagram[:-_PROOF_BYTES], datagram[-_PROOF_BYTES:]
    if not _HEAD.size + _PROOF_BYTES < len(datagram) <= _BYTES_MAX or text[: len(MAGIC)] != MAGIC:
        return "malformed"
    if not hmac.compare_digest(proof, _proof(way + text, key)):
        return "forged"
    try:
        said: TeamState = from_packet(TeamState, text[_HEAD.size :])
    except RecordError:
        return "malformed"
    times_s = said.together.go_server_s or 0.0, said.together.plan_s, said.server_s or 0.0
    if not all(map(math.isfinite, (*times_s, *said.position_world_m))):
        return "malformed"
    _, session, answers, counter = _HEAD.unpack_from(text)
    return Announcement(session, answers, counter, said)


def _proof(text: bytes, key: bytes) -> bytes:
    return hmac.digest(key, text, hashlib.sha256)[:_PROOF_BYTES]


def _simulated_ns() -> int:
    """Return simulated time; 0 in real time."""
    simulated = simulated_time.current()
    return 0 if simulated is None else max(0, round(simulated.now() * 1e9))
