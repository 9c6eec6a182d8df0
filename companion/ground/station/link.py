"""The ground station's connection to its broker: it comes back by itself for ever, and says how it is."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable, Sequence
from typing import NoReturn

import aiomqtt

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.connection import Connection, OnMessage, code_of, why
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES

ANSWER_S = 2.0
"""For each answer of the broker."""
_PAUSE_MIN_S, _PAUSE_MAX_S = 0.2, 2.0
_TOPIC_ROOM_BYTES = 1024
_REFUSALS = frozenset({128, 132, 133, 134, 135, 138, 140, 144, 149, 156, 157})
"""CONNACK reason codes (MQTT 5, 3.2.2.2) that time does not mend: bad login, not authorised, banned, ..."""


class LinkError(Exception):
    """A message could not be handed to the broker; says why in one line."""


class BrokerRefused(Exception):
    """The broker is there and does not want us; nothing that time mends. One line for the user."""


class Link:
    """Receives from one broker and publishes to it, across as many connections as it takes.

    Args:
        access: how to get there.
        topics: filters and the quality of service asked for, in the order of subscription.
        on_message: called in the event loop for every message.
        on_change: called in the event loop with (connected, one line for people) whenever that changes.
    """

    def __init__(
        self,
        access: BrokerAccess,
        topics: Sequence[tuple[str, int]],
        on_message: OnMessage,
        on_change: Callable[[bool, str], None],
    ) -> None:
        self._access = access
        self._topics = list(topics)
        self._on_message = on_message
        self._on_change = on_change
        self._client: Connection | None = None
        self._ever = False
        self.connected = False
        self.text = f"no broker at {access.address} yet, trying"

    async def run(self) -> NoReturn:
        """Stay connected.

        Raises:
            BrokerRefused: the very first contact was refused for a reason that time does not mend. Later ones are tried on.
        """
        pause_s = _PAUSE_MIN_S
        while True:
            client = self._new_connection()
            try:
                await client.open()
                for topic, qos in self._topics:  # one after another: what is retained comes in that order
                    refusal = await client.hear(topic, qos)
                    if refusal is not None:
                        raise aiomqtt.MqttError(f"it does not let us read {topic}: {refusal}")
                self._client, pause_s, self._ever = client, _PAUSE_MIN_S, True
                self._changed(True, f"connected to {self._access.address}")
                await client.broken()
            except aiomqtt.MqttError as error:
                reason = self._why(error)
            finally:
                self._client = None
                await client.drop()
            self._changed(False, f"no broker at {self._access.address}, trying: {reason}")
            await asyncio.sleep(pause_s)
            pause_s = min(_PAUSE_MAX_S, pause_s * 1.6)

    async def publish(self, topic: str, payload: bytes) -> None:
        """Hand a message to the broker, at least once (QoS 1).

        Raises:
            LinkError: no broker, no answer within `ANSWER_S`, or the broker does not let us.
        """
        if self._client is None:
            raise LinkError(self.text)
        try:
            refusal = await self._client.send(topic, payload, qos=1)
        except aiomqtt.MqttError as error:
            raise LinkError(f"the broker could not be told: {why(error)}") from None
        if refusal is not None:
            raise LinkError(f"the broker refused it: {refusal}")

    def _new_connection(self) -> Connection:
        return Connection(
            self._access,
            f"companion-ground-{uuid.uuid4().hex[:12]}",
            self._on_message,
            packet_max_bytes=MESSAGE_MAX_BYTES + _TOPIC_ROOM_BYTES,
            answer_s=ANSWER_S,
        )

    def _why(self, error: aiomqtt.MqttError) -> str:
        code = code_of(error)
        if code is not None and not self._ever and code.value in _REFUSALS:
            login = f"the login {self._access.username!r}" if self._access.username else "a connection without login"
            raise BrokerRefused(f"{self._access.address}: the broker refuses {login}: {code}; see --login") from None
        if "CERTIFICATE_VERIFY_FAILED" in str(error) and not self._ever:
            text = f"the broker is not believed ({why(error)}); name the authority of its certificate: --ca FILE"
            raise BrokerRefused(f"{self._access.address}: {text}") from None
        return why(error)

    def _changed(self, connected: bool, text: str) -> None:
        if (connected, text) != (self.connected, self.text):
            self.connected, self.text = connected, text
            self._on_change(connected, text)
