"""What a broker lets a login do, found by trying: connect, subscribe, publish rubbish, and see what comes back."""

from __future__ import annotations

import queue
import secrets
import socket
import ssl
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.messages import Topic, vehicle_of

ANSWER_S = 5.0
"""For each answer of the broker."""
_PROBE = b""
"""No message at all: every reader throws it away."""


class CheckError(Exception):
    """The broker cannot be reached, or does not want us; one line."""


@dataclass(frozen=True, slots=True)
class Right:
    """What may be done with one topic."""

    topic: Topic
    read: bool | None
    """None: it lets us subscribe, but nothing was there to be read."""
    write: bool


@dataclass(frozen=True, slots=True)
class Found:
    """What a broker lets a login do."""

    tls: str | None
    """Version of TLS."""
    certificate_ends: str | None
    rights: tuple[Right, ...]
    vehicles: tuple[str, ...]
    """Those that something retained was heard of."""


def check(access: BrokerAccess, vehicle: str | None = None) -> Found:
    """Connect and try every topic.

    Args:
        access: the broker, login, certificates.
        vehicle: whose topics to write to; its readers, and on ``command`` itself, count one message of rubbish each. None: of a name
            that no vehicle has.

    Raises:
        CheckError: no connection, or an answer that does not come.
    """
    name = vehicle or f"check-{secrets.token_hex(4)}"
    # Before paho, which leaves the socket open when TLS fails.
    tls, ends = _certificate(access)
    talk = _Talk(access)
    try:
        talk.connect()
        granted = {topic: not talk.subscribe(topic.of("+")).is_failure for topic in Topic}
        written = {topic: not talk.publish(topic.of(name)).is_failure for topic in Topic}
        # The broker handles what we ask in order: whatever it sends us of the above, it sends before this answer.
        talk.unsubscribe([topic.of("+") for topic in Topic])
    finally:
        talk.close()
    heard = {topic for found in map(vehicle_of, talk.heard) if found for topic in [found[1]]}
    rights = tuple(
        Right(topic, granted[topic] and (topic in heard or (False if written[topic] else None)), written[topic])
        for topic in Topic
    )
    vehicles = {found[0] for found in map(vehicle_of, talk.heard) if found} - {name}
    return Found(tls, ends, rights, tuple(sorted(vehicles)))


def _unreachable(access: BrokerAccess, error: OSError) -> str:
    address = access.address
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"{address}: the broker's certificate is not trusted: {error.verify_message}; expected one for {address.host}, "
            "signed by the authority of --ca"
        )
    if isinstance(error, ssl.SSLError) or (address.tls and isinstance(error, ConnectionResetError)):
        return f"{address}: no TLS there ({getattr(error, 'reason', None) or error.strerror}); is the port right?"
    if isinstance(error, TimeoutError):
        return f"{address}: no answer within {ANSWER_S:g} s"
    return f"{address}: {error.strerror or error}; is the broker running there?"


def _certificate(access: BrokerAccess) -> tuple[str | None, str | None]:
    """(version of TLS, end of the broker's certificate), both None without TLS; over a connection of its own."""
    if access.tls is None:
        return None, None
    try:
        with (
            socket.create_connection((access.address.host, access.address.port), ANSWER_S) as plain,
            access.tls.wrap_socket(plain, server_hostname=access.address.host) as secure,
        ):
            certificate = secure.getpeercert() or {}
            return secure.version(), str(certificate.get("notAfter"))
    except OSError as error:
        raise CheckError(_unreachable(access, error)) from None


class _Talk:
    """One connection, question by question; paho's thread hands its answers over."""

    def __init__(self, access: BrokerAccess) -> None:
        self._access = access
        self._answers: queue.SimpleQueue[tuple[str, int, Any]] = queue.SimpleQueue()
        self.heard: list[str] = []
        """Topics of messages."""
        client = mqtt.Client(
            CallbackAPIVersion.VERSION2, client_id=f"companion-check-{secrets.token_hex(6)}", protocol=mqtt.MQTTv5
        )
        client.connect_timeout = ANSWER_S
        if access.username is not None:
            client.username_pw_set(access.username, access.password)
        if access.tls is not None:
            client.tls_set_context(access.tls)
        client.on_connect = lambda c, u, flags, code, properties: self._answers.put(("connect", 0, code))
        client.on_subscribe = lambda c, u, mid, codes, properties: self._answers.put(("subscribe", mid, codes[0]))
        client.on_unsubscribe = lambda c, u, mid, codes, properties: self._answers.put(("unsubscribe", mid, None))
        client.on_publish = lambda c, u, mid, code, properties: self._answers.put(("publish", mid, code))
        client.on_disconnect = lambda c, u, flags, code, properties: self._answers.put(("disconnect", 0, code))
        client.on_message = lambda c, u, message: self.heard.append(message.topic)
        self._client = client

    def connect(self) -> None:
        """Ask for a connection and wait for the broker's word.

        Raises:
            CheckError: none, or a refusal.
        """
        address = self._access.address
        try:
            self._client.connect(address.host, address.port, keepalive=10)
        except OSError as error:
            raise CheckError(_unreachable(self._access, error)) from None
        connected = self._client.socket()
        if isinstance(connected, socket.socket):
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client.loop_start()
        code = self._answer("connect", 0)
        if code.is_failure:
            login = "without a login" if self._access.username is None else f"as {self._access.username}"
            raise CheckError(f"{address}: the broker refuses us {login}: {code}; see --login")

    def subscribe(self, topic: str) -> ReasonCode:
        """The broker's word."""
        code, mid = self._client.subscribe(topic, qos=1)
        return cast(ReasonCode, self._answer("subscribe", mid or 0, code))

    def publish(self, topic: str) -> ReasonCode:
        """The broker's word; nothing is retained."""
        info = self._client.publish(topic, _PROBE, qos=1)
        return cast(ReasonCode, self._answer("publish", info.mid, info.rc))

    def unsubscribe(self, topics: Sequence[str]) -> None:
        """Wait until it is done."""
        code, mid = self._client.unsubscribe(list(topics))
        self._answer("unsubscribe", mid or 0, code)

    def close(self) -> None:
        """End the connection and the thread, whatever state they are in."""
        self._client.disconnect()
        self._client.loop_stop()

    def _answer(self, kind: str, mid: int, sent: MQTTErrorCode = MQTTErrorCode.MQTT_ERR_SUCCESS) -> Any:
        deadline_s = time.monotonic() + ANSWER_S
        if sent != MQTTErrorCode.MQTT_ERR_SUCCESS:
            raise CheckError(f"{self._access.address}: {mqtt.error_string(sent)}")
        while True:
            try:
                found, number, value = self._answers.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise CheckError(f"{self._access.address}: no answer to {kind} within {ANSWER_S:g} s") from None
            if found == "disconnect":
                raise CheckError(f"{self._access.address}: the broker ended the connection: {value}")
            if (found, number) == (kind, mid):
                return value
