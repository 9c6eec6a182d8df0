"""One connection of the vehicle to its broker, on aiomqtt: last will, answers with their reasons, commands without a queue.

Differs from `aiomqtt.Client` in three things that it does not offer: the reason code of a publish (an ACL that does not let us write
says so in PUBACK only), messages that are handed on at once instead of being queued (a flood of them makes no task for each), and an
end that leaves no socket behind whatever state the connection is in.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt
from paho.mqtt.client import MQTTMessage
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from companion.config.document import ConfigError
from companion.config.ground import BrokerAddress, Mqtt
from companion.ground.keys import load_login

ANSWER_S = 4.0
"""For each answer of the broker."""
KEEPALIVE_S = 5
"""After 1.5 times this without a word the broker sends the last will (MQTT 5, 3.1.2.10)."""
COMMAND_PACKET_MAX_BYTES = 16_384
"""The broker keeps larger messages to itself (Maximum Packet Size): sixteen times a command, so that one too large is seen and told."""
SEND_BUFFER_BYTES = 65_536
"""About a second of the stream: what a slow broker has not taken by then would be old anyway."""


@dataclass(frozen=True, slots=True)
class Access:
    """Everything that a connection to a broker needs."""

    address: BrokerAddress
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None


def access_of(mqtt: Mqtt) -> Access:
    """Read what the vehicle file names.

    Raises:
        ConfigError: one line that says which key or file, what was found and how to mend it.
    """
    address = mqtt.address
    login = load_login(mqtt.login_file) if mqtt.login_file is not None else None
    if login is not None and not (address.tls or address.loopback):
        text = f"{address} is another computer and the way there is plain: the password could be read; use mqtts://HOST:PORT"
        raise ConfigError([f"ground.mqtt.login_file {mqtt.login_file}: {text}"])
    return Access(
        address,
        login.username if login is not None else None,
        login.password if login is not None else None,
        _tls(mqtt.ca_file) if address.tls else None,
    )


def _tls(ca_file: str | None) -> ssl.SSLContext:
    where = f"ground.mqtt.ca_file {ca_file}"
    try:
        context = ssl.create_default_context(cafile=str(Path(ca_file).expanduser()) if ca_file is not None else None)
    except FileNotFoundError:
        raise ConfigError([f"{where}: no such file"]) from None
    except ssl.SSLError:
        raise ConfigError([f"{where}: is no certificate in PEM form (-----BEGIN CERTIFICATE-----)"]) from None
    except OSError as error:
        raise ConfigError([f"{where}: cannot be read: {error.strerror}"]) from None
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    return context


class Client(aiomqtt.Client):
    """One connection; a new one for each attempt.

    Args:
        access: how to get there.
        identifier: the same for every connection of a session: a new one ends the one before it at the broker, and its last will
            comes before what the new one says, not after it.
        will: what the broker publishes when the connection breaks.
        on_message: called in the event loop with (topic, payload, retained); must not raise.
    """

    def __init__(
        self, access: Access, identifier: str, will: aiomqtt.Will, on_message: Callable[[str, bytes, bool], None]
    ) -> None:
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = COMMAND_PACKET_MAX_BYTES
        super().__init__(
            access.address.host,
            access.address.port,
            username=access.username,
            password=access.password,
            logger=_logger(),
            identifier=identifier,
            protocol=aiomqtt.ProtocolVersion.V5,
            will=will,
            timeout=ANSWER_S,
            keepalive=KEEPALIVE_S,
            properties=properties,
            tls_context=access.tls,
            socket_options=[
                (socket.IPPROTO_TCP, socket.TCP_NODELAY, 1),
                (socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES),
            ],
        )
        self._client.connect_timeout = ANSWER_S
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

    async def hear(self, topic: str) -> str | None:
        """Subscribe, QoS 1; None, or why the broker does not let us.

        Raises:
            aiomqtt.MqttError: no answer.
        """
        for code in await self.subscribe(topic, qos=1):
            if isinstance(code, ReasonCode) and code.is_failure:
                return str(code)
        return None

    async def send(self, topic: str, payload: bytes, *, qos: int, retain: bool) -> str | None:
        """Publish, and wait until the broker has it (QoS 1) or the system has taken it (QoS 0); None, or why the broker refuses it.

        Raises:
            aiomqtt.MqttError: the connection is gone, or nothing happened within `ANSWER_S`.
        """
        info = self._client.publish(topic, payload, qos=qos, retain=retain)
        if info.rc != 0:
            raise aiomqtt.MqttCodeError(info.rc, "could not publish")
        done: asyncio.Future[ReasonCode] = asyncio.get_running_loop().create_future()
        self._under_way[info.mid] = done
        try:
            async with asyncio.timeout(ANSWER_S):
                code = await done
        except TimeoutError:
            raise aiomqtt.MqttError(f"the broker took nothing for {ANSWER_S:g} s") from None
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

    async def drop(self, *, with_will: bool) -> None:
        """Close, whatever state it is in.

        Args:
            with_will: without a word, so that the broker says the last will.
        """
        if not with_will:
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


def why(error: aiomqtt.MqttError) -> str:
    """One line of an error, without the library's own framing."""
    cause = error.__cause__ if isinstance(error.__cause__, aiomqtt.MqttError) else error
    code = getattr(cause, "rc", None)
    if isinstance(code, ReasonCode):
        return str(code)
    return str(cause).split("] ")[-1] or "no answer"


def _logger() -> logging.Logger:
    """What the library says of a connection is said by us, in our words."""
    logger = logging.getLogger("companion.telemetry.mqtt")
    logger.propagate = False
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger
