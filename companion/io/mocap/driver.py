"""The motion-capture driver: OptiTrack Motive over NatNet, multicast or unicast."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Self

from companion.config.devices import MocapDevice, NatNetOptions
from companion.io.arrival import arrived_s
from companion.io.mocap import natnet, sockets
from companion.io.mocap.client import CONNECT_PERIOD_S, SUPPORTED_VERSIONS, NatNetClient
from companion.io.mocap.frames import Frame
from companion.io.mocap.natnet import Message, ServerInfo
from companion.io.protocols import DeviceError
from companion.model.observations import MocapCounts, MocapServer
from companion.model.types import MocapPose
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)

OnFrame = Callable[[Frame, bytes, float], None]
"""Called with a frame, its datagram and its arrival on the flight clock, s."""


class NatNetMocap:
    """OptiTrack rigid body over NatNet; implements `companion.io.protocols.Mocap`.

    `on_pose` is called synchronously from the event loop for every new frame that contains the body, tracked or not. When several
    frames wait in the socket (the loop was late) only the newest one is delivered. Poses are world ENU-like / body FLU.

    Args:
        device: addresses, transport, version, body id and up axis.
        clock: the flight clock.
        on_pose: called with every pose; an exception is logged once and never stops reception.
        connect_timeout_s: timeout for the server's answer.
        body_timeout_s: timeout for the first frame in which the body is tracked.
        on_frame: called with every frame, delivered or not. If given, opening waits for any frame, not for the body.
    """

    options = NatNetOptions

    def __init__(
        self,
        device: MocapDevice,
        clock: Clock,
        on_pose: Callable[[MocapPose], None],
        *,
        connect_timeout_s: float = 3.0,
        body_timeout_s: float = 3.0,
        on_frame: OnFrame | None = None,
    ) -> None:
        self._device = device
        self._clock = clock
        self._on_pose = on_pose
        self._on_frame = on_frame
        self._connect_timeout_s = connect_timeout_s
        self._body_timeout_s = body_timeout_s
        self._client = NatNetClient(device.rigid_body_id, device.up_axis, device.transport)
        self.server_ip = ""
        """Numeric address of the server; empty until it is resolved."""
        self._command_socket: socket.socket | None = None
        self._data_socket: socket.socket | None = None
        self._keep_alive: asyncio.TimerHandle | None = None
        self._answered = asyncio.Event()
        self._receiving = asyncio.Event()
        self._latest: MocapPose | None = None
        self._frames = 0
        self._superseded = 0
        self._foreign = 0
        self._foreign_ip: str | None = None
        self._logged: str | None = None
        self._callback_error: str | None = None

    def latest(self) -> MocapPose | None:
        """Return the newest pose, or None before the first; never blocks."""
        return self._latest

    @property
    def server_info(self) -> ServerInfo | None:
        """Return the server's own description, or None before it has answered."""
        return self._client.info

    @property
    def server(self) -> MocapServer | None:
        """Return the server's name and protocol version, or None before it has answered."""
        info = self._client.info
        return None if info is None else MocapServer(name=info.name, protocol_version=info.version)

    @property
    def client(self) -> NatNetClient:
        """Return the protocol's state, for tools."""
        return self._client

    @property
    def bodies(self) -> dict[int, str]:
        """Return the rigid bodies of the newest frame by streaming id; the name is empty if the server has not sent it."""
        return {number: self._client.names.get(number, "") for number in self._client.body_ids or ()}

    def counts(self) -> MocapCounts:
        """Return the counts since the driver was opened."""
        return MocapCounts(
            frames=self._frames,
            superseded=self._superseded,
            out_of_order=self._client.out_of_order,
            malformed=self._client.malformed,
            foreign=self._foreign,
            problem=self._client.problem,
            callback_error=self._callback_error,
        )

    async def __aenter__(self) -> Self:
        """Connect, check the server, wait until the body is tracked.

        Raises:
            DeviceError: the server does not answer or has the wrong version or transport, the port is in use, or the body is never
                seen or never tracked.
        """
        try:
            await self._resolve()
            self._open_sockets()
            self._check_server(await self._connect())
            self._send([natnet.encode_request(Message.REQUEST_MODELDEF)])
            self._keep_connected()
            await self._wait_for_body()
        except BaseException:
            self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Disconnect from the server and close; never raises."""
        self._close()

    # -- opening ---------------------------------------------------------------------------------------------------------------

    @property
    def _where(self) -> str:
        return f"mocap {self._device.server}:{self._device.command_port}"

    async def _resolve(self) -> None:
        loop = asyncio.get_running_loop()
        request = loop.getaddrinfo(self._device.server, None, family=socket.AF_INET, type=socket.SOCK_DGRAM)
        try:
            async with asyncio.timeout(self._connect_timeout_s):
                found = await request
        except (TimeoutError, socket.gaierror):
            raise DeviceError(
                f"{self._where}: the name cannot be resolved; put the Motive computer's IPv4 address into devices.mocap.server"
            ) from None
        self.server_ip = str(found[0][4][0])

    def _open_sockets(self) -> None:
        device = self._device
        self._command_socket = self._bind(device.interface, 0, "interface", shared=False)
        self._watch(self._command_socket)
        if device.transport == "unicast":
            return  # the server sends frames to the address that the connect request came from
        # Bound to the group: nothing else that reaches the port is taken for mocap. Shared: the guardian listens too.
        data = self._bind(device.multicast_group, device.data_port, "multicast_group", shared=True)
        self._data_socket = data
        try:
            sockets.join_source(data, device.multicast_group, device.interface, self.server_ip)
        except OSError as error:
            raise DeviceError(
                f"{self._where}: cannot join {device.multicast_group} on {device.interface} ({error}); "
                "set devices.mocap.interface to this computer's address on the camera network"
            ) from None
        self._watch(data)

    def _bind(self, address: str, port: int, key: str, *, shared: bool) -> socket.socket:
        try:
            return sockets.open_udp(address, port, shared=shared)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                problem = "another program holds the port; close it or change devices.mocap.data_port"
            else:
                kind = "the group that Motive streams to" if key == "multicast_group" else "an address of this computer"
                problem = f"{error.strerror}; set devices.mocap.{key} to {kind}"
            raise DeviceError(f"{self._where}: cannot open UDP {address}:{port}: {problem}") from None

    def _watch(self, opened: socket.socket) -> None:
        asyncio.get_running_loop().add_reader(opened.fileno(), self._drain, opened)

    async def _connect(self) -> ServerInfo:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + self._connect_timeout_s
        while (info := self._client.info) is None:
            remaining_s = deadline_s - loop.time()
            if remaining_s <= 0.0:
                raise DeviceError(
                    f"{self._where}: no answer to the NatNet connect request within {self._connect_timeout_s:g} s; is Motive running "
                    f"with streaming on, and reachable from {self._device.interface}?{self._foreign_hint()}"
                )
            try:
                self._send(self._client.requests(self._clock()))
            except OSError as error:
                raise DeviceError(
                    f"{self._where}: cannot send from {self._device.interface} ({error.strerror}); check the network and "
                    "devices.mocap.interface"
                ) from None
            # A lost datagram is normal on UDP: the request is repeated until the deadline.
            with suppress(TimeoutError):
                async with asyncio.timeout(min(CONNECT_PERIOD_S, remaining_s)):
                    await self._answered.wait()
        return info

    def _check_server(self, info: ServerInfo) -> None:
        device = self._device
        wanted = device.natnet_version
        if self._client.version is None or (wanted is not None and info.version != wanted):
            expected = wanted or SUPPORTED_VERSIONS
            raise DeviceError(
                f"{self._where}: {info.application or 'the server'} speaks NatNet {info.version}, expected {expected}; "
                "set the bitstream version in Motive's streaming pane or devices.mocap.natnet_version"
            )
        if self._client.version > natnet.NEWEST_DESCRIBED_VERSION:
            newest = ".".join(map(str, natnet.NEWEST_DESCRIBED_VERSION))
            _LOG.warning(
                "%s: NatNet %s is later than %s; sections that are not known are skipped",
                self._where,
                info.version,
                newest,
            )
        if device.transport == "multicast" and info.multicast is not None:
            if not info.multicast:
                raise DeviceError(
                    f"{self._where}: the server streams unicast, expected multicast; change Motive's transmission type or "
                    "devices.mocap.transport"
                )
            if (info.multicast_group, info.data_port) != (device.multicast_group, device.data_port):
                raise DeviceError(
                    f"{self._where}: the server streams to {info.multicast_group}:{info.data_port}, expected "
                    f"{device.multicast_group}:{device.data_port}; change the settings in Motive's streaming pane or devices.mocap"
                )

    async def _wait_for_body(self) -> None:
        device = self._device
        try:
            async with asyncio.timeout(self._body_timeout_s):
                await self._receiving.wait()
        except TimeoutError:
            pass
        else:
            if self._client.is_ambiguous and self._on_frame is None:
                text = f"two rigid bodies have the streaming id {self._label(device.rigid_body_id)}; give each its own id in Motive"
                raise DeviceError(f"{self._where}: {text}")
            return
        within = f"within {self._body_timeout_s:g} s"
        ids = self._client.body_ids
        if ids is None:
            how = (
                f"multicast {device.multicast_group}:{device.data_port} on {device.interface}"
                if device.transport == "multicast"
                else "unicast"
            )
            malformed, last = self._client.malformed, self._client.problem
            bad = f"; {malformed} malformed, the last: {last}" if malformed else ""
            raise DeviceError(
                f"{self._where}: the server answers, but no frame of data arrived {within} ({how}); check that Motive streams and "
                f"is not paused, its local interface and the firewall{bad}{self._foreign_hint()}"
            )
        if device.rigid_body_id in ids:
            raise DeviceError(
                f"{self._where}: rigid body {self._label(device.rigid_body_id)} is streamed but was not tracked {within}; "
                "check that its markers are in view"
            )
        seen = ", ".join(self._label(number) for number in ids) or "none"
        raise DeviceError(
            f"{self._where}: rigid body id {device.rigid_body_id} was never seen {within}; the server streams: {seen}; "
            "set devices.mocap.rigid_body_id to the body's streaming id"
        )

    def _label(self, number: int) -> str:
        name = self._client.names.get(number)
        return str(number) if name is None else f'{number} "{name}"'

    def _foreign_hint(self) -> str:
        if self._foreign_ip is None:
            return ""
        return f" (datagrams came from {self._foreign_ip}, not from {self.server_ip})"

    # -- running ---------------------------------------------------------------------------------------------------------------

    def _send(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            if self._command_socket is not None:
                self._command_socket.sendto(datagram, (self.server_ip, self._device.command_port))

    def _keep_connected(self) -> None:
        client = self._client
        with suppress(
            OSError
        ):  # the network is down for now: poses become stale, and the next datagram may get through
            self._send(client.requests(self._clock()))
        if client.problem != self._logged:
            self._logged = client.problem
            _LOG.warning("%s: problem with a datagram: %s", self._where, client.problem)
        self._keep_alive = asyncio.get_running_loop().call_later(client.request_period_s, self._keep_connected)

    def _drain(self, readable: socket.socket) -> None:
        """Read all pending datagrams and deliver only the newest frame."""
        newest: Frame | None = None
        newest_s = 0.0
        for datagram, ancillary, sender_ip in sockets.waiting(readable):
            if sender_ip != self.server_ip:
                self._foreign += 1
                self._foreign_ip = sender_ip
                continue
            stamp_s = arrived_s(ancillary, self._clock)
            frame = self._client.receive(datagram, stamp_s)
            if frame is None:
                continue
            if self._on_frame is not None:
                self._receiving.set()
                self._on_frame(frame, datagram, stamp_s)
            if frame.body is not None:
                self._superseded += newest is not None
                newest, newest_s = frame, stamp_s
        if self._client.info is not None:
            self._answered.set()
        if newest is not None:
            self._deliver(newest, newest_s)

    def _deliver(self, frame: Frame, stamp_s: float) -> None:
        pose = self._client.pose(frame, stamp_s)
        if pose is None:
            return
        self._latest = pose
        self._frames += 1
        if pose.tracking_valid:
            self._receiving.set()
        try:
            self._on_pose(pose)
        except Exception as error:
            if self._callback_error is None:
                self._callback_error = f"{type(error).__name__}: {error}"
                _LOG.exception("%s: on_pose failed; reception continues; further failures are not logged", self._where)

    def _close(self) -> None:
        if self._keep_alive is not None:
            self._keep_alive.cancel()
            self._keep_alive = None
        with suppress(OSError):
            self._send(self._client.farewell())
        for opened in (self._command_socket, self._data_socket):
            if opened is not None:
                asyncio.get_running_loop().remove_reader(opened.fileno())
                opened.close()
        self._command_socket = self._data_socket = None
