"""Text of the mosquitto configuration for a broker that several computers use: mosquitto.conf(5) and its access list. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from companion.ground.protocol.messages import MESSAGE_MAX_BYTES, Topic

INSTALLED = Path("/etc/mosquitto/companion")
"""Where the system service finds the files."""
PLAIN_PORT = 1883
TLS_PORT = 8883
VIEWED = tuple(topic for topic in Topic if topic is not Topic.COMMAND)
"""Topics that the vehicle writes and people read."""
_PACKET_ROOM_BYTES = 62_144
"""Topic, properties, and room to grow; the packet's limit counts them too."""


def profile_text(folder: Path) -> str:
    """mosquitto.conf(5) of a broker that people on other computers use; its other files are in `folder`."""
    return f"""\
# For several computers: TLS and a login from everywhere, no TLS but a login all the same from this computer. Made by
# companion broker init; docs/broker.md says what each line is for.
listener {TLS_PORT}
certfile {folder}/server.pem
keyfile {folder}/server.key
tls_version tlsv1.2
max_connections 100

listener {PLAIN_PORT} 127.0.0.1
max_connections 100

# For both: who is who, and who may do what. What is refused comes back to an MQTT 5 client as reason code 135.
allow_anonymous false
password_file {folder}/passwords
acl_file {folder}/acl

# Nothing that a client does lets the broker grow without end, and nothing of yesterday comes back.
max_packet_size {MESSAGE_MAX_BYTES + _PACKET_ROOM_BYTES}
max_queued_messages 1000
max_queued_bytes 8000000
persistence false
set_tcp_nodelay true

log_type error
log_type warning
log_type notice
log_type information
# mosquitto 2.0 tells a denied message in this type alone. It tells every other one too: some 150 bytes for each that goes in or out.
log_type debug
"""


def acl_text(vehicles: Sequence[str], operators: Sequence[str], viewers: Sequence[str]) -> str:
    """The access list, mosquitto.conf(5) `acl_file`: what is not named is denied.

    Args:
        vehicles: names in topics, which are their logins too.
        operators: logins that may command every vehicle.
        viewers: logins that may look on.
    """
    blocks = ["# Who may read and write what; what is not named is denied, and nobody reads $SYS."]
    for vehicle in vehicles:
        written = [f"topic write {topic.of(vehicle)}" for topic in VIEWED]
        blocks.append("\n".join([f"user {vehicle}", *written, f"topic read {Topic.COMMAND.of(vehicle)}"]))
    read = [f"topic read {topic.of('+')}" for topic in VIEWED]
    for operator in operators:
        blocks.append("\n".join([f"user {operator}", *read, f"topic write {Topic.COMMAND.of('+')}"]))
    for viewer in viewers:
        blocks.append("\n".join([f"user {viewer}", *read]))
    return "\n\n".join(blocks) + "\n"
