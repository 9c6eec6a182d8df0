"""Fans what vehicles send out to viewers. The JSON text of a message is made once, however many watch; no I/O here.

A viewer has a bounded outbox. Of the stream the newest message of each vehicle counts; everything else is kept in order until it is
taken, and a viewer that lets too much of it pile up is told to go: whoever lost events must not believe that there were none.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from dataclasses import dataclass
from typing import Any

from companion.ground.protocol.messages import Topic
from companion.ground.station.vehicles import VEHICLES_MAX, Heard, Watch
from companion.model.codec import json_text, to_jsonable

OUTBOX_MAX = 1000
"""Messages beside the stream that a viewer may leave lying."""
OUTBOX_MAX_CHARACTERS = 4_000_000
VIEWERS_MAX = 100
FRESH_S = 0.5
"""An older stream message is not shown to a viewer who comes late: it would look alive."""


@dataclass(frozen=True, slots=True)
class Parting:
    """Why a viewer is sent away."""

    code: int
    """Of the WebSocket's close frame, RFC 6455 section 7.4."""
    reason: str


TOO_SLOW = Parting(1013, "too slow: messages were lost, connect again")
GOING_AWAY = Parting(1001, "the monitor was ended")


class Outbox:
    """What waits to be sent to one viewer."""

    def __init__(self) -> None:
        self._kept: deque[str] = deque()
        self._characters = 0
        self._streams: dict[str, str] = {}
        self._something = asyncio.Event()
        self._parted = asyncio.Event()
        self.parting: Parting | None = None

    def put(self, text: str) -> None:
        """A message that must not be lost."""
        if len(self._kept) >= OUTBOX_MAX or self._characters + len(text) > OUTBOX_MAX_CHARACTERS:
            self.part(TOO_SLOW)
            return
        self._kept.append(text)
        self._characters += len(text)
        self._something.set()

    def put_stream(self, vehicle: str, text: str) -> None:
        """A message that the next one of the same vehicle replaces."""
        if vehicle not in self._streams and len(self._streams) >= VEHICLES_MAX:
            del self._streams[next(iter(self._streams))]
        self._streams[vehicle] = text
        self._something.set()

    def part(self, parting: Parting) -> None:
        """Send the viewer away; what lies there is dropped."""
        if self.parting is None:
            self.parting = parting
            self._kept.clear()
            self._streams.clear()
        self._something.set()
        self._parted.set()

    async def parted(self) -> None:
        """Wait until the viewer is sent away."""
        await self._parted.wait()

    async def take(self) -> list[str]:
        """Wait until there is something, and take all of it, in order; empty: see `parting`."""
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
        watch: what is known of the vehicles, for those who come late.
        broker_text: what is said of the broker before anything else is known.
    """

    def __init__(self, watch: Watch, broker_text: str) -> None:
        self._watch = watch
        self._viewers: set[Outbox] = set()
        self._broker: dict[str, Any] = {"kind": "broker", "connected": False, "text": broker_text}
        self._rubbish_told = 0

    def join(self, outbox: Outbox, now_s: float) -> None:
        """A new viewer; is told what is known."""
        self._viewers.add(outbox)
        outbox.put(json.dumps(self._broker))
        for known in self._watch.vehicles.values():
            for topic, record in (
                (Topic.STATE, known.state),
                (Topic.SCENE, known.scene),
                (Topic.PREFLIGHT, known.preflight),
                (Topic.EVENTS, known.events),
            ):
                if record is not None:
                    outbox.put(envelope(Heard(known.name, topic, record)))
            age_s = known.stream_age_s(now_s)
            if known.stream is not None and age_s is not None and age_s < FRESH_S:
                outbox.put_stream(known.name, envelope(Heard(known.name, Topic.STREAM, known.stream, age_s)))

    def leave(self, outbox: Outbox) -> None:
        """A viewer is gone."""
        self._viewers.discard(outbox)

    def relay(self, heard: Heard) -> None:
        """A record, to everybody."""
        if not self._viewers:
            return
        text = envelope(heard)
        for outbox in self._viewers:
            if heard.topic is Topic.STREAM:
                outbox.put_stream(heard.vehicle, text)
            else:
                outbox.put(text)

    def broker(self, connected: bool, text: str) -> None:
        """The connection to the broker has changed."""
        self._broker = {**self._broker, "connected": connected, "text": text}
        self._tell_broker()

    def tell_rubbish(self) -> None:
        """Say how much was thrown away, if it has become more; for once a second."""
        if self._watch.rubbish != self._rubbish_told:
            self._rubbish_told = self._watch.rubbish
            self._broker |= {"rubbish": self._watch.rubbish, "rubbish_text": self._watch.rubbish_text}
            self._tell_broker()

    def _tell_broker(self) -> None:
        text = json.dumps(self._broker)
        for outbox in self._viewers:
            outbox.put(text)


def envelope(heard: Heard) -> str:
    """A record as viewers get it. Made of the record, not of the payload: what the record does not say is not passed on."""
    data: dict[str, Any] = {"kind": heard.topic.value, "vehicle": heard.vehicle}
    if heard.age_s is not None:
        data["age_s"] = round(heard.age_s, 3)
    data["data"] = to_jsonable(heard.record)
    return json_text(data)
