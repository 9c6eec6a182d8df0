"""Text of mosquitto.conf(5) and of its access list, for a broker that several computers use. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, Topic

INSTALLED = Path("/etc/mosquitto/companion")
"""Folder of the system service's files."""
PLAIN_PORT = 1883
TLS_PORT = 8883
PUBLISHED_TOPICS = tuple(topic for topic in Topic if topic is not Topic.COMMAND)
"""Topics that the vehicle publishes and ground stations read."""
_PACKET_ROOM_BYTES = 62_144
"""Part of the packet limit for topic, properties and a margin."""


def profile_text(folder: Path) -> str:
    """Return mosquitto.conf(5) of a broker for several computers; its other files are in `folder`."""
    return f"""\
# For several computers: TLS and a login from everywhere, a login without TLS from this computer. Written by
# companion broker init; docs/internals/broker.md explains each line.
listener {TLS_PORT}
certfile {folder}/server.pem
keyfile {folder}/server.key
tls_version tlsv1.2
max_connections 100

listener {PLAIN_PORT} 127.0.0.1
max_connections 100

# For both: users and their permissions. An MQTT 5 client gets reason code 135 for what is refused.
allow_anonymous false
password_file {folder}/passwords
acl_file {folder}/acl

# Limits on memory, whatever clients send; no messages are kept over a restart.
max_packet_size {MESSAGE_MAX_BYTES + _PACKET_ROOM_BYTES}
max_queued_messages 1000
max_queued_bytes 8000000
persistence false
set_tcp_nodelay true

log_type error
log_type warning
log_type notice
log_type information
# mosquitto 2.0 logs denied messages only with this type. It also logs every other message, about 150 bytes each.
log_type debug
"""


def acl_text(vehicles: Sequence[str], operators: Sequence[str], viewers: Sequence[str]) -> str:
    """Return the access list, mosquitto.conf(5) `acl_file`: what is not listed is denied.

    Args:
        vehicles: vehicle names as used in topics, also their logins.
        operators: logins that may command every vehicle.
        viewers: logins that may only read.
    """
    blocks = ["# Permissions by user; what is not listed is denied, including $SYS."]
    for vehicle in vehicles:
        written = [f"topic write {topic.of(vehicle)}" for topic in PUBLISHED_TOPICS]
        blocks.append("\n".join([f"user {vehicle}", *written, f"topic read {Topic.COMMAND.of(vehicle)}"]))
    read = [f"topic read {topic.of('+')}" for topic in PUBLISHED_TOPICS]
    for operator in operators:
        blocks.append("\n".join([f"user {operator}", *read, f"topic write {Topic.COMMAND.of('+')}"]))
    for viewer in viewers:
        blocks.append("\n".join([f"user {viewer}", *read]))
    return "\n\n".join(blocks) + "\n"
