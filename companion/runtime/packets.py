"""Kinds of packets on the recorder's channel; the first element of each. The second is its number, counted by the flight process."""

from __future__ import annotations

TICK = 0
"""Inputs, outputs, sent (plain)."""
TEXT = 1
"""Time on the flight clock, severity value, source, text."""
METADATA = 2
"""Name, dict of strings."""
CLOSE = 3
"""Nothing more comes; the number is that of packets offered before."""
UNNUMBERED = -1
"""Number of a packet that the guardian sends: it does not count them."""
ACK = 4
"""What came of a command: nonce, operator, command, accepted, text, time on the flight clock, phase, action."""
