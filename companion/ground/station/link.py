"""The ground station's connection to its broker; it reconnects automatically and reports changes."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Callable, Sequence
from typing import NoReturn

import aiomqtt

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.connection import Connection, OnMessage, error_text, reason_code, remedy
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES

ANSWER_S = 2.0
_PAUSE_MIN_S, _PAUSE_MAX_S = 0.2, 2.0
_TOPIC_ROOM_BYTES = 1024
_PERMANENT_REASON_CODES = frozenset({128, 132, 133, 134, 135, 138, 140, 144, 149, 156, 157})
"""CONNACK reason codes (MQTT 5, 3.2.2.2) after which retrying is pointless: bad login, not authorised, banned, ..."""


class LinkError(Exception):
    """A message could not be published. The exception's text is one line."""


class BrokerRefused(Exception):
    """The broker permanently refuses the connection, so retrying is pointless. The exception's text is one line for the user."""


class Link:
    """Receives from one broker and publishes to it, reconnecting when necessary.

    Args:
        topics: topic filters and their QoS, in the order of subscription.
        on_message: called in the event loop for every message.
        on_change: called in the event loop with (connected, one line for display) after each change.
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
        self._was_connected = False
        self.connected = False
        self.text = f"no broker at {access.address} yet, trying"

    async def run(self) -> NoReturn:
        """Stay connected.

        Raises:
            BrokerRefused: the first connection was refused for a permanent reason. After a later refusal the link tries again.
        """
        pause_s = _PAUSE_MIN_S
        while True:
            client = self._new_connection()
            try:
                await client.open()
                for topic, qos in self._topics:  # one after another, so that retained messages arrive in this order
                    refusal = await client.subscribe_topic(topic, qos)
                    if refusal is not None:
                        raise aiomqtt.MqttError(f"the broker does not permit reading {topic}: {refusal}")
                self._client, pause_s, self._was_connected = client, _PAUSE_MIN_S, True
                self._changed(True, f"connected to {self._access.address}")
                await client.wait_broken()
            except aiomqtt.MqttError as error:
                reason = self._why(error)
            finally:
                self._client = None
                await client.shut_down()
            self._changed(False, f"no broker at {self._access.address}, trying: {reason}")
            await asyncio.sleep(pause_s)
            pause_s = min(_PAUSE_MAX_S, pause_s * 1.6)

    async def publish(self, topic: str, payload: bytes) -> None:
        """Publish a message at least once (QoS 1).

        Raises:
            LinkError: no broker is connected, it did not answer within `ANSWER_S`, or it refused the message.
        """
        if self._client is None:
            raise LinkError(self.text)
        try:
            refusal = await self._client.publish_message(topic, payload, qos=1)
        except aiomqtt.MqttError as error:
            raise LinkError(f"the broker did not accept the command: {error_text(error)}") from None
        if refusal is not None:
            raise LinkError(f"the broker refused the command: {refusal}")

    def _new_connection(self) -> Connection:
        return Connection(
            self._access,
            f"companion-ground-{uuid.uuid4().hex[:12]}",
            self._on_message,
            packet_max_bytes=MESSAGE_MAX_BYTES + _TOPIC_ROOM_BYTES,
            answer_s=ANSWER_S,
        )

    def _why(self, error: aiomqtt.MqttError) -> str:
        code = reason_code(error)
        if code is not None and not self._was_connected and code.value in _PERMANENT_REASON_CODES:
            login = f"the login {self._access.username!r}" if self._access.username else "a connection without login"
            raise BrokerRefused(f"{self._access.address}: the broker refuses {login}: {code}{remedy(code)}") from None
        if "CERTIFICATE_VERIFY_FAILED" in str(error) and not self._was_connected:
            text = f"the broker's certificate is not trusted ({error_text(error)}); give its CA certificate: --ca FILE"
            raise BrokerRefused(f"{self._access.address}: {text}") from None
        return error_text(error)

    def _changed(self, connected: bool, text: str) -> None:
        if (connected, text) != (self.connected, self.text):
            self.connected, self.text = connected, text
            self._on_change(connected, text)
