"""The ground station's connection to its broker: it comes back by itself for ever, and says how it is."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
import uuid
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import aiomqtt
from paho.mqtt.client import MQTTMessage
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from companion.ground.access import BrokerAccess
from companion.ground.messages import MESSAGE_MAX_BYTES

ANSWER_S = 2.0
"""For each answer of the broker."""
KEEPALIVE_S = 5
_PAUSE_MIN_S, _PAUSE_MAX_S = 0.2, 2.0
_TOPIC_ROOM_BYTES = 1024
_REFUSALS = frozenset({128, 132, 133, 134, 135, 138, 140, 144, 149, 156, 157})
"""CONNACK reason codes (MQTT 5, 3.2.2.2) that time does not mend: bad login, not authorised, banned, ..."""

_SSL_SOURCE = re.compile(r" \(_ssl\.c:\d+\)$")

OnMessage = Callable[[str, bytes, bool], None]
"""Topic, payload, retained. Must not raise."""


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
        self._client: _Client | None = None
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
            client = _Client(self._access, self._on_message)
            try:
                await client.open()
                await client.hear(self._topics)
                _end_if_cancelled()
                self._client, pause_s, self._ever = client, _PAUSE_MIN_S, True
                self._changed(True, f"connected to {self._access.address}")
                why = await client.broken()
            except aiomqtt.MqttError as error:
                why = self._why(error)
            finally:
                self._client = None
                await client.drop()
            self._changed(False, f"no broker at {self._access.address}, trying: {why}")
            await asyncio.sleep(pause_s)
            pause_s = min(_PAUSE_MAX_S, pause_s * 1.6)

    async def publish(self, topic: str, payload: bytes) -> None:
        """Hand a message to the broker, at least once (QoS 1).

        Raises:
            LinkError: no broker, no answer within `ANSWER_S`, or the broker does not let us.
        """
        if self._client is None:
            raise LinkError(self.text)
        await self._client.hand_over(topic, payload)

    def _why(self, error: aiomqtt.MqttError) -> str:
        code = getattr(error, "rc", None)
        if isinstance(error, aiomqtt.MqttCodeError) and isinstance(code, ReasonCode):
            if not self._ever and code.value in _REFUSALS:
                login = (
                    f"the login {self._access.username!r}" if self._access.username else "a connection without login"
                )
                raise BrokerRefused(
                    f"{self._access.address}: the broker refuses {login}: {code}; see --login"
                ) from None
            return str(code)
        text = _SSL_SOURCE.sub("", str(error).split("] ")[-1])
        if "CERTIFICATE_VERIFY_FAILED" in str(error) and not self._ever:
            raise BrokerRefused(
                f"{self._access.address}: the broker is not believed ({text}); name the authority of its certificate: --ca FILE"
            ) from None
        return text or "no answer"

    def _changed(self, connected: bool, text: str) -> None:
        if (connected, text) != (self.connected, self.text):
            self.connected, self.text = connected, text
            self._on_change(connected, text)


def _end_if_cancelled() -> None:
    """Python 3.11's `asyncio.wait_for`, which aiomqtt waits with, forgets a cancellation that comes together with the result."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def _logger() -> logging.Logger:
    """What paho says of a connection is said by us, in our words."""
    logger = logging.getLogger("companion.ground.mqtt")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger


class _Client(aiomqtt.Client):
    """One connection. Messages go straight to whom they concern: no queue that could grow, no task for each."""

    def __init__(self, access: BrokerAccess, on_message: OnMessage) -> None:
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = MESSAGE_MAX_BYTES + _TOPIC_ROOM_BYTES  # the broker keeps larger ones to itself
        super().__init__(
            access.address.host,
            access.address.port,
            username=access.username,
            password=access.password,
            logger=_logger(),
            identifier=f"companion-ground-{uuid.uuid4().hex[:12]}",
            protocol=aiomqtt.ProtocolVersion.V5,
            timeout=ANSWER_S,
            keepalive=KEEPALIVE_S,
            properties=properties,
            tls_context=access.tls,
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
        )
        self._client.connect_timeout = ANSWER_S
        self._take = on_message
        self._handed_over: dict[int, asyncio.Future[ReasonCode]] = {}

    async def open(self) -> None:
        """Connect. The blocking part runs in a thread that cannot be cancelled: whoever cancels waits until it is over."""
        opening = asyncio.ensure_future(self.__aenter__())
        try:
            await asyncio.shield(opening)
        except asyncio.CancelledError:
            if self._client.socket() is not None:
                opening.cancel()
            with contextlib.suppress(asyncio.CancelledError, aiomqtt.MqttError):
                await opening
            raise

    async def hear(self, topics: list[tuple[str, int]]) -> None:
        """Subscribe, one after another: what is retained comes in that order."""
        for topic, qos in topics:
            codes = await self.subscribe(topic, qos)
            refused = [code for code in codes if isinstance(code, ReasonCode) and code.is_failure]
            if refused:
                raise aiomqtt.MqttError(f"it does not let us read {topic}: {refused[0]}")

    async def broken(self) -> str:
        """Wait until the connection is lost; says why."""
        try:
            async for _ in self.messages:
                pass  # none comes this way: see _on_message
        except aiomqtt.MqttError as error:
            cause = error.__cause__
            code = getattr(cause, "rc", None)
            return str(code) if isinstance(code, ReasonCode) else "the connection broke"
        return "the connection ended"

    async def hand_over(self, topic: str, payload: bytes) -> None:
        """Publish with QoS 1 and wait for the broker's word; aiomqtt's own `publish` does not tell a refusal (PUBACK 135)."""
        info = self._client.publish(topic, payload, qos=1)
        if info.rc != 0:
            raise LinkError(f"the broker could not be told: {aiomqtt.MqttCodeError(info.rc)}")
        answer: asyncio.Future[ReasonCode] = asyncio.get_running_loop().create_future()
        self._handed_over[info.mid] = answer
        try:
            async with asyncio.timeout(ANSWER_S):
                code = await answer
        except TimeoutError:
            raise LinkError(f"no answer from the broker within {ANSWER_S:g} s") from None
        finally:
            self._handed_over.pop(info.mid, None)
        if code.is_failure:
            raise LinkError(f"the broker refused it: {code}")

    async def drop(self) -> None:
        """Close, whatever state it is in."""
        with contextlib.suppress(OSError, ValueError):
            self._client.disconnect()
            await asyncio.sleep(0)  # the writer that paho asked for is registered by now, and goes with the socket
            self._client.loop_write()
        self._client._sock_close()  # paho leaves the socket open where it gave up before CONNACK
        for future in (self._connected, self._disconnected):
            if future.done() and not future.cancelled():
                future.exception()  # told already; asyncio would complain that nobody looked
        await asyncio.sleep(0)

    def _on_message(self, client: Any, userdata: Any, message: MQTTMessage) -> None:
        with contextlib.suppress(UnicodeDecodeError):
            self._take(message.topic, bytes(message.payload), message.retain)

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:
        answer = self._handed_over.get(mid)
        if answer is not None and not answer.done():
            answer.set_result(reason_code)
