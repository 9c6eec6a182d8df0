"""The local channel between the launcher and the flight process: short JSON messages on a SOCK_SEQPACKET pair.

Flight to launcher: `status` (10 a second), `event`, `px4`, `command` (a command from the ground, and its effect), `ground` (state
of the connection to ground stations), `started`, `refused`, `result`. Launcher to flight: `land`. The flight process never waits
for the launcher: if the channel is full, the message is lost. If the launcher has ended (end of file), the flight process lands.
"""

from __future__ import annotations

import json
import socket
from typing import Any

Message = dict[str, Any]
MAX_MESSAGE_BYTES = 60_000


def send(channel: socket.socket, message: Message) -> bool:
    """Send without waiting; return False if the message was lost."""
    try:
        channel.send(json.dumps(message).encode()[:MAX_MESSAGE_BYTES], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
    except OSError:
        return False
    return True


def receive(channel: socket.socket) -> Message | None:
    """Return one message, or None if the peer has closed the channel."""
    try:
        data = channel.recv(MAX_MESSAGE_BYTES + 1)
    except ConnectionResetError:
        return None
    if not data:
        return None
    try:
        message = json.loads(data)
    except ValueError:
        return {}
    return message if isinstance(message, dict) else {}
