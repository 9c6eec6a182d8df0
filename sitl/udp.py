"""A UDP socket on the event loop, used by every MAVLink link of the simulated world."""

from __future__ import annotations

import asyncio
import contextlib
from typing import cast

Address = tuple[str, int]

CLOSE_DEADLINE_S = 1.0


class UdpEndpoint(asyncio.DatagramProtocol):
    """One socket; `loop.create_datagram_endpoint` opens it. A subclass handles datagrams in `datagram_received`."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._closed = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the bound socket."""
        # Python 3.11's selector transport is a datagram transport in all but its base classes.
        self._transport = cast(asyncio.DatagramTransport, transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Record that the socket is closed."""
        self._transport = None
        self._closed.set()

    def error_received(self, exc: Exception) -> None:
        """Ignore an ICMP error, which means that the other end is not listening yet."""

    @property
    def port(self) -> int:
        """Local port; 0 while the socket is not open."""
        return 0 if self._transport is None else int(self._transport.get_extra_info("sockname")[1])

    def send_to(self, data: bytes, address: Address) -> None:
        """Send one datagram; nothing happens while the socket is not open."""
        if self._transport is not None:
            self._transport.sendto(data, address)

    async def close(self) -> None:
        """Close the socket and wait at most `CLOSE_DEADLINE_S` until it is closed."""
        if self._transport is not None:
            self._transport.close()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_DEADLINE_S):
                    await self._closed.wait()
