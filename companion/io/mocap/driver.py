"""The motion-capture driver: OptiTrack Motive over NatNet 3.0 / 4.1, multicast or unicast."""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Final, Self

from companion.config.vehicle import MocapDevice
from companion.io.arrival import STAMP_ROOM_BYTES, arrived_s, stamp_arrivals
from companion.io.mocap import natnet
from companion.io.mocap.natnet import Frame, Malformed, Message, NatNetVersion, ServerInfo
from companion.io.mocap.natnet_source import join_source
from companion.io.mocap.pose import VERSIONS, mocap_pose
from companion.io.protocols import DeviceError
from companion.model.observations import MocapCounts, MocapServer
from companion.model.types import MocapPose
from companion.runtime.clock import Clock
from companion.safety.stream_watch import StreamWatch

_LOG = logging.getLogger(__name__)

_CONNECT_PERIOD_S: Final = 0.25
_KEEP_ALIVE_PERIOD_S: Final = 0.5
_SILENCE_RECONNECT_S: Final = 1.0
_MAX_DATAGRAMS_PER_WAKE: Final = 256
"""A flood must not keep the control loop from running."""
_MAX_DATAGRAM_BYTES: Final = 65535


class NatNetMocap:
    """OptiTrack rigid body over NatNet; implements `companion.io.protocols.Mocap`.

    `on_pose` is called synchronously from the event loop for every new frame that holds the body, tracked or not. When several frames
    wait in the socket (the loop was late) only the newest one is delivered. Poses are world ENU-like / body FLU.

    Args:
        device: addresses, transport, version, body id and up axis.
        clock: the flight clock.
        on_pose: gets every pose; an exception is logged once and never stops the reception.
        connect_timeout_s: until the server info has come.
        body_timeout_s: from then until the body is tracked.
    """

    def __init__(
        self,
        device: MocapDevice,
        clock: Clock,
        on_pose: Callable[[MocapPose], None],
        *,
        connect_timeout_s: float = 3.0,
        body_timeout_s: float = 3.0,
    ) -> None:
        self._device = device
        self._clock = clock
        self._on_pose = on_pose
        self._connect_timeout_s = connect_timeout_s
        self._body_timeout_s = body_timeout_s
        self._server_ip = ""
        self._command_socket: socket.socket | None = None
        self._data_socket: socket.socket | None = None
        self._keep_alive: asyncio.TimerHandle | None = None
        self._info_changed = asyncio.Event()
        self._body_tracked = asyncio.Event()
        self._info: ServerInfo | None = None
        self._version: NatNetVersion | None = None
        self._version_told = False
        self._latest: MocapPose | None = None
        self._last_number: int | None = None
        self._last_frame_s = 0.0
        self._streams = StreamWatch()
        self._seen_ids: tuple[int, ...] | None = None
        self._names: dict[int, str] = {}
        self._frames = 0
        self._superseded = 0
        self._out_of_order = 0
        self._malformed = 0
        self._foreign = 0
        self._foreign_ip: str | None = None
        self._last_malformed: str | None = None
        self._callback_error: str | None = None

    def latest(self) -> MocapPose | None:
        """Newest frame of the rigid body; never blocks."""
        return self._latest

    @property
    def server_info(self) -> ServerInfo | None:
        """Return the server's own description, or None before it has answered."""
        return self._info

    @property
    def server(self) -> MocapServer | None:
        """Return name and protocol of the server, or None before it has answered."""
        return None if self._info is None else MocapServer(name=self._info.name, protocol_version=self._info.version)

    @property
    def bodies(self) -> dict[int, str]:
        """Rigid bodies of the newest frame by streaming id; the name is empty where the server did not tell it."""
        return {number: self._names.get(number, "") for number in self._seen_ids or ()}

    def counts(self) -> MocapCounts:
        """Return the counts since the driver was opened."""
        return MocapCounts(
            frames=self._frames,
            superseded=self._superseded,
            out_of_order=self._out_of_order,
            malformed=self._malformed,
            foreign=self._foreign,
            last_malformed=self._last_malformed,
            callback_error=self._callback_error,
        )

    async def __aenter__(self) -> Self:
        """Connect, check the server, wait until the body is tracked.

        Raises:
            DeviceError: no answer, wrong version, wrong transport, port in use, body never seen or never tracked.
        """
        try:
            await self._resolve()
            self._open_sockets()
            info = await self._connect()
            self._version = self._check_server(info)
            self._send(natnet.encode_request(Message.REQUEST_MODELDEF))
            self._tick_keep_alive()
            await self._wait_for_body()
        except BaseException:
            self._close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Take leave of the server and close; never raises."""
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
                f"{self._where}: the name cannot be resolved; put the Motive machine's IPv4 address into devices.mocap.server"
            ) from None
        self._server_ip = str(found[0][4][0])

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
            join_source(data, device.multicast_group, device.interface, self._server_ip)
        except OSError as error:
            raise DeviceError(
                f"{self._where}: cannot join {device.multicast_group} on {device.interface} ({error}); "
                "set devices.mocap.interface to this machine's address on the camera network"
            ) from None
        self._watch(data)

    def _bind(self, address: str, port: int, key: str, *, shared: bool) -> socket.socket:
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            stamp_arrivals(opened)
            if shared:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            opened.bind((address, port))
        except OSError as error:
            opened.close()
            if error.errno == errno.EADDRINUSE:
                problem = "another program holds the port; close it or change devices.mocap.data_port"
            else:
                kind = "the group that Motive streams to" if key == "multicast_group" else "an address of this machine"
                problem = f"{error.strerror}; set devices.mocap.{key} to {kind}"
            raise DeviceError(f"{self._where}: cannot open UDP {address}:{port}: {problem}") from None
        return opened

    def _watch(self, opened: socket.socket) -> None:
        asyncio.get_running_loop().add_reader(opened.fileno(), self._drain, opened)

    async def _connect(self) -> ServerInfo:
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + self._connect_timeout_s
        while self._info is None:
            remaining_s = deadline_s - loop.time()
            if remaining_s <= 0.0:
                raise DeviceError(
                    f"{self._where}: no answer to the NatNet connect request within {self._connect_timeout_s:g} s; is Motive running "
                    f"with streaming on, and reachable from {self._device.interface}?{self._foreign_hint()}"
                )
            try:
                self._send(natnet.encode_connect())
            except OSError as error:
                raise DeviceError(
                    f"{self._where}: cannot send from {self._device.interface} ({error.strerror}); check the network and "
                    "devices.mocap.interface"
                ) from None
            # A lost datagram is normal on UDP: the request is repeated until the deadline.
            with suppress(TimeoutError):
                async with asyncio.timeout(min(_CONNECT_PERIOD_S, remaining_s)):
                    await self._info_changed.wait()
        return self._info

    def _check_server(self, info: ServerInfo) -> NatNetVersion:
        device = self._device
        version = VERSIONS.get(info.version)
        wanted = device.natnet_version
        if version is None or (wanted is not None and version != wanted):
            expected = wanted or " or ".join(VERSIONS)
            raise DeviceError(
                f"{self._where}: {info.application or 'the server'} speaks NatNet {info.version}, expected {expected}; "
                "set the bitstream version in Motive's streaming pane or devices.mocap.natnet_version"
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
                    f"{device.multicast_group}:{device.data_port}; change Motive's streaming pane or devices.mocap"
                )
        return version

    async def _wait_for_body(self) -> None:
        device = self._device
        try:
            async with asyncio.timeout(self._body_timeout_s):
                await self._body_tracked.wait()
            return
        except TimeoutError:
            pass
        within = f"within {self._body_timeout_s:g} s"
        if self._seen_ids is None:
            how = (
                f"multicast {device.multicast_group}:{device.data_port} on {device.interface}"
                if device.transport == "multicast"
                else "unicast"
            )
            bad = f"; {self._malformed} malformed, the last: {self._last_malformed}" if self._malformed else ""
            raise DeviceError(
                f"{self._where}: the server answers but no frame of data came {within} ({how}); check that Motive streams and "
                f"is not paused, its local interface and the firewall{bad}{self._foreign_hint()}"
            )
        if device.rigid_body_id in self._seen_ids:
            raise DeviceError(
                f"{self._where}: rigid body {self._label(device.rigid_body_id)} is streamed but was not tracked {within}; "
                "check that its markers are in view"
            )
        seen = ", ".join(self._label(number) for number in self._seen_ids) or "none"
        raise DeviceError(
            f"{self._where}: rigid body id {device.rigid_body_id} was never seen {within}; the server streams: {seen}; "
            "set devices.mocap.rigid_body_id to the body's streaming id"
        )

    def _label(self, number: int) -> str:
        return f'{number} "{self._names[number]}"' if number in self._names else str(number)

    def _foreign_hint(self) -> str:
        if self._foreign_ip is None:
            return ""
        return f" (datagrams came from {self._foreign_ip}, not from {self._server_ip})"

    # -- running ---------------------------------------------------------------------------------------------------------------

    def _send(self, datagram: bytes) -> None:
        if self._command_socket is not None:
            self._command_socket.sendto(datagram, (self._server_ip, self._device.command_port))

    def _tick_keep_alive(self) -> None:
        """Unicast servers forget a client that is silent; one that was restarted knows it only after a new connect request."""
        silent = self._last_number is not None and self._clock() - self._last_frame_s > _SILENCE_RECONNECT_S
        with suppress(OSError):  # the network is down for now: stale poses tell, and the next one may get through
            if silent:
                self._send(natnet.encode_connect())
            if self._device.transport == "unicast":
                self._send(natnet.encode_request(Message.KEEP_ALIVE))
        self._keep_alive = asyncio.get_running_loop().call_later(_KEEP_ALIVE_PERIOD_S, self._tick_keep_alive)

    def _drain(self, readable: socket.socket) -> None:
        """Read all that waits in the socket; deliver the newest frame only."""
        newest: Frame | None = None
        newest_s = 0.0
        for _ in range(_MAX_DATAGRAMS_PER_WAKE):
            try:
                datagram, notes, _, address = readable.recvmsg(_MAX_DATAGRAM_BYTES, STAMP_ROOM_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # an ICMP error of an earlier send
                continue
            if address[0] != self._server_ip:
                self._foreign += 1
                self._foreign_ip = address[0]
                continue
            message = natnet.message_id(datagram)
            if message == Message.FRAME:
                stamp_s = arrived_s(notes, self._clock)
                frame = self._take_frame(datagram, stamp_s)
                if frame is not None:
                    self._superseded += newest is not None
                    newest, newest_s = frame, stamp_s
            elif message == Message.SERVER_INFO:
                self._take_server_info(datagram)
            elif message == Message.MODELDEF and self._version is not None:
                definitions = natnet.parse_model_definitions(datagram, self._version)
                if isinstance(definitions, Malformed):
                    self._count_malformed(definitions)
                else:
                    self._names = {definition.id: definition.name for definition in definitions}
        if newest is not None:
            self._deliver(newest, newest_s)

    def _take_server_info(self, datagram: bytes) -> None:
        info = natnet.parse_server_info(datagram)
        if isinstance(info, Malformed):
            self._count_malformed(info)
            return
        if self._version is not None and info.version != self._version:
            if not self._version_told:
                self._version_told = True
                _LOG.error(
                    "%s: the server was restarted with NatNet %s instead of %s",
                    self._where,
                    info.version,
                    self._version,
                )
            return
        self._version_told = False
        self._info = info
        self._info_changed.set()

    def _take_frame(self, datagram: bytes, arrived_s: float) -> Frame | None:
        if self._version is None or self._info is None:
            return None
        frame = natnet.parse_frame(datagram, self._version, self._device.rigid_body_id, self._info.clock_frequency_hz)
        if isinstance(frame, Malformed):
            self._count_malformed(frame)
            return None
        # While two streams are mixed every frame is delivered, in whatever order: the monitor must see it.
        two = self._streams.update(frame.number, frame.body, arrived_s)
        if not two and not natnet.is_newer(frame.number, self._last_number, arrived_s - self._last_frame_s):
            self._out_of_order += 1
            return None
        self._last_number = frame.number
        self._last_frame_s = arrived_s
        self._seen_ids = frame.body_ids
        return frame if frame.body is not None else None

    def _count_malformed(self, bad: Malformed) -> None:
        self._malformed += 1
        self._last_malformed = bad.reason

    def _deliver(self, frame: Frame, arrived_s: float) -> None:
        pose = mocap_pose(frame, arrived_s, self._device.up_axis)
        if pose is None:
            return
        self._latest = pose
        self._frames += 1
        if pose.tracking_valid:
            self._body_tracked.set()
        try:
            self._on_pose(pose)
        except Exception as error:
            if self._callback_error is None:
                self._callback_error = f"{type(error).__name__}: {error}"
                _LOG.exception("%s: on_pose failed; reception goes on, further failures are not logged", self._where)

    def _close(self) -> None:
        if self._keep_alive is not None:
            self._keep_alive.cancel()
            self._keep_alive = None
        if self._device.transport == "unicast":
            with suppress(OSError):
                self._send(natnet.encode_message(Message.DISCONNECT))
        for opened in (self._command_socket, self._data_socket):
            if opened is not None:
                asyncio.get_running_loop().remove_reader(opened.fileno())
                opened.close()
        self._command_socket = self._data_socket = None
