"""A UDP relay between the companion and a real PX4 that injects link faults: loss, or a delay in both directions."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

from sitl.px4.process import HOST, Instance
from sitl.udp import Address, UdpEndpoint


class Relay:
    """Relays datagrams between the port to which PX4 sends and a port for the companion.

    Args:
        instance: the PX4 instance number that this process has reserved.
    """

    def __init__(self, instance: Instance) -> None:
        self.down = False
        self.delay_s = 0.0
        self.datagrams = 0
        """Number of datagrams received from both sides."""
        self._instance = instance
        self._px4 = _Side(self, instance.onboard_address)
        self._companion = _Side(self, None)

    @contextlib.asynccontextmanager
    async def opened(self) -> AsyncIterator[str]:
        """Relay while the context is open, and yield the address to which the companion connects."""
        loop = asyncio.get_running_loop()
        self._px4.other, self._companion.other = self._companion, self._px4
        await loop.create_datagram_endpoint(lambda: self._px4, local_addr=(HOST, self._instance.onboard_port))
        try:
            await loop.create_datagram_endpoint(lambda: self._companion, local_addr=(HOST, 0))
            yield f"udpout://{HOST}:{self._companion.port}"
        finally:
            for side in (self._px4, self._companion):
                await side.close()


class _Side(UdpEndpoint):
    """One side of the relay: forwards every datagram to the other side."""

    def __init__(self, relay: Relay, peer: Address | None) -> None:
        super().__init__()
        self.other: _Side | None = None
        self._relay = relay
        self._fixed = peer is not None
        self._peer = peer
        """Address to which this side sends; without a fixed peer, the newest sender."""

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self._relay.datagrams += 1
        if not self._fixed:
            self._peer = (addr[0], addr[1])
        if self._relay.down or self.other is None:
            return
        if self._relay.delay_s:
            asyncio.get_running_loop().call_later(self._relay.delay_s, self.other.forward, data)
        else:
            self.other.forward(data)

    def forward(self, data: bytes) -> None:
        if self._peer is not None and not self._relay.down:
            self.send_to(data, self._peer)
