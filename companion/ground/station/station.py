"""A ground station without a face: connection, knowledge of the vehicles, commands. Page, terminal and `companion command` share it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NoReturn

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import Topic
from companion.ground.protocol.proof import Signer
from companion.ground.station.command_sender import Orders
from companion.ground.station.link import Link
from companion.ground.station.vehicles import HEARD_TOPICS, Heard, Watch

OnHeard = Callable[[Heard], None]
OnChange = Callable[[bool, str], None]


class Station:
    """Watches all vehicles of a broker, or one of them.

    Args:
        access: how the broker is reached.
        signer: the operator who commands from here, or why nobody does.
        only: name of the one vehicle that is watched; None: all.
        on_heard: hears of every record.
        on_change: hears when the connection comes or goes, with one line for people.
        topics: that are subscribed, in this order.
        in_order: everything at QoS 0: on one connection nothing overtakes anything, retained records come first. Else what is
            retained and acks come at least once.
    """

    def __init__(
        self,
        access: BrokerAccess,
        signer: Signer | str,
        only: str | None,
        on_heard: OnHeard,
        on_change: OnChange,
        *,
        topics: Sequence[Topic] = HEARD_TOPICS,
        in_order: bool = False,
    ) -> None:
        self.watch = Watch(only, signer if isinstance(signer, Signer) else None)
        self._on_heard = on_heard
        subscriptions = [(topic.of(only or "+"), 0 if in_order or topic is Topic.STREAM else 1) for topic in topics]
        self.link = Link(access, subscriptions, self._take, on_change)
        self.orders = Orders(self.link, self.watch, signer)

    async def run(self) -> NoReturn:
        """Stay connected; see `Link.run`."""
        await self.link.run()

    def _take(self, topic: str, payload: bytes, retained: bool) -> None:
        """Take one message. None ends the connection, whatever it holds: commands have to leave by it."""
        try:
            heard = self.watch.take(topic, payload, retained, time.monotonic())
            if heard is None:
                return
            if heard.topic is Topic.ACK:
                self.orders.heard(heard.record)
            self._on_heard(heard)
        except Exception as error:
            self.watch.reject(topic, error)
