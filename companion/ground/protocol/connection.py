"""An MQTT connection on aiomqtt with reason codes, unqueued messages and a complete shutdown. It adds what `aiomqtt.Client` does
not offer: the reason code of a publish (only PUBACK shows that an ACL forbids writing), messages passed on immediately instead of
queued (a flood creates no tasks), and a shutdown that closes the socket in every state of the connection.
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
"""Keep-alive: after 1.5 times this without a message the broker publishes the last will (MQTT 5, 3.1.2.10)."""
OnMessage = Callable[[str, bytes, bool], None]
"""Callback for a message, called in the event loop with topic, payload and retained flag; must not raise."""
_UNSUPPORTED_VERSION = 132
_LOGIN_REFUSED = (134, 135, 140)
"""CONNACK reason codes: bad user name or password, not authorized, bad authentication method."""
_SSL_SOURCE = re.compile(r" \(_ssl\.c:\d+\)$")


class Connection(aiomqtt.Client):
    """One connection; each attempt needs a new instance.

    Args:
        identifier: client id; a new connection with the same id ends the previous one at the broker.
        packet_max_bytes: Maximum Packet Size; the broker drops larger messages.
        will: message that the broker publishes if the connection breaks.
        send_buffer_bytes: size of the socket's send buffer, whose content becomes stale if the broker is slow.
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
        self._pending: dict[int, asyncio.Future[ReasonCode]] = {}

    async def open(self) -> None:
        """Connect. The blocking part runs in a thread, which cannot be cancelled: a cancelled caller waits for it to end.

        Raises:
            aiomqtt.MqttError: the broker is unreachable, does not answer, or refuses the connection.
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

    async def subscribe_topic(self, topic: str, qos: int) -> str | None:
        """Subscribe. Return None, or the reason why the broker refuses.

        Raises:
            aiomqtt.MqttError: no answer.
        """
        codes = await self.subscribe(topic, qos)
        task = asyncio.current_task()
        if task is not None and task.cancelling():
            # aiomqtt uses `asyncio.wait_for`, which in Python 3.11 loses a cancellation that coincides with the result.
            raise asyncio.CancelledError
        refused = [code for code in codes if isinstance(code, ReasonCode) and code.is_failure]
        return str(refused[0]) if refused else None

    async def publish_message(self, topic: str, payload: bytes, *, qos: int, retain: bool = False) -> str | None:
        """Publish and wait until the broker has the message (QoS 1) or the socket has accepted it (QoS 0); return None, or why the
        broker refused it.

        Raises:
            aiomqtt.MqttError: the connection is lost, or there was no answer within `answer_s`.
        """
        info = self._client.publish(topic, payload, qos=qos, retain=retain)
        if info.rc != 0:
            raise aiomqtt.MqttCodeError(info.rc, "could not publish")
        done: asyncio.Future[ReasonCode] = asyncio.get_running_loop().create_future()
        self._pending[info.mid] = done
        try:
            async with asyncio.timeout(self._answer_s):
                code = await done
        except TimeoutError:
            raise aiomqtt.MqttError(f"no answer from the broker within {self._answer_s:g} s") from None
        finally:
            self._pending.pop(info.mid, None)
        return str(code) if code.is_failure else None

    async def wait_broken(self) -> None:
        """Wait until the connection is lost.

        Raises:
            aiomqtt.MqttError: always, with the reason.
        """
        async for _ in self.messages:
            pass  # messages do not arrive here: see _on_message
        raise aiomqtt.MqttError("the connection ended")

    async def shut_down(self, *, with_will: bool = False) -> None:
        """Close the connection, in any state.

        Args:
            with_will: close without DISCONNECT, so that the broker publishes the last will.
        """
        if not with_will:
            with contextlib.suppress(OSError, ValueError):
                self._client.disconnect()
        await asyncio.sleep(0)  # lets a requested writer register, so that it is removed with the socket
        if not with_will:
            with contextlib.suppress(OSError, ValueError):
                self._client.loop_write()
        self._client._sock_close()  # paho leaves the socket open if it fails before CONNACK
        for future in (self._connected, self._disconnected):
            if future.done() and not future.cancelled():
                future.exception()  # retrieved because asyncio warns of exceptions that are not
        if self._misc_task is not None:
            self._misc_task.cancel()
            await asyncio.wait((self._misc_task,))

    def _on_disconnect(
        self, client: Any, userdata: Any, flags: Any, reason_code: ReasonCode, properties: Any = None
    ) -> None:
        if self._connected.cancelled():
            return  # aiomqtt asks a cancelled attempt for its exception, which raises CancelledError
        if not self._connected.done():  # aiomqtt waits for its timeout, and names that
            self._connected.set_exception(
                aiomqtt.MqttError("the server at this port ended the connection without an MQTT 5 answer")
            )
        super()._on_disconnect(client, userdata, flags, reason_code, properties)

    def _on_message(self, client: Any, userdata: Any, message: MQTTMessage) -> None:
        with contextlib.suppress(UnicodeDecodeError):
            self._take(message.topic, bytes(message.payload), message.retain)

    def _on_publish(self, client: Any, userdata: Any, mid: int, reason_code: ReasonCode, properties: Any) -> None:
        done = self._pending.get(mid)
        if done is not None and not done.done():
            done.set_result(reason_code)


def reason_code(error: aiomqtt.MqttError) -> ReasonCode | None:
    """Return the broker's reason code from an error, or None if it has none."""
    cause = error.__cause__ if isinstance(error.__cause__, aiomqtt.MqttError) else error
    code = getattr(cause, "rc", None)
    return code if isinstance(code, ReasonCode) else None


def remedy(code: ReasonCode) -> str:
    """Return what to do about a refused connection, as the end of a message; empty if the reason code says all."""
    if code.value == _UNSUPPORTED_VERSION:
        return "; it speaks MQTT 3.1.1 only, expected MQTT 5: use Mosquitto 1.6 or later"
    return "; see --login" if code.value in _LOGIN_REFUSED else ""


def error_text(error: aiomqtt.MqttError) -> str:
    """Return one line for an error, without the library's prefixes."""
    code = reason_code(error)
    if code is not None:
        return str(code)
    cause = error.__cause__ if isinstance(error.__cause__, aiomqtt.MqttError) else error
    return _SSL_SOURCE.sub("", str(cause).split("] ")[-1]) or "no answer"


def _logger() -> logging.Logger:
    """Return a logger that discards the library's messages: the companion reports connection changes itself."""
    logger = logging.getLogger("companion.mqtt")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger
