"""Addresses of the link to PX4."""

from __future__ import annotations

import re
from dataclasses import dataclass

_ADDRESS = re.compile(
    r"(?P<net>udpin|udpout|tcpout)://(?P<host>[^:/?\s]+):(?P<port>\d+)"
    r"|(?P<serial>serial|serial_flowcontrol)://(?P<path>/.+):(?P<baud>\d+)"
)
_FORMS = "udpin://0.0.0.0:14540, udpout://HOST:PORT, tcpout://HOST:PORT or serial:///dev/ttyAMA0:921600"


@dataclass(frozen=True, slots=True)
class AddressParts:
    """Parts of an address of PX4."""

    kind: str
    """udpin, udpout, tcpout, serial or serial_flowcontrol."""
    host: str
    """Host, or the path of the device on a serial link, which may contain colons (/dev/serial/by-path)."""
    port: int
    """Port, or the baud rate on a serial link."""

    @property
    def serial(self) -> bool:
        """Return whether the link is a serial port."""
        return self.kind in ("serial", "serial_flowcontrol")


def parse_address(address: str) -> AddressParts:
    """Return the parts of an address of PX4.

    Raises:
        ValueError: the address has none of the known forms, or its port does not exist.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise ValueError(f"expected an address like {_FORMS}, got {address!r:.80}")
    if match["serial"]:
        return AddressParts(match["serial"], match["path"], int(match["baud"]))
    parts = AddressParts(match["net"], match["host"], int(match["port"]))
    if not 0 < parts.port <= 65535:
        raise ValueError(f"expected a port from 1 to 65535, got {parts.port}")
    return parts
