"""A ground station without a user interface: connection, vehicle state, commands. Shared by page, terminal and `companion command`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NoReturn

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import Topic
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import CommandSender
from companion.ground.station.link import Link
from companion.ground.station.vehicles import VEHICLE_TOPICS, ReceivedRecord, VehicleTracker

OnRecord = Callable[[ReceivedRecord], None]
OnChange = Callable[[bool, str], None]


class Station:
    """Tracks all vehicles of a broker, or one of them.

    Args:
        signer: the operator who signs commands at this station, or why commands are not possible.
        only: name of the one vehicle to track; None for all.
        on_change: called when the connection changes, with one line for display.
        topics: topics to subscribe to, in this order.
        in_order: subscribe to all topics with QoS 0: no message overtakes another, and retained messages arrive first. If false,
            retained messages and acks arrive at least once.
    """

    def __init__(
        self,
        access: BrokerAccess,
        signer: Signer | str,
        only: str | None,
        on_heard: OnRecord,
        on_change: OnChange,
        *,
        topics: Sequence[Topic] = VEHICLE_TOPICS,
        in_order: bool = False,
    ) -> None:
        self.tracker = VehicleTracker(only, signer if isinstance(signer, Signer) else None)
        self._on_record = on_heard
        subscriptions = [(topic.of(only or "+"), 0 if in_order or topic is Topic.STREAM else 1) for topic in topics]
        self.link = Link(access, subscriptions, self._on_message, on_change)
        self.commands = CommandSender(self.link, self.tracker, signer)

    async def run(self) -> NoReturn:
        """Stay connected; see `Link.run`."""
        await self.link.run()

    def _on_message(self, topic: str, payload: bytes, retained: bool) -> None:
        """Process one message. No message, however malformed, ends the connection: commands need it."""
        try:
            received = self.tracker.receive(topic, payload, retained, time.monotonic())
            if received is None:
                return
            if received.topic is Topic.ACK:
                self.commands.on_ack(received.record)
            self._on_record(received)
        except Exception as error:
            self.tracker.count_rejected(topic, error)
