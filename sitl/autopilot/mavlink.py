"""MAVLink 2 of the PX4 stub over UDP on 127.0.0.1: an onboard link and, optionally, links to a ground station and to another program.

As in PX4 SITL, a link sends to its remote port until a message arrives, and then to the sender of that message until PX4 reboots;
messages from other senders are handled too. A link without a remote port sends to the newest sender. Streams run on world time,
driven by `pump`; messages are handled when they arrive.
"""

from __future__ import annotations

import asyncio
import errno
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.receive import Receiver, hash_check_message, param_value_message
from sitl.autopilot.streams import Schedule
from sitl.udp import Address, UdpEndpoint

Message = Any

_HOST = "127.0.0.1"
_PARAMS_PER_PUMP = 4
_GROUND_STATION_TIMEOUT_S = 2.5
"""Time after the last heartbeat for which a ground station counts as connected (HEARTBEAT_TIMEOUT_US of telemetry_status)."""
_STATUS_TEXT_BYTES = 50
_TEXTS_KEPT, _TEXT_STALE_S = 8, 5.0
"""Length of the mavlink_log queue, and age after which the stream skips a text."""


_STEP_MAX_S = 0.03
_TIME_EPSILON_S = 1e-9


class LinkError(Exception):
    """A UDP port cannot be opened; the text is one line for the user."""


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP ports of one link."""

    local: int
    """Local port; 0 for any free port."""
    remote: int
    """Port to send to; if 0, the link is silent until a datagram arrives."""


ONBOARD_PORTS = Ports(14580, 14540)
GROUND_PORTS = Ports(18570, 14550)
VISION_PORTS = Ports(13030, 13280)
"""The link of PX4 SITL that is meant for a gimbal; here another program sends external vision on it."""


class Link(UdpEndpoint):
    """One MAVLink channel with its own sequence numbers, streams and partner."""

    def __init__(self, stub: Px4Stub, receiver: Receiver, partner: Address | None, ground: bool) -> None:
        super().__init__()
        self.schedule = Schedule(ground)
        self.down = False
        self.delay_s = 0.0
        self.messages_in = 0
        self._stub = stub
        self._receiver = receiver
        self._partner = partner
        self._loyal = partner is not None
        self._spoken_to_of_boot: float | None = None
        system, component = stub.params.integer("MAV_SYS_ID"), stub.params.integer("MAV_COMP_ID")
        self._encoder = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._decoder = _new_decoder()
        self._params_to_send: deque[str | None] = deque()
        self._ground_station_at_s: float | None = None
        self._texts: deque[tuple[float, int, bytes]] = deque(maxlen=_TEXTS_KEPT)
        self._text_id = 0
        self._delayed: deque[tuple[float, Callable[[bytes, Address], None], bytes, Address]] = deque()
        """Datagrams under way: (world time of arrival, handler, data, address)."""
        self.in_lockstep = False
        """Whether the world waits for the companion: time stands between two calls of `pump`."""
        self._pumped: tuple[float, float] | None = None
        """(wall-clock time, world time) of the last `pump`."""

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """Decode and handle a datagram, after `delay_s` of world time."""
        if self.delay_s:
            self._later(self._take, data, (addr[0], addr[1]))
        else:
            self._take(data, (addr[0], addr[1]))

    def _later(self, handle: Callable[[bytes, Address], None], data: bytes, address: Address) -> None:
        now_s = self._stub.t_s if self._pumped is None else self._pumped[1]
        self._delayed.append((now_s + self.delay_s, handle, data, address))

    def _take(self, data: bytes, addr: Address) -> None:
        if self.down:
            return
        messages = self._decoder.parse_buffer(data)
        if self._decoder.buf_len():
            self._decoder = _new_decoder()  # a truncated message must not consume the next datagrams
        for message in messages or ():
            if message.get_type() == "BAD_DATA":
                continue
            self.messages_in += 1
            if not self._loyal or self._spoken_to_of_boot != self._stub.booted_at_s:
                self._spoken_to_of_boot, self._partner = self._stub.booted_at_s, addr
            self._stub.since_sample_s = self._since_sample_s()
            self._receiver.handle(self, message)

    def _since_sample_s(self) -> float:
        if self._pumped is None:
            return 0.0
        wall_s, t_s = self._pumped
        since_s = t_s - self._stub.t_s
        if not self.in_lockstep:
            since_s += asyncio.get_running_loop().time() - wall_s
        return min(_STEP_MAX_S, max(0.0, since_s))  # after a longer gap the world counts as paused

    def send(self, message: Message) -> None:
        """Send one message to the partner, if one is known."""
        if self.down or self._transport is None or self._partner is None:
            return
        data = message.pack(self._encoder)
        self._encoder.seq = (self._encoder.seq + 1) % 256
        if self.delay_s:
            self._later(self._send_late, data, self._partner)
        else:
            self.send_to(data, self._partner)

    def _send_late(self, data: bytes, partner: Address) -> None:
        if not self.down:
            self.send_to(data, partner)

    def start_over(self) -> None:
        """Forget what was to be sent: world time starts over. Rates and partner stay."""
        self.schedule.start_over()
        self._texts.clear()
        self._params_to_send.clear()
        self._ground_station_at_s = self._pumped = None
        self._spoken_to_of_boot = self._stub.booted_at_s

    def send_all_params(self) -> None:
        """Queue _HASH_CHECK and every parameter; each `pump` sends a few of them."""
        self._params_to_send = deque([None, *self._stub.params])

    def note_ground_station(self) -> None:
        """Record that a ground station is on this link: PX4 sends STATUSTEXT only on such links, starting with recent texts."""
        self._ground_station_at_s = self._stub.t_s
        self._send_texts()

    def status_text(self, severity: int, text: str) -> None:
        """Queue a STATUSTEXT, which is sent once a ground station is known; a long text is sent in chunks."""
        self._texts.append((self._stub.t_s, severity, text.encode()))
        self._send_texts()

    def _send_texts(self) -> None:
        """Send queued texts as MavlinkStreamStatustext::send does: ids count up from 0, even for texts of one chunk."""
        seen_s, now_s = self._ground_station_at_s, self._stub.t_s
        if seen_s is None or now_s - seen_s > _GROUND_STATION_TIMEOUT_S:
            return
        while self._texts:
            said_s, severity, data = self._texts.popleft()
            if now_s - said_s >= _TEXT_STALE_S:
                continue
            for chunk, start in enumerate(range(0, len(data), _STATUS_TEXT_BYTES)):
                part = data[start : start + _STATUS_TEXT_BYTES]
                self.send(mavlink.MAVLink_statustext_message(severity, part, self._text_id, chunk))
            self._text_id = (self._text_id + 1) % 65536

    def pump(self, t_s: float) -> None:
        """Send the streams that are due at world time `t_s` and a few queued parameters."""
        self._pumped = (asyncio.get_running_loop().time(), t_s)
        while self._delayed and self._delayed[0][0] <= t_s + _TIME_EPSILON_S:
            _, handle, data, address = self._delayed.popleft()
            handle(data, address)
        if self.down or self._partner is None:
            return
        for message in self.schedule.messages(self._stub, t_s):
            self.send(message)
        for _ in range(min(_PARAMS_PER_PUMP, len(self._params_to_send))):
            name = self._params_to_send.popleft()
            self.send(hash_check_message(self._stub) if name is None else param_value_message(self._stub, name))


def _new_decoder() -> Any:
    decoder = mavlink.MAVLink(None)
    decoder.robust_parsing = True
    return decoder


class MavlinkServer:
    """The links of one stub; an async context manager.

    Raises:
        LinkError: on entry, a port is in use or cannot be opened.
    """

    def __init__(
        self,
        stub: Px4Stub,
        onboard: Ports = ONBOARD_PORTS,
        ground: Ports | None = None,
        vision: Ports | None = None,
        *,
        in_lockstep: bool = False,
    ) -> None:
        self._stub = stub
        self._in_lockstep = in_lockstep
        self._wanted = [(onboard, False)] + ([(ground, True)] if ground is not None else [])
        self._vision_wanted = vision
        self._vision: Link | None = None
        self._links: list[Link] = []
        self._down = False

    @property
    def onboard_port(self) -> int:
        """Local port of the onboard link, while it is open."""
        return self._links[0].port

    @property
    def vision_port(self) -> int:
        """Local port of the link to the program that sends external vision, while it is open."""
        assert self._vision is not None
        return self._vision.port

    @property
    def link_down(self) -> bool:
        """Fault: every link is down, except that to the program that sends external vision."""
        return self._down

    @link_down.setter
    def link_down(self, down: bool) -> None:
        self._down = down
        for link in self._links:
            link.down = down

    @property
    def delay_s(self) -> float:
        """Fault: delay of these links in each direction, s."""
        return self._links[0].delay_s if self._links else 0.0

    @delay_s.setter
    def delay_s(self, delay_s: float) -> None:
        for link in self._links:
            link.delay_s = delay_s

    @property
    def messages_in(self) -> int:
        """Number of messages decoded on all links."""
        return sum(link.messages_in for link in self._links)

    def start_over(self) -> None:
        """Forget what was to be sent on all links: world time starts over."""
        for link in self._links if self._vision is None else (*self._links, self._vision):
            link.start_over()

    async def __aenter__(self) -> Self:
        receiver = Receiver(self._stub)
        for ports, ground in self._wanted:
            link = await self._open(receiver, ports, ground)
            link.down = self._down
            self._links.append(link)
        if self._vision_wanted is not None:
            self._vision = await self._open(receiver, self._vision_wanted, False)
        return self

    async def _open(self, receiver: Receiver, ports: Ports, ground: bool) -> Link:
        partner = (_HOST, ports.remote) if ports.remote else None
        link = Link(self._stub, receiver, partner, ground)
        link.in_lockstep = self._in_lockstep
        loop = asyncio.get_running_loop()
        try:
            await loop.create_datagram_endpoint(lambda: link, local_addr=(_HOST, ports.local))
        except OSError as error:
            await self._close()
            found = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be opened ({error.strerror})"
            raise LinkError(
                f"PX4 stub: UDP port {_HOST}:{ports.local} {found}; end the program that uses it or choose another port"
            ) from error
        return link

    async def __aexit__(self, *_: object) -> None:
        await self._close()

    def pump(self, t_s: float) -> None:
        """Send everything that is due at world time `t_s`; call this method every 2 to 4 ms."""
        notices = self._stub.notices
        while notices:
            notice = notices.popleft()
            for link in self._links:
                # As in PX4, the tab marks a text that is also sent as an event; the stub does not send events.
                link.status_text(int(notice.severity), f"{notice.text}\t")
        for link in self._links:
            link.pump(t_s)
        if self._vision is not None:
            self._vision.pump(t_s)

    async def _close(self) -> None:
        links, self._links = self._links, []
        for link in links:
            await link.close()
        if self._vision is not None:
            await self._vision.close()
