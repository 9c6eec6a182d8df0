"""Messages between flight process and relay, as JSON objects. The relay faces the network, so nothing from it is decoded by `marshal`.

`marshal` would be five times as fast, but its decoder is not safe for forged data, and JSON is fast enough for one small message at 4
Hz.
"""

from __future__ import annotations

import json
from typing import Any


def pack(message: dict[str, Any]) -> bytes:
    """Return one message as a packet."""
    return json.dumps(message).encode()


def unpack(packet: bytes) -> dict[str, Any]:
    """Return the message in a packet; empty if it is malformed. Never raises."""
    try:
        message = json.loads(packet)
    except (ValueError, RecursionError):
        return {}
    return message if isinstance(message, dict) else {}
