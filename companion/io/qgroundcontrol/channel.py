"""What flight process and relay say to each other: JSON objects. The relay faces the network, so nothing of it is decoded as code.

`marshal` would be five times as fast, and its decoder is not made for data that may be forged. Here is one small message at 4 Hz.
"""

from __future__ import annotations

import json
from typing import Any


def pack(message: dict[str, Any]) -> bytes:
    """One message as a packet."""
    return json.dumps(message).encode()


def unpack(packet: bytes) -> dict[str, Any]:
    """The message in a packet; empty if there is none in it. Never raises."""
    try:
        message = json.loads(packet)
    except (ValueError, RecursionError):
        return {}
    return message if isinstance(message, dict) else {}
