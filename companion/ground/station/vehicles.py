"""State of the vehicles as a ground station knows it: the newest record of each kind and each flight's clock. No I/O.

A ground station with an operator's key tells stream messages that the vehicle has proven (`companion.ground.protocol.proof`) from
messages that anyone may have sent. Only proven messages date commands; while they arrive, unproven ones are rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from companion.config.ground import VEHICLE_NAME
from companion.ground.protocol.commands import FlightClock
from companion.ground.protocol.messages import (
    RECORDS,
    Ack,
    Events,
    MessageError,
    Preflight,
    Presence,
    Scene,
    State,
    Stream,
    Topic,
    decode,
    vehicle_of,
)
from companion.ground.protocol.proof import Signer, ack_proven, stream_proven

HEARD_TOPICS = (Topic.STATE, Topic.SCENE, Topic.PREFLIGHT, Topic.EVENTS, Topic.STREAM, Topic.ACK)
VEHICLES_MAX = 64
"""More are not remembered: whoever was silent longest is forgotten, those with proven messages last."""
LIVE_S = 1.0
"""A vehicle whose stream is younger is there."""


@dataclass(frozen=True, slots=True)
class Heard:
    """One record that a vehicle sent."""

    vehicle: str
    topic: Topic
    record: Any
    age_s: float | None = None
    """Of a `Stream`: by how much it took longer than the quickest of the last ones. Else None."""


@dataclass(slots=True)
class Proven:
    """What a command is made of: the session, the flight clock and the hold of proven stream messages. Mutable; for `Watch` alone."""

    session: str
    wall_s: float
    """`Stream.wall_s` of the newest one."""
    t_s: float
    """`Stream.t_s` of the newest one."""
    hold: int
    """`Stream.hold` of the newest one; 0: it does not hold."""
    heard_s: float
    """Monotonic clock of this computer, when the last one came."""
    clock: FlightClock = field(default_factory=FlightClock)

    def live(self, now_s: float) -> bool:
        """Proven messages come in."""
        return now_s - self.heard_s < LIVE_S

    def now_ms(self, now_s: float) -> int:
        """The flight clock now; never ahead of the vehicle's own."""
        now_ms = self.clock.now_ms(now_s)
        assert now_ms is not None  # it has heard one at least
        return now_ms


@dataclass(slots=True)
class Vehicle:
    """What is known of one vehicle. Mutable; `Watch` alone changes it."""

    name: str
    session: str | None = None
    state: State | None = None
    scene: Scene | None = None
    preflight: Preflight | None = None
    events: Events | None = None
    stream: Stream | None = None
    stream_heard_s: float | None = None
    """Monotonic clock of this computer."""
    heard_s: float = 0.0
    clock: FlightClock = field(default_factory=FlightClock)
    """For the age of what is shown."""
    proven: Proven | None = None
    """None: no stream message was proven for the operator of this ground station."""

    def stream_age_s(self, now_s: float) -> float | None:
        """Since the newest stream message came; None: none has come in this session."""
        return None if self.stream_heard_s is None else now_s - self.stream_heard_s

    def live(self, now_s: float) -> bool:
        """Its stream comes in."""
        age_s = self.stream_age_s(now_s)
        return age_s is not None and age_s < LIVE_S

    @property
    def ended(self) -> bool:
        """Its flight is over, and said so."""
        return self.state is not None and self.state.presence is Presence.ENDED and self.state.session == self.session


class Watch:
    """Takes every message of a broker; keeps what is one, counts what is none.

    Args:
        only: name of the one vehicle that is watched; None: all.
        signer: the operator who commands from here; None: nobody does, and nothing can be proven.
    """

    def __init__(self, only: str | None = None, signer: Signer | None = None) -> None:
        self._only = only
        self._signer = signer
        self.vehicles: dict[str, Vehicle] = {}
        self.rubbish = 0
        """Messages that were thrown away."""
        self.rubbish_text: str | None = None
        """Topic and fault of the last one."""

    def take(self, topic: str, payload: bytes, retained: bool, now_s: float) -> Heard | None:
        """The record that a message holds, remembered; None if it is none of ours.

        Args:
            topic: full name.
            payload: as it came.
            retained: the broker kept it: it may be of any age.
            now_s: monotonic clock of this computer.
        """
        try:
            named = vehicle_of(topic)
            if named is None or named[1] not in HEARD_TOPICS or VEHICLE_NAME.fullmatch(named[0]) is None:
                raise MessageError("not a topic of a vehicle")
            name, kind = named
            if self._only is not None and name != self._only:
                return None
            if not payload and retained:
                return None  # MQTT's way to say that nothing is retained any more
            record: Any = decode(RECORDS[kind], payload)
            if isinstance(record, State) and record.vehicle != name:
                raise MessageError(f"is of vehicle {record.vehicle!r:.60}")
            if isinstance(record, Ack) and not self._believed(record, name):
                raise MessageError("is not proven by the vehicle")
            if isinstance(record, Stream) and not retained and not self._prove(name, record, now_s):
                raise MessageError("is not proven by the vehicle, as those before it were")
        except MessageError as error:
            self.rubbish += 1
            self.rubbish_text = f"{topic!r:.80}: {error}"
            return None
        return self._remember(self._vehicle(name, now_s), kind, record, retained, now_s)

    def reject(self, topic: str, error: Exception) -> None:
        """Count a message that could not be handled for a reason that nobody thought of."""
        self.rubbish += 1
        self.rubbish_text = f"{topic!r:.80}: {type(error).__name__}: {str(error)!r:.80}"

    def there(self, now_s: float) -> list[str]:
        """Names of the vehicles that are there: in flight by their word, or heard a moment ago."""
        return sorted(
            name
            for name, known in self.vehicles.items()
            if known.live(now_s)
            or (known.state is not None and known.state.presence in (Presence.FLYING, Presence.SILENT))
        )

    def proven(self, now_s: float) -> list[str]:
        """Names of the vehicles whose proven messages come in."""
        return sorted(
            name for name, known in self.vehicles.items() if known.proven is not None and known.proven.live(now_s)
        )

    def _believed(self, ack: Ack, name: str) -> bool:
        """Answers to this operator are proven; those to others cannot be judged here."""
        signer = self._signer
        return signer is None or ack.operator != signer.operator or ack_proven(ack, name, signer.key)

    def _prove(self, name: str, stream: Stream, now_s: float) -> bool:
        """Take what a proven stream message proves; False: it is not to be shown either.

        One of another flight counts if that flight is the later one by the vehicle's wall clock, or if the flight that was proven
        before has fallen silent. So a recording of an earlier flight takes the place of none that is under way.
        """
        known = self.vehicles.get(name)
        proven = known.proven if known is not None else None
        if self._signer is None or not stream_proven(stream, name, self._signer.key):
            return proven is None or not proven.live(now_s)
        if proven is not None and proven.session != stream.session:
            if proven.live(now_s) and stream.wall_s <= proven.wall_s:
                return False
            proven = None
        if proven is None:
            proven = Proven(stream.session, stream.wall_s, stream.t_s, stream.hold or 0, now_s)
            self._vehicle(name, now_s).proven = proven
        elif stream.t_s <= proven.t_s:
            return False  # a copy of what was heard before: the vehicle sends none without a new tick
        proven.wall_s, proven.t_s, proven.hold, proven.heard_s = stream.wall_s, stream.t_s, stream.hold or 0, now_s
        proven.clock.heard(stream.t_s, now_s)
        return True

    def _vehicle(self, name: str, now_s: float) -> Vehicle:
        known = self.vehicles.get(name)
        if known is None:
            if len(self.vehicles) >= VEHICLES_MAX:
                del self.vehicles[min(self.vehicles.values(), key=lambda v: (v.proven is not None, v.heard_s)).name]
            known = self.vehicles[name] = Vehicle(name)
        known.heard_s = now_s
        return known

    def _remember(self, known: Vehicle, kind: Topic, record: Any, retained: bool, now_s: float) -> Heard | None:
        if isinstance(record, (State, Stream)) and record.session != known.session:
            if known.session is None or not retained:
                known.session = record.session
                known.stream = known.stream_heard_s = None
                known.clock = FlightClock()
        age_s = None
        match record:
            case State():
                known.state = record
            case Scene():
                known.scene = record
            case Preflight():
                known.preflight = record
            case Events():
                known.events = record
            case Stream():
                if retained:
                    return None  # nobody keeps a stream: of unknown age, it would look alive
                known.stream, known.stream_heard_s = record, now_s
                known.clock.heard(record.t_s, now_s)
                flight_ms = known.clock.now_ms(now_s)
                age_s = None if flight_ms is None else max(0.0, flight_ms / 1e3 - record.t_s)
        return Heard(known.name, kind, record, age_s)
