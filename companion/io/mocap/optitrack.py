"""OptiTrack Motive over NatNet, multicast or unicast, as a motion-capture system: sockets around `companion.io.mocap.client`."""

from __future__ import annotations

import contextlib
import errno
import logging
import math
import socket
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final

from companion.io.arrival import arrived_s
from companion.io.mocap import natnet, sockets
from companion.io.mocap.client import SUPPORTED_VERSIONS, NatNetClient
from companion.io.mocap.frames import Frame
from companion.io.mocap.natnet import Message
from companion.io.mocap.system import Counts, ExtendedClient, MocapSettings
from companion.io.protocols import DeviceError
from companion.model.markers import MarkerFrame
from companion.model.team import BarPose
from companion.model.types import MocapPose

if TYPE_CHECKING:
    from companion.config.devices import NatNetOptions

_LOG: Final = logging.getLogger(__name__)
_DUE: Final = 0.9
"""Requests are sent in the call that is nearest to their period."""


class _Options:
    """Imports the model at use: a guardian does without pydantic."""

    def __get__(self, *_: object) -> type[NatNetOptions]:
        from companion.config.devices import NatNetOptions

        return NatNetOptions


class OptiTrack(ExtendedClient):
    """Receives the poses of one rigid body from Motive; implements `companion.io.mocap.system.PoseClient`.

    Raises:
        DeviceError: the server's name cannot be resolved, or a socket cannot be opened.
    """

    options: ClassVar[Any] = _Options()
    sees_markers: ClassVar[bool] = True

    def __init__(self, settings: MocapSettings) -> None:
        self._settings = settings
        self.where = f"mocap {settings.server}:{settings.command_port}"
        try:
            self.server_ip = socket.gethostbyname(settings.server)
        except OSError:
            raise DeviceError(
                f"{self.where}: the name cannot be resolved; put the Motive computer's IPv4 address into devices.mocap.server"
            ) from None
        self.sockets: list[socket.socket] = []
        self.protocol = NatNetClient(settings.rigid_body_id, settings.up_axis, settings.transport, ball=settings.ball)
        self._markers: MarkerFrame | None = None
        self._bar: BarPose | None = None
        self._foreign = 0
        self._foreign_ip: str | None = None
        self._unsent = ""
        """Why the newest datagram that could not be sent was not."""
        self._sent_s = -math.inf
        self._described = False
        """Whether the bodies' names have been requested."""
        self._joining = threading.Thread()
        """Joins the multicast group again."""
        try:
            self._command = self._open(settings.interface, 0, "interface")
            if settings.transport == "multicast":  # a unicast server sends frames to the address of the requests
                self._join()
        except DeviceError:
            self.close()
            raise

    @property
    def server_name(self) -> str:
        """Return the server's program and protocol version; empty before it has answered."""
        return "" if self.protocol.info is None else self.protocol.info.name

    @property
    def problem(self) -> str | None:
        """Return why the newest rejected datagram was invalid; None if none was rejected."""
        return self.protocol.problem

    def protocol_version(self) -> str:
        """Return the NatNet version."""
        return "" if self.protocol.info is None else self.protocol.info.version

    def bodies(self) -> Mapping[int, str] | None:
        """Return the rigid bodies of the newest frame by streaming id; the name is empty if the server has not sent it."""
        ids, names = self.protocol.body_ids, self.protocol.names
        return None if ids is None else {number: names.get(number, "") for number in ids}

    def markers(self) -> MarkerFrame | None:
        """Return the single markers of the newest frame, or None if the mission follows no ball."""
        return self._markers

    def bar(self) -> BarPose | None:
        """Return the bar's rigid body in the newest frame that had it; None before the first, and without `bar_id`."""
        return self._bar

    def counts(self) -> Counts:
        """Return the numbers of dropped datagrams."""
        return Counts(self.protocol.out_of_order, self.protocol.malformed, self._foreign)

    def has_two_streams(self) -> bool:
        """Return whether two servers are sending from one address."""
        return self.protocol.two_streams

    def keep_connected(self, now_s: float) -> None:
        """Send connect requests, keep-alives and echo requests when they are due, and ask once for the bodies' names.

        If frames have stopped, join the multicast group again: a network interface that was unplugged and comes back is in no group.
        """
        protocol = self.protocol
        if protocol.version is not None and not self._described:
            self._described, self._sent_s = True, -math.inf
            self._send([natnet.encode_request(Message.REQUEST_MODELDEF)])
            if protocol.version > natnet.NEWEST_DESCRIBED_VERSION:
                text = "%s: NatNet %d.%d is later than %d.%d; sections that are not known are skipped"
                _LOG.warning(text, self.where, *protocol.version, *natnet.NEWEST_DESCRIBED_VERSION)
        if now_s - self._sent_s >= _DUE * protocol.request_period_s:
            self._sent_s = now_s
            self._send(protocol.requests(now_s))
        if self._settings.transport == "multicast" and protocol.is_silent(now_s) and not self._joining.is_alive():
            with contextlib.suppress(
                OSError, RuntimeError
            ):  # no descriptor or thread is left; the next call tries again
                self._joining = threading.Thread(target=self._join_again, args=(self.sockets[-1].dup(),), daemon=True)
                self._joining.start()

    def poses(self, now_s: float) -> list[MocapPose]:
        """Return the body's poses that have arrived, in order, stamped with their arrival."""
        found, clock = [], self.clock or (lambda: now_s)
        for opened in self.sockets:
            for data, ancillary, sender_ip in sockets.waiting(opened):
                if sender_ip != self.server_ip:
                    self._foreign += 1
                    self._foreign_ip = sender_ip
                    continue
                stamp_s = arrived_s(ancillary, clock)
                frame = self.protocol.receive(data, stamp_s)
                if frame is not None:
                    self.take(frame, data, stamp_s)
                    self._markers = self.protocol.markers(frame, data, stamp_s)
                    if (bar_id := self._settings.bar_id) is not None:
                        self._bar = self.protocol.bar(frame, data, bar_id, stamp_s) or self._bar
                    if frame.body is not None and (pose := self.protocol.pose(frame, stamp_s)) is not None:
                        found.append(pose)
        return found

    def take(self, frame: Frame, datagram: bytes, stamp_s: float) -> None:
        """Do nothing with a frame; a tool overrides it."""

    def close(self) -> None:
        """Disconnect from the server and close the sockets."""
        if self.sockets:
            self._send(self.protocol.farewell())
        for opened in self.sockets:
            opened.close()
        self.sockets.clear()

    def refusal(self) -> str | None:
        """Return why the flight must not start with the server's settings, or with its bodies."""
        return self.server_refusal() or self._body_refusal()

    def server_refusal(self) -> str | None:
        """Return why the server's version or transport is not that of the settings."""
        settings, info, version = self._settings, self.protocol.info, self.protocol.version
        if info is None:
            return None
        wanted = settings.natnet_version
        if version is None or (wanted is not None and info.version != wanted):
            return (
                f"{info.application or 'the server'} speaks NatNet {info.version}, expected {wanted or SUPPORTED_VERSIONS}; "
                "set the bitstream version in Motive's streaming pane or devices.mocap.natnet_version"
            )
        if settings.transport != "multicast" or info.multicast is None:
            return None
        if not info.multicast:
            return (
                "the server streams unicast, expected multicast; change Motive's transmission type or "
                "devices.mocap.transport"
            )
        if (info.multicast_group, info.data_port) != (settings.multicast_group, settings.data_port):
            return (
                f"the server streams to {info.multicast_group}:{info.data_port}, expected "
                f"{settings.multicast_group}:{settings.data_port}; change the settings in Motive's streaming pane or devices.mocap"
            )
        return None

    def _body_refusal(self) -> str | None:
        if not self.protocol.is_ambiguous:
            return None
        label = self._label(self._settings.rigid_body_id)
        return f"two rigid bodies have the streaming id {label}; give each its own id in Motive"

    def silence(self, waited_s: float) -> str:
        """Return why the server has not answered, or why no tracked pose has arrived."""
        settings, within = self._settings, f"within {waited_s:g} s"
        ids, strangers = self.protocol.body_ids, ""
        if self._foreign_ip is not None:
            strangers = f" (datagrams came from {self._foreign_ip}, not from {self.server_ip})"
        if self.protocol.info is None:
            unsent = (
                f"; cannot send ({self._unsent}); check the network and devices.mocap.interface" if self._unsent else ""
            )
            return (
                f"no answer to the NatNet connect request {within}; is Motive running with streaming on, and reachable from "
                f"{settings.interface}?{strangers}{unsent}"
            )
        if ids is None:
            multicast = f"multicast {settings.multicast_group}:{settings.data_port} on {settings.interface}"
            how = multicast if settings.transport == "multicast" else "unicast"
            malformed, last = self.protocol.malformed, self.protocol.problem
            bad = f"; {malformed} malformed, the last: {last}" if malformed else ""
            return (
                f"the server answers, but no frame of data arrived {within} ({how}); check that Motive streams and is not paused, "
                f"its local interface and the firewall{bad}{strangers}"
            )
        if settings.rigid_body_id in ids:
            label = self._label(settings.rigid_body_id)
            return f"rigid body {label} is streamed but was not tracked {within}; check that its markers are in view"
        seen = ", ".join(map(self._label, ids)) or "none"
        return (
            f"rigid body id {settings.rigid_body_id} was never seen {within}; the server streams: {seen}; "
            "set devices.mocap.rigid_body_id to the body's streaming id"
        )

    def _label(self, number: int) -> str:
        name = self.protocol.names.get(number)
        return str(number) if name is None else f'{number} "{name}"'

    def _open(self, address: str, port: int, key: str) -> socket.socket:
        try:
            opened = sockets.open_udp(address, port, shared=key == "multicast_group")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                problem = "another program holds the port; close it or change devices.mocap.data_port"
            else:
                kind = "the group that Motive streams to" if key == "multicast_group" else "an address of this computer"
                problem = f"{error.strerror}; set devices.mocap.{key} to {kind}"
            raise DeviceError(f"{self.where}: cannot open UDP {address}:{port}: {problem}") from None
        self.sockets.append(opened)
        return opened

    def _join(self) -> None:
        """Open the multicast group's port, bound to the group, which excludes other traffic, and shared with the guardian."""
        group, interface = self._settings.multicast_group, self._settings.interface
        data = self._open(group, self._settings.data_port, "multicast_group")
        try:
            sockets.join_source(data, group, interface, self.server_ip)
        except OSError as error:
            raise DeviceError(
                f"{self.where}: cannot join {group} on {interface} ({error}); "
                "set devices.mocap.interface to this computer's address on the camera network"
            ) from None

    def _join_again(self, data: socket.socket) -> None:
        """Join the multicast group, unless the interface is missing or still in the group; in a thread, because the kernel may wait."""
        with data, contextlib.suppress(OSError):
            sockets.join_source(data, self._settings.multicast_group, self._settings.interface, self.server_ip)

    def _send(self, datagrams: list[bytes]) -> None:
        """Send datagrams; while the network is down they are dropped, and the next ones may get through."""
        try:
            for datagram in datagrams:
                self._command.sendto(datagram, (self.server_ip, self._settings.command_port))
        except OSError as error:
            self._unsent = error.strerror or str(error)
