"""Distributes the vehicles' messages to viewers. The JSON text of a message is built once for all viewers; no I/O. Each viewer has
a bounded outbox, which keeps only the newest stream message of each vehicle, and all other messages in order. A viewer that does
not read them in time is disconnected, because a lost event would otherwise go unnoticed.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from dataclasses import dataclass
from typing import Any

from companion.ground.protocol.messages import Topic
from companion.ground.station.vehicles import VEHICLES_MAX, ReceivedRecord, VehicleTracker
from companion.model.codec import to_json

OUTBOX_MAX = 1000
"""Maximum number of waiting messages per viewer, not counting the stream."""
OUTBOX_MAX_CHARACTERS = 4_000_000
VIEWERS_MAX = 100
FRESH_S = 0.5
"""Max age of a stream message that is sent to a new viewer; an older one would look live."""


@dataclass(frozen=True, slots=True)
class CloseReason:
    """Why a viewer is disconnected."""

    code: int
    """Code of the WebSocket's close frame, RFC 6455 section 7.4."""
    reason: str


TOO_SLOW = CloseReason(1013, "too slow: messages were lost; connect again")
GOING_AWAY = CloseReason(1001, "the monitor has ended")


class Outbox:
    """Messages that wait to be sent to one viewer."""

    def __init__(self) -> None:
        self._kept: deque[str] = deque()
        self._characters = 0
        self._streams: dict[str, str] = {}
        self._something = asyncio.Event()
        self._closed = asyncio.Event()
        self.close_reason: CloseReason | None = None

    def put(self, text: str) -> None:
        """Add a message that must not be lost."""
        if len(self._kept) >= OUTBOX_MAX or self._characters + len(text) > OUTBOX_MAX_CHARACTERS:
            self.close(TOO_SLOW)
            return
        self._kept.append(text)
        self._characters += len(text)
        self._something.set()

    def put_stream(self, vehicle: str, text: str) -> None:
        """Add a message that the vehicle's next one replaces."""
        if vehicle not in self._streams and len(self._streams) >= VEHICLES_MAX:
            del self._streams[next(iter(self._streams))]
        self._streams[vehicle] = text
        self._something.set()

    def close(self, parting: CloseReason) -> None:
        """Disconnect the viewer and drop the waiting messages."""
        if self.close_reason is None:
            self.close_reason = parting
            self._kept.clear()
            self._streams.clear()
        self._something.set()
        self._closed.set()

    async def wait_closed(self) -> None:
        """Wait until the viewer is to be disconnected."""
        await self._closed.wait()

    async def take(self) -> list[str]:
        """Wait for messages and return all of them in order; empty if the outbox was closed (`close_reason`)."""
        await self._something.wait()
        self._something.clear()
        texts = [*self._kept, *self._streams.values()]
        self._kept.clear()
        self._streams.clear()
        self._characters = 0
        return texts


class Hub:
    """All viewers of one monitor.

    Args:
        broker_text: text to show until the state of the broker connection is known.
    """

    def __init__(self, watch: VehicleTracker, broker_text: str) -> None:
        self._tracker = watch
        self._viewers: set[Outbox] = set()
        self._broker: dict[str, Any] = {"kind": "broker", "connected": False, "text": broker_text}
        self._rejected_sent = 0

    def add(self, outbox: Outbox, now_s: float) -> None:
        """Add a viewer and send it the current state."""
        self._viewers.add(outbox)
        outbox.put(json.dumps(self._broker))
        for known in self._tracker.vehicles.values():
            for topic, record in (
                (Topic.STATE, known.state),
                (Topic.SCENE, known.scene),
                (Topic.PREFLIGHT, known.preflight),
                (Topic.EVENTS, known.events),
            ):
                if record is not None:
                    outbox.put(envelope(ReceivedRecord(known.name, topic, record)))
            age_s = known.stream_age_s(now_s)
            if known.stream is not None and age_s is not None and age_s < FRESH_S:
                outbox.put_stream(known.name, envelope(ReceivedRecord(known.name, Topic.STREAM, known.stream, age_s)))

    def remove(self, outbox: Outbox) -> None:
        """Remove a viewer."""
        self._viewers.discard(outbox)

    def publish(self, received: ReceivedRecord) -> None:
        """Send a record to all viewers."""
        if not self._viewers:
            return
        text = envelope(received)
        for outbox in self._viewers:
            if received.topic is Topic.STREAM:
                outbox.put_stream(received.vehicle, text)
            else:
                outbox.put(text)

    def set_broker(self, connected: bool, text: str) -> None:
        """Publish a change of the broker connection."""
        self._broker = {**self._broker, "connected": connected, "text": text}
        self._publish_broker()

    def publish_rejected(self) -> None:
        """Publish the number of rejected messages if it has changed; call once a second."""
        if self._tracker.rejected != self._rejected_sent:
            self._rejected_sent = self._tracker.rejected
            self._broker |= {"rejected": self._tracker.rejected, "rejected_text": self._tracker.rejected_text}
            self._publish_broker()

    def _publish_broker(self) -> None:
        text = json.dumps(self._broker)
        for outbox in self._viewers:
            outbox.put(text)


def envelope(received: ReceivedRecord) -> str:
    """Return a record as JSON for viewers. It is built from the record, not from the payload, so that no unknown data is passed on."""
    data: dict[str, Any] = {"kind": received.topic.value, "vehicle": received.vehicle}
    if received.age_s is not None:
        data["age_s"] = round(received.age_s, 3)
    data["data"] = received.record
    return to_json(data).decode()
