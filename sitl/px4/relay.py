"""A UDP relay between the companion and a real PX4, only for faults of their link: dead, or slow both ways."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any, cast

from sitl.px4.process import HOST, Instance


class Relay:
    """Binds the port that PX4 sends to, and one for the companion.

    Args:
        instance: claimed.
    """

    def __init__(self, instance: Instance) -> None:
        self.down = False
        self.delay_s = 0.0
        """One way."""
        self.heard = 0
        """Datagrams of both sides."""
        self._instance = instance
        self._px4 = _End(self, instance.onboard_address)
        self._companion = _End(self, None)

    @contextlib.asynccontextmanager
    async def opened(self) -> AsyncIterator[str]:
        """Relay while inside; the value is the companion's address."""
        loop = asyncio.get_running_loop()
        self._px4.other, self._companion.other = self._companion, self._px4
        await loop.create_datagram_endpoint(lambda: self._px4, local_addr=(HOST, self._instance.onboard_port))
        try:
            transport, _ = await loop.create_datagram_endpoint(lambda: self._companion, local_addr=(HOST, 0))
            yield f"udpout://{HOST}:{transport.get_extra_info('sockname')[1]}"
        finally:
            for end in (self._px4, self._companion):
                await end.close()


class _End(asyncio.DatagramProtocol):
    """One side: passes on to the other what it hears."""

    def __init__(self, relay: Relay, partner: tuple[str, int] | None) -> None:
        self.other: _End | None = None
        self._relay = relay
        self._partner = partner
        """None: whoever speaks first."""
        self._transport: asyncio.DatagramTransport | None = None
        self._closed = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        self._closed.set()

    def error_received(self, exc: Exception) -> None:
        """Nobody there: UDP does not care."""

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self._relay.heard += 1
        if self._partner is None or self is not self._relay._px4:
            self._partner = (addr[0], addr[1])
        if self._relay.down or self.other is None:
            return
        if self._relay.delay_s:
            asyncio.get_running_loop().call_later(self._relay.delay_s, self.other.send, data)
        else:
            self.other.send(data)

    def send(self, data: bytes) -> None:
        if self._transport is not None and self._partner is not None and not self._relay.down:
            self._transport.sendto(data, self._partner)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            await self._closed.wait()
