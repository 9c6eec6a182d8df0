"""One connection to a broker, on aiomqtt: answers with their reasons, messages without a queue, an end that leaves nothing behind.

Differs from `aiomqtt.Client` in what that does not offer: the reason code of a publish (an ACL that does not let us write says so in
PUBACK only), messages that are handed on at once instead of being queued (a flood of them makes no task for each), and an end that
leaves no socket behind whatever state the connection is in.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
import socket
from collections.abc import Callable
from typing import Any

import aiomqtt
from paho.mqtt.client import MQTTMessage
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from companion.ground.protocol.access import BrokerAccess

KEEPALIVE_S = 5
"""After 1.5 times this without a word the broker sends the last will (MQTT 5, 3.1.2.10)."""
OnMessage = Callable[[str, bytes, bool], None]
"""Topic, payload, retained. Called in the event loop; must not raise."""
_SSL_SOURCE = re.compile(r" \(_ssl\.c:\d+\)$")


class Connection(aiomqtt.Client):
    """One connection; a new one for each attempt.

    Args:
        access: how to get there.
        identifier: a new connection with the same one ends the one before it at the broker.
        on_message: for every message.
        packet_max_bytes: the broker keeps larger ones to itself (Maximum Packet Size).
        answer_s: for each answer of the broker.
        will: what the broker publishes when the connection breaks.
        send_buffer_bytes: of the system; what a slow broker has not taken lies in there and gets old.
    """

    def __init__(
        self,
        access: BrokerAccess,
        identifier: str,
        on_message: OnMessage,
        *,
        packet_max_bytes: int,
        answer_s: float,
        will: aiomqtt.Will | None = None,
        send_buffer_bytes: int | None = None,
    ) -> None:
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = packet_max_bytes
        options = [(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)]
        if send_buffer_bytes is not None:
            options.append((socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer_bytes))
        super().__init__(
            access.address.host,
            access.address.port,
            username=access.username,
            password=access.password,
            logger=_logger(),
            identifier=identifier,
            protocol=aiomqtt.ProtocolVersion.V5,
            will=will,
            timeout=answer_s,
            keepalive=KEEPALIVE_S,
            properties=properties,
            tls_context=access.tls,
            socket_options=options,
        )
        self._client.connect_timeout = answer_s
        self._answer_s = answer_s
        self._take = on_message
        self._under_way: dict[int, asyncio.Future[ReasonCode]] = {}

    async def open(self) -> None:
        """Connect. The blocking part runs in a thread that cannot be cancelled: whoever cancels waits until it is over.

        Raises:
            aiomqtt.MqttError: no broker, no answer, or it refuses us.
        """
        opening = asyncio.ensure_future(self.__aenter__())
        try:
            await asyncio.shield(opening)
        except asyncio.CancelledError:
            if self._client.socket() is not None:
                opening.cancel()
            with contextlib.suppress(asyncio.CancelledError, aiomqtt.MqttError):
                await opening
            raise

    async def hear(self, topic: str, qos: int) -> str | None:
        """Subscribe; None, or why the broker does not let us.

        Raises:
            aiomqtt.MqttError: no answer.
        """
        codes = await self.subscribe(topic, qos)
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            # Python 3.11's `asyncio.wait_for`, which aiomqtt waits with, forgets a cancellation that comes together with the result.
            raise asyncio.CancelledError
        refused = [code for code in codes if isinstance(code, ReasonCode) and code.is_failure]
        return str(refused[0]) if refused else None

    async def send(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> str | None:
        """Publish, and wait until the broker has it (QoS 1) or the system has taken it (QoS 0); None, or why the broker refuses it.

        Raises:
            aiomqtt.MqttError: the connection is gone, or nothing happened within `answer_s`.
        """
        info = self._client.publish(topic, payload, qos=qos, retain=retain)
        if info.rc != 0:
            raise aiomqtt.MqttCodeError(info.rc, "could not publish")
        done: asyncio.Future[ReasonCode] = asyncio.get_running_loop().create_future()
        self._under_way[info.mid] = done
        try:
            async with asyncio.timeout(self._answer_s):
                code = await done
        except TimeoutError:
            raise aiomqtt.MqttError(f"no answer from the broker within {self._answer_s:g} s") from None
        finally:
            self._under_way.pop(info.mid, None)
        return str(code) if code.is_failure else None

    async def broken(self) -> None:
        """Wait until the connection is lost.

        Raises:
            aiomqtt.MqttError: it is; says why.
        """
        async for _ in self.messages:
            pass  # none comes this way: see _on_message
        raise aiomqtt.MqttError("the connection ended")

    async def drop(self, *, with_will: bool = False) -> None:
        """Close, whatever state it is in.

        Args:
            with_will: without a word, so that the broker says the last will.
        """
        if not with_will:
            with contextlib.suppress(OSError, ValueError):
                self._client.disconnect()
        await asyncio.sleep(0)  # a writer that was asked for is registered by now, and goes with the socket
        if not with_will:
            with contextlib.suppress(OSError, ValueError):
                self._client.loop_write()
        self._client._sock_close()  # paho leaves the socket open where it gave up before CONNACK
        for future in (self._connected, self._disconnected):
            if future.done() and not future.cancelled():
                future.exception()  # told already; asyncio would complain that nobody looked
        if self._misc_task is not None:
            self._misc_task.cancel()
            await asyncio.wait((self._misc_task,))

    def _on_message(self, client: Any, userdata: Any, message: MQTTMessage) -> None:
        with contextlib.suppress(UnicodeDecodeError):
            self._take(message.topic, bytes(message.payload), message.retain)

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:
        done = self._under_way.get(mid)
        if done is not None and not done.done():
            done.set_result(reason_code)


def code_of(error: aiomqtt.MqttError) -> ReasonCode | None:
    """The broker's reason code in an error, if there is one."""
    cause = error.__cause__ if isinstance(error.__cause__, aiomqtt.MqttError) else error
    code = getattr(cause, "rc", None)
    return code if isinstance(code, ReasonCode) else None


def why(error: aiomqtt.MqttError) -> str:
    """One line of an error, without the library's own framing."""
    code = code_of(error)
    if code is not None:
        return str(code)
    cause = error.__cause__ if isinstance(error.__cause__, aiomqtt.MqttError) else error
    return _SSL_SOURCE.sub("", str(cause).split("] ")[-1]) or "no answer"


def _logger() -> logging.Logger:
    """What the library says of a connection is said by us, in our words."""
    logger = logging.getLogger("companion.mqtt")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger
