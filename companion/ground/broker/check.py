"""Finds the permissions of a login at a broker by trying to subscribe, to publish an empty message, and to receive."""

from __future__ import annotations

import asyncio
import secrets
import socket
import ssl
from dataclasses import dataclass

import aiomqtt

from companion.ground.protocol.access import BrokerAccess
from companion.ground.protocol.connection import Connection, error_text, reason_code, remedy
from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, Topic, vehicle_of
from companion.runtime.tasks import until_first

ANSWER_S = 5.0


class CheckError(Exception):
    """The broker is unreachable or refuses the connection. The exception's text is one line."""


@dataclass(frozen=True, slots=True)
class TopicRights:
    """Permissions on one topic."""

    topic: Topic
    read: bool | None
    """None if subscribing is allowed but no message was available."""
    write: bool


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Permissions of a login at a broker."""

    tls: str | None
    """TLS version; None without TLS."""
    certificate_ends: str | None
    rights: tuple[TopicRights, ...]
    vehicles: tuple[str, ...]


def check(access: BrokerAccess, vehicle: str | None = None) -> CheckResult:
    """Connect and try every topic.

    Args:
        vehicle: vehicle whose topics are tested: each of its readers, and the vehicle itself on ``command``, counts one rejected
            message. None to use a name that no vehicle has.

    Raises:
        CheckError: no connection, or no answer.
    """
    tls, ends = _probe(access)
    name = vehicle or f"check-{secrets.token_hex(4)}"
    granted, written, found = asyncio.run(_try_topics(access, name))
    received = {topic for _, topic in found}
    rights = tuple(
        TopicRights(
            topic, topic in granted and (topic in received or (False if topic in written else None)), topic in written
        )
        for topic in Topic
    )
    return CheckResult(tls, ends, rights, tuple(sorted({vehicle for vehicle, _ in found} - {name})))


async def _try_topics(access: BrokerAccess, name: str) -> tuple[set[Topic], set[Topic], list[tuple[str, Topic]]]:
    """Return the topics that can be read, those that can be written, and vehicle and topic of each received message."""
    granted: set[Topic] = set()
    written: set[Topic] = set()
    found: list[tuple[str, Topic]] = []

    def on_message(topic: str, payload: bytes, retained: bool) -> None:
        vehicle = vehicle_of(topic)
        if vehicle is not None:
            found.append(vehicle)

    async def try_all() -> None:
        for topic in Topic:
            if await client.subscribe_topic(topic.of("+"), 1) is None:
                granted.add(topic)
        for topic in Topic:  # every receiver rejects an empty message
            if await client.publish_message(topic.of(name), b"", qos=1) is None:
                written.add(topic)
        # The broker answers in order: all messages of these subscriptions arrive before this answer.
        await client.unsubscribe([topic.of("+") for topic in Topic])

    identifier = f"companion-check-{secrets.token_hex(6)}"
    client = Connection(access, identifier, on_message, packet_max_bytes=2 * MESSAGE_MAX_BYTES, answer_s=ANSWER_S)
    try:
        try:
            await client.open()
        except aiomqtt.MqttError as error:
            login = "without a login" if access.username is None else f"as {access.username}"
            code = reason_code(error)
            text = f"no MQTT broker answers: {error_text(error)}; for a TLS port use mqtts://"
            if code is not None:
                text = f"the broker refuses the connection {login}: {code}{remedy(code)}"
            raise CheckError(f"{access.address}: {text}") from None
        try:
            await until_first(client.wait_broken(), try_all())
        except aiomqtt.MqttError as error:
            raise CheckError(f"{access.address}: the broker ended the connection: {error_text(error)}") from None
    finally:
        await client.shut_down()
    return granted, written, found


def _probe(access: BrokerAccess) -> tuple[str | None, str | None]:
    """Return the broker's TLS version and certificate expiry, both None without TLS, by a connection of its own; raises CheckError."""
    address = access.address
    try:
        with socket.create_connection((address.host, address.port), ANSWER_S) as plain:
            if access.tls is None:
                return None, None
            with access.tls.wrap_socket(plain, server_hostname=address.host) as secure:
                return secure.version(), str((secure.getpeercert() or {}).get("notAfter"))
    except ssl.SSLCertVerificationError as error:
        text = f"the broker's certificate is not trusted: {error.verify_message}; expected one for {address.host}, "
        raise CheckError(f"{address}: {text}signed by the authority of --ca") from None
    except TimeoutError:
        raise CheckError(f"{address}: no answer within {ANSWER_S:g} s") from None
    except OSError as error:
        if isinstance(error, ssl.SSLError) or (address.tls and isinstance(error, ConnectionResetError)):
            reason = getattr(error, "reason", None) or error.strerror
            raise CheckError(f"{address}: the port does not use TLS ({reason}); check the port") from None
        raise CheckError(f"{address}: {error.strerror or error}; check that the broker is running") from None
