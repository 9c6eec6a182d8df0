"""Permissions of a login at a broker, found by trying: connect, subscribe, publish an empty message, and see what arrives."""

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
"""Timeout for each answer of the broker."""
_PROBE = b""
"""An empty message, which every receiver rejects."""


class CheckError(Exception):
    """The broker is unreachable or refuses the connection; one line."""


@dataclass(frozen=True, slots=True)
class TopicRights:
    """Permissions on one topic."""

    topic: Topic
    read: bool | None
    """None if subscribing is allowed but no message was there to be read."""
    write: bool


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Permissions of a login at a broker."""

    tls: str | None
    """TLS version, or None."""
    certificate_ends: str | None
    rights: tuple[TopicRights, ...]
    vehicles: tuple[str, ...]
    """Vehicles with a retained message."""


def check(access: BrokerAccess, vehicle: str | None = None) -> CheckResult:
    """Connect and try every topic.

    Args:
        access: broker, login, certificates.
        vehicle: vehicle whose topics are written to; its readers, and the vehicle itself on ``command``, count one rejected message
            each. None for a name that no vehicle has.

    Raises:
        CheckError: no connection, or no answer.
    """
    name = vehicle or f"check-{secrets.token_hex(4)}"
    # First, because paho leaves the socket open if TLS fails.
    tls, ends = _certificate(access)
    client = _Client(access)
    try:
        client.connect()
        granted = {topic: not client.subscribe(topic.of("+")).is_failure for topic in Topic}
        written = {topic: not client.publish(topic.of(name)).is_failure for topic in Topic}
        # The broker answers in order: all messages of these subscriptions arrive before this answer.
        client.unsubscribe([topic.of("+") for topic in Topic])
    finally:
        client.close()
    received = {topic for found in map(vehicle_of, client.received_topics) if found for topic in [found[1]]}
    rights = tuple(
        TopicRights(
            topic, granted[topic] and (topic in received or (False if written[topic] else None)), written[topic]
        )
        for topic in Topic
    )
    vehicles = {found[0] for found in map(vehicle_of, client.received_topics) if found} - {name}
    return CheckResult(tls, ends, rights, tuple(sorted(vehicles)))


def _unreachable(access: BrokerAccess, error: OSError) -> str:
    address = access.address
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"{address}: the broker's certificate is not trusted: {error.verify_message}; expected one for {address.host}, "
            "signed by the authority of --ca"
        )
    if isinstance(error, ssl.SSLError) or (address.tls and isinstance(error, ConnectionResetError)):
        return (
            f"{address}: the port does not use TLS ({getattr(error, 'reason', None) or error.strerror}); check the port"
        )
    if isinstance(error, TimeoutError):
        return f"{address}: no answer within {ANSWER_S:g} s"
    return f"{address}: {error.strerror or error}; check that the broker is running"


def _certificate(access: BrokerAccess) -> tuple[str | None, str | None]:
    """Return the TLS version and the expiry of the broker's certificate, both None without TLS; uses a connection of its own."""
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


class _Client:
    """One connection with blocking calls; paho's thread queues the answers."""

    def __init__(self, access: BrokerAccess) -> None:
        self._access = access
        self._answers: queue.SimpleQueue[tuple[str, int, Any]] = queue.SimpleQueue()
        self.received_topics: list[str] = []
        """Topics of received messages."""
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
        client.on_message = lambda c, u, message: self.received_topics.append(message.topic)
        self._client = client

    def connect(self) -> None:
        """Connect and wait for the broker's answer.

        Raises:
            CheckError: no answer, or a refusal.
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
            raise CheckError(f"{address}: the broker refuses the connection {login}: {code}; see --login")

    def subscribe(self, topic: str) -> ReasonCode:
        """Subscribe; return the broker's reason code."""
        code, mid = self._client.subscribe(topic, qos=1)
        return cast(ReasonCode, self._answer("subscribe", mid or 0, code))

    def publish(self, topic: str) -> ReasonCode:
        """Publish without retaining; return the broker's reason code."""
        info = self._client.publish(topic, _PROBE, qos=1)
        return cast(ReasonCode, self._answer("publish", info.mid, info.rc))

    def unsubscribe(self, topics: Sequence[str]) -> None:
        """Unsubscribe and wait for the answer."""
        code, mid = self._client.unsubscribe(list(topics))
        self._answer("unsubscribe", mid or 0, code)

    def close(self) -> None:
        """End the connection and the thread in whatever state they are."""
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
