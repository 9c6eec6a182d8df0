"""The local channel between the launcher and the flight process: short JSON messages on a SOCK_SEQPACKET pair.

Flight to launcher: `status` (10 a second), `event`, `px4`, `command` (one that came over the air, and what it did), `ground` (how the
way to the ground stations is), `started`, `refused`, `result`. Launcher to flight: `land`. The flight never
waits for the launcher: a full channel loses the message. A launcher that is gone (end of file) means that nobody watches: the flight
lands.
"""

from __future__ import annotations

import json
import socket
from typing import Any

Message = dict[str, Any]
MAX_MESSAGE_BYTES = 60_000


def send(channel: socket.socket, message: Message) -> bool:
    """Send without waiting; False: it was lost."""
    try:
        channel.send(json.dumps(message).encode()[:MAX_MESSAGE_BYTES], socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
    except OSError:
        return False
    return True


def receive(channel: socket.socket) -> Message | None:
    """One message that is there; None at the end of the channel.

    Raises:
        BlockingIOError: nothing is there (non-blocking channel).
    """
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
