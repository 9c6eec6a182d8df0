"""The traffic on the link to PX4: what arrives is read and shared out, what is sent is numbered, and a link that was lost is opened
again.
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable

from companion.io.px4 import messages
from companion.io.px4.frames import FrameReader, FrameWriter
from companion.io.px4.inbox import Inbox
from companion.io.px4.wire import OpenWire, UdpWire, open_wire
from companion.io.reopening import Reopening
from companion.runtime.clock import Clock

_RELAY_DATAGRAMS_MAX = 16
_DATAGRAM_MAX_BYTES = 65535


class Traffic:
    """The open link; what the flight uses goes into the inbox, everything else to MAVSDK.

    Args:
        address: as in `devices.autopilot.address`.
        wire: the open link, which this object closes.
        own_ids: own system and component id.
        stream: whether the link is a stream of bytes and not of datagrams.
        to_mavsdk: takes the frames of all messages but those that the inbox reads from their bytes.
        reports: receives a line when the link is lost and when it is open again.
    """

    def __init__(
        self,
        address: str,
        wire: OpenWire,
        own_ids: tuple[int, int],
        *,
        stream: bool,
        clock: Clock,
        inbox: Inbox,
        to_mavsdk: Callable[[bytes], object],
        reports: list[str],
    ) -> None:
        self._address, self._clock, self._inbox, self._to_mavsdk, self._reports = (
            address,
            clock,
            inbox,
            to_mavsdk,
            reports,
        )
        self._reader, self._writer = FrameReader(stream=stream), FrameWriter(*own_ids)
        self._wire: OpenWire | None = wire
        self._reopening: Reopening[OpenWire] | None = None
        """Attempts to open a lost link again; None while it is open."""
        self._relay: socket.socket | None = None
        self._system_id = 0
        self.polled_s = -math.inf
        """Flight clock at the last `poll`."""
        self.was_lost = False
        """Whether the link was lost and is open again; whoever requests the streams again sets it back."""

    @property
    def local_port(self) -> int:
        """Own UDP port; 0 if it is unknown or the link is not UDP."""
        return 0 if self._wire is None else self._wire.local_port

    @property
    def remote(self) -> tuple[str, int] | None:
        """PX4's IPv4 address and UDP port; None if the link is not UDP."""
        return None if self._wire is None else self._wire.remote

    def only_from(self, system_id: int) -> None:
        """Read the state from this MAVLink system, which is PX4."""
        self._system_id = self._inbox.system_id = system_id
        if isinstance(self._wire, UdpWire):
            self._wire.system = system_id

    def forward_to(self, port: int) -> int:
        """Forward MAVLink between PX4 and a local UDP port, the only accepted sender; return the local port that sends."""
        self._relay = relay = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        relay.setblocking(False)
        relay.bind(("127.0.0.1", 0))
        relay.connect(("127.0.0.1", port))
        return int(relay.getsockname()[1])

    def poll(self) -> None:
        """Read what has arrived: decode what the flight uses, and pass everything but the vehicle's state to MAVSDK."""
        self.polled_s = self._clock()
        if self._wire is None:
            return
        if self._wire.lost:
            self._restore(self._wire)
            return
        others: list[bytes] = []
        for arrived_s, data in self._wire.receive():
            forwarded: list[bytes] = []
            for message_id, system, component, payload, frame in self._reader.read(data):
                forwarded.append(frame)
                # A gimbal or camera with the same system id has a heartbeat of its own.
                px4 = system == self._system_id and component == messages.MAV_COMP_ID_AUTOPILOT1
                read = self._inbox.readers.get(message_id) if px4 else None
                if read is not None:
                    read(arrived_s, payload)
                    continue
                others.append(frame)
                if px4:
                    self._inbox.take(arrived_s, message_id, frame)
            if self._relay is not None and forwarded:
                with contextlib.suppress(OSError):  # the relay does not keep up or has ended: lost, as on any link
                    self._relay.send(b"".join(forwarded))
        if others:
            self._to_mavsdk(b"".join(others))
        if self._relay is not None:
            self._send_for_relay(self._relay, self._wire)

    def send_message(self, message_id: int, payload: bytes) -> bool:
        """Send a message. Return False if it was not sent."""
        return self._wire is not None and self._wire.send(self._writer.frame(message_id, payload))

    def send_frame(self, frame: bytes) -> bool:
        """Send a frame with the next sequence number. Return False if it was not sent."""
        wire = self._wire
        return wire is not None and wire.send(self._writer.numbered(frame))

    def close(self) -> None:
        """Close the link: nothing is read or sent any more."""
        wire, self._wire = self._wire, None
        for held in (wire, self._reopening, self._relay):
            if held is not None:
                held.close()

    def _restore(self, wire: OpenWire) -> None:
        """Close a lost link, and use it again once it is open again."""
        address = self._address
        if self._reopening is None:
            wire.close()
            self._reports.append(f"autopilot {address}: the connection has ended; trying again")
            self._reopening = Reopening("px4 reopening", lambda: open_wire(address, clock=self._clock))
        elif (again := self._reopening.take()) is not None:
            self._reopening, self._wire, self.was_lost = None, again, True
            self._reports.append(f"autopilot {address}: the connection is open again")

    @staticmethod
    def _send_for_relay(relay: socket.socket, wire: OpenWire) -> None:
        for _ in range(_RELAY_DATAGRAMS_MAX):
            try:
                wire.send(relay.recv(_DATAGRAM_MAX_BYTES))
            except OSError:  # nothing more, or an ICMP error of an earlier send
                return
