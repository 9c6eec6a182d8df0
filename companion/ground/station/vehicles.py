"""State of the vehicles in a ground station: the newest record of each kind and each flight's clock. No I/O.

A ground station with an operator's key distinguishes stream messages with the vehicle's proof (`companion.ground.protocol.proof`)
from messages that anyone may have sent. Only proven messages are used to date commands; while they arrive, unproven ones are
rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from companion.config.ground import VEHICLE_NAME
from companion.ground.protocol.flight_clock import FlightClock
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

VEHICLE_TOPICS = (Topic.STATE, Topic.SCENE, Topic.PREFLIGHT, Topic.EVENTS, Topic.STREAM, Topic.ACK)
VEHICLES_MAX = 64
"""Maximum number of tracked vehicles; the one that has been silent longest is forgotten first, those with proven messages last."""
LIVE_S = 1.0
"""Age of the newest stream message below which a vehicle is present."""


@dataclass(frozen=True, slots=True)
class ReceivedRecord:
    """One record from a vehicle."""

    vehicle: str
    topic: Topic
    record: Any
    age_s: float | None = None
    """Delay of a `Stream` beyond that of the fastest recent message; None for other records."""


@dataclass(slots=True)
class ProvenState:
    """State from stream messages with a valid proof, for new commands: session, clock and hold. `VehicleTracker` changes it."""

    session: str
    wall_s: float
    """`Stream.wall_s` of the newest proven message."""
    t_s: float
    """`Stream.t_s` of the newest proven message."""
    hold: int
    """`Stream.hold` of the newest proven message; 0 if the vehicle does not hold."""
    received_s: float
    """Local monotonic clock at which the newest proven message arrived."""
    clock: FlightClock = field(default_factory=FlightClock)

    def live(self, now_s: float) -> bool:
        """Whether proven messages are arriving."""
        return now_s - self.received_s < LIVE_S

    def now_ms(self, now_s: float, simulated: bool = False) -> int:
        """Return the current flight clock; never ahead of the vehicle's own."""
        now_ms = self.clock.now_ms(now_s, simulated)
        assert now_ms is not None  # at least one message has arrived
        return now_ms


@dataclass(slots=True)
class Vehicle:
    """Known state of one vehicle. Only `VehicleTracker` changes it."""

    name: str
    session: str | None = None
    state: State | None = None
    scene: Scene | None = None
    preflight: Preflight | None = None
    events: Events | None = None
    stream: Stream | None = None
    stream_received_s: float | None = None
    """Local monotonic clock at which the newest stream message arrived."""
    received_s: float = 0.0
    clock: FlightClock = field(default_factory=FlightClock)
    """Estimate of the flight clock, used for the age of the displayed data."""
    proven: ProvenState | None = None
    """None if no stream message had a proof for this ground station's operator."""

    @property
    def simulated(self) -> bool:
        """Whether the vehicle has reported that its devices are simulated."""
        return self.state is not None and self.state.simulated and self.state.session == self.session

    def stream_age_s(self, now_s: float) -> float | None:
        """Return the time since the newest stream message, or None if none has arrived in this session."""
        return None if self.stream_received_s is None else now_s - self.stream_received_s

    def live(self, now_s: float) -> bool:
        """Whether the vehicle's stream is arriving."""
        age_s = self.stream_age_s(now_s)
        return age_s is not None and age_s < LIVE_S

    def ended(self, now_s: float) -> bool:
        """Whether the vehicle has reported the end of its flight and sends no stream any more; a state message has no proof."""
        state = self.state
        reported = state is not None and state.presence is Presence.ENDED and state.session == self.session
        return reported and not self.live(now_s)


class VehicleTracker:
    """Processes every message of a broker: stores valid records, counts rejected messages.

    Args:
        only: name of the one vehicle to track; None for all.
        signer: the operator who signs commands at this station; without one (None) no proof can be checked.
    """

    def __init__(self, only: str | None = None, signer: Signer | None = None) -> None:
        self._only = only
        self._signer = signer
        self.vehicles: dict[str, Vehicle] = {}
        self.rejected = 0
        self.rejected_text: str | None = None
        """Topic and error of the last rejected message."""

    def receive(self, topic: str, payload: bytes, retained: bool, now_s: float) -> ReceivedRecord | None:
        """Store and return the record of a message; None if the message is not a valid record.

        Args:
            retained: whether the broker had retained the message; if so its age is unknown.
            now_s: local monotonic clock.
        """
        try:
            named = vehicle_of(topic)
            if named is None or named[1] not in VEHICLE_TOPICS or VEHICLE_NAME.fullmatch(named[0]) is None:
                raise MessageError("not a topic of a vehicle")
            name, kind = named
            if self._only is not None and name != self._only:
                return None
            if not payload and retained:
                return None  # an empty retained message deletes the retained one
            record: Any = decode(RECORDS[kind], payload)
            if isinstance(record, State) and record.vehicle != name:
                raise MessageError(f"is from vehicle {record.vehicle!r:.60}")
            if isinstance(record, Ack) and not self._is_genuine(record, name):
                raise MessageError("has no valid proof of the vehicle")
            if isinstance(record, Stream) and not retained:
                self._check_stream(name, record, now_s)
        except MessageError as error:
            self.rejected += 1
            self.rejected_text = f"{topic!r:.80}: {error}"
            return None
        return self._store(self._vehicle(name, now_s), kind, record, retained, now_s)

    def count_rejected(self, topic: str, error: Exception) -> None:
        """Count a message that failed with an unexpected exception."""
        self.rejected += 1
        self.rejected_text = f"{topic!r:.80}: {type(error).__name__}: {str(error)!r:.80}"

    def present(self, now_s: float) -> list[str]:
        """Return the names of the vehicles that report a flight or whose stream is arriving."""
        return sorted(
            name
            for name, known in self.vehicles.items()
            if known.live(now_s)
            or (known.state is not None and known.state.presence in (Presence.FLYING, Presence.SILENT))
        )

    def proven(self, now_s: float) -> list[str]:
        """Return the names of the vehicles whose proven messages are arriving."""
        return sorted(
            name for name, known in self.vehicles.items() if known.proven is not None and known.proven.live(now_s)
        )

    def _is_genuine(self, ack: Ack, name: str) -> bool:
        """Return whether an ack for this operator has a valid proof; acks for others cannot be checked and are accepted."""
        signer = self._signer
        return signer is None or ack.operator != signer.operator or ack_proven(ack, name, signer.key)

    def _check_stream(self, name: str, stream: Stream, now_s: float) -> None:
        """Store the state that a proven stream message carries; raise MessageError if the message must not be displayed.

        A message of a different flight is accepted if that flight is later on the vehicle's wall clock by more than `LIVE_S`, or if
        the current flight no longer sends messages. So neither a recording of an earlier flight nor a second flight under the same
        name replaces a running one, to which the commands go.
        """
        known = self.vehicles.get(name)
        proven = known.proven if known is not None else None
        if self._signer is None or not stream_proven(stream, name, self._signer.key):
            if proven is not None and proven.live(now_s):
                raise MessageError("has no valid proof of the vehicle, unlike earlier ones")
            return
        if proven is not None and proven.session != stream.session:
            if proven.live(now_s) and stream.wall_s <= proven.wall_s + LIVE_S:
                raise MessageError("is of another flight under the name of the one that is shown")
            proven = None
        if proven is None:
            proven = ProvenState(
                session=stream.session, wall_s=stream.wall_s, t_s=stream.t_s, hold=stream.hold or 0, received_s=now_s
            )
            self._vehicle(name, now_s).proven = proven
        elif stream.t_s <= proven.t_s:
            raise MessageError("was received before")  # the vehicle sends only after a new tick
        proven.wall_s, proven.t_s, proven.hold, proven.received_s = stream.wall_s, stream.t_s, stream.hold or 0, now_s
        proven.clock.add(stream.t_s, now_s)

    def _vehicle(self, name: str, now_s: float) -> Vehicle:
        known = self.vehicles.get(name)
        if known is None:
            if len(self.vehicles) >= VEHICLES_MAX:
                del self.vehicles[min(self.vehicles.values(), key=lambda v: (v.proven is not None, v.received_s)).name]
            known = self.vehicles[name] = Vehicle(name)
        known.received_s = now_s
        return known

    def _store(self, known: Vehicle, kind: Topic, record: Any, retained: bool, now_s: float) -> ReceivedRecord | None:
        if isinstance(record, (State, Stream)) and record.session != known.session:
            if known.session is None or not retained:
                known.session = record.session
                known.stream = known.stream_received_s = None
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
                    return None  # the age of a retained stream message is unknown; it would look live
                known.stream, known.stream_received_s = record, now_s
                known.clock.add(record.t_s, now_s)
                flight_ms = known.clock.now_ms(now_s, known.simulated)
                age_s = None if flight_ms is None else max(0.0, flight_ms / 1e3 - record.t_s)
        return ReceivedRecord(known.name, kind, record, age_s)
