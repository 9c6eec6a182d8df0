"""The motion-capture driver: runs the client of the vehicle's system (`companion.io.mocap.system.PoseClient`) in the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Final, Self

from companion.config.device_plugins import device_class
from companion.config.devices import MocapDevice
from companion.io.mocap.contained import ContainedClient
from companion.io.mocap.system import ExtendedClient, MocapSettings, PoseClient
from companion.io.protocols import DeviceError
from companion.model.markers import MarkerFrame
from companion.model.observations import MocapCounts, MocapServer
from companion.model.team import BarPose
from companion.model.types import MocapPose
from companion.plugins import MOCAP_SYSTEMS, PluginError, one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_POLL_PERIOD_S: Final = 0.001
"""Period of `poses` without sockets to wait on, which is the most that a pose is late."""
_KEEP_CONNECTED_PERIOD_S: Final = 0.01
_SOCKETS_PERIOD_S: Final = 0.05
"""Period of `keep_connected` of a client with sockets to wait on."""
_MAKE_TIMEOUT_S: Final = 3.0
_LOG_PERIOD_S: Final = 0.5

MakeClient = Callable[[MocapSettings], PoseClient]


def settings_of(device: MocapDevice) -> MocapSettings:
    """Return `devices.mocap` as a client receives it."""
    values = {each.name: getattr(device, each.name) for each in fields(MocapSettings)}
    return MocapSettings(**values | {"ball": None if device.ball is None else device.ball.model_dump()})


class MocapDriver:
    """Poses of the vehicle's motion-capture system; implements `companion.io.protocols.Mocap`.

    `on_pose` is called synchronously from the event loop, tracked or not. If the loop was late and several poses have arrived, only
    the newest is delivered. Without poses the safety rules land the vehicle.

    Args:
        on_pose: called with every new pose; an exception is logged once and never stops the reception.
        body_timeout_s: timeout for the first pose in which the body is tracked.
        make_client: makes the client in place of the installed system; opening then waits for any frame, not for the body.

    Raises:
        DeviceError: another program feeds PX4.
    """

    def __init__(
        self,
        device: MocapDevice,
        clock: Clock,
        on_pose: Callable[[MocapPose], None],
        *,
        connect_timeout_s: float = 3.0,
        body_timeout_s: float = 3.0,
        make_client: MakeClient | None = None,
    ) -> None:
        if device.external:
            raise DeviceError(
                "devices.mocap.type: external: another program feeds PX4; the companion reads no motion capture"
            )
        self._device = device
        self._clock = clock
        self._on_pose = on_pose
        self._timeouts_s = connect_timeout_s, body_timeout_s
        self._make_client = make_client
        self._client: ContainedClient | None = None
        self._name = ""
        self._timer: asyncio.TimerHandle | None = None
        self._keep_connected_s = self._log_s = float("-inf")
        """Earliest flight clock of the next `keep_connected`, and of the next problem in the log."""
        self._answered, self._received = asyncio.Event(), asyncio.Event()
        self._latest: MocapPose | None = None
        self._markers: MarkerFrame | None = None
        self._bar: BarPose | None = None
        self._frames = self._superseded = 0
        self._logged: str | None = None
        self._callback_error: str | None = None

    def latest(self) -> MocapPose | None:
        """Return the newest pose, or None before the first; never blocks."""
        return self._latest

    def markers(self) -> MarkerFrame | None:
        """Return the single markers of the newest frame, or None without `devices.mocap.ball`; never blocks."""
        return self._markers

    def bar(self) -> BarPose | None:
        """Return the bar's rigid body in the newest frame that had it, or None without `devices.mocap.bar_id`; never blocks."""
        return self._bar

    @property
    def client(self) -> ContainedClient:
        """Return the system's client; may be called while the driver is open, and after it was closed."""
        assert self._client is not None, "motion capture is not open"
        return self._client

    @property
    def server(self) -> MocapServer | None:
        """Return the server's name and protocol, or None before it has answered."""
        if self._client is None or not self._answered.is_set():
            return None
        return MocapServer(self._name, self._client.extended.protocol_version() or self._device.type)

    @property
    def bodies(self) -> dict[int, str]:
        """Return the rigid bodies of the newest frame by streaming id; the vehicle's alone if the client knows no others."""
        found = None if self._client is None else self._client.extended.bodies()
        if found is not None:
            return dict(found)
        return {} if self._latest is None else {self._device.rigid_body_id: ""}

    def counts(self) -> MocapCounts:
        """Return the counts since the driver was opened."""
        client = self.client
        out_of_order, _, foreign = client.extended.counts()
        return MocapCounts(
            frames=self._frames,
            superseded=self._superseded,
            out_of_order=out_of_order,
            malformed=client.malformed,
            foreign=foreign,
            problem=client.problem,
            callback_error=self._callback_error,
        )

    async def __aenter__(self) -> Self:
        """Make the client, and wait until the server has answered and the body is tracked.

        Raises:
            DeviceError: the client cannot be made, the server does not answer or is refused, or the body is not tracked.
        """
        self._client = client = await self._make()
        try:
            self._name = client.server_name
        except Exception as error:
            client.close()
            raise DeviceError(f"{client.where}: the client cannot be made: {one_line(error)}") from error
        try:
            for opened in client.extended.sockets:
                asyncio.get_running_loop().add_reader(opened.fileno(), self._receive)
            self._poll()
            for event, timeout_s in zip((self._answered, self._received), self._timeouts_s, strict=True):
                await self._wait(event, timeout_s)
        except BaseException:
            self._close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the client; never raises."""
        self._close()

    # -- opening ---------------------------------------------------------------------------------------------------------------

    async def _make(self) -> ContainedClient:
        where = f"mocap {self._device.type} {self._device.server}"
        settings = settings_of(self._device)
        try:
            make: Any = self._make_client or device_class(MOCAP_SYSTEMS, self._device.type)
            extended = make is self._make_client or issubclass(make, ExtendedClient)
            if not extended or _is_address(settings.server):
                client: PoseClient = make(settings)
            else:  # waits for a name server
                async with asyncio.timeout(_MAKE_TIMEOUT_S):
                    client = await asyncio.get_running_loop().run_in_executor(None, make, settings)
        except DeviceError:
            raise
        except PluginError as error:
            raise DeviceError(f"{where}: {error}") from error
        except TimeoutError:
            raise DeviceError(
                f"{where}: the client is not made within {_MAKE_TIMEOUT_S:g} s; use an IPv4 address"
            ) from None
        except Exception as error:
            raise DeviceError(f"{where}: the client cannot be made: {one_line(error)}") from error
        return ContainedClient(client, settings, self._clock)

    async def _wait(self, event: asyncio.Event, timeout_s: float) -> None:
        client = self.client
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await event.wait()
        problem = client.extended.refusal() if event.is_set() else client.extended.silence(timeout_s)
        if problem is None and not event.is_set():
            seen = "was not tracked" if self._latest is not None else "was never seen"
            why = f"; the newest problem: {client.problem}" if client.problem else ""
            problem = (
                f"rigid body {self._device.rigid_body_id} {seen} within {timeout_s:g} s; check the server, its stream and "
                f"devices.mocap{why}"
            )
        if problem is not None:
            raise DeviceError(f"{client.where}: {problem}")

    # -- running ---------------------------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        client, now_s = self.client, self._clock()
        waits = bool(client.extended.sockets)
        self._timer = asyncio.get_running_loop().call_later(_SOCKETS_PERIOD_S if waits else _POLL_PERIOD_S, self._poll)
        if waits or now_s >= self._keep_connected_s:
            self._keep_connected_s = now_s + _KEEP_CONNECTED_PERIOD_S
            client.keep_connected()
        if not waits:
            self._receive()
        if client.problem != self._logged and now_s >= self._log_s:
            self._logged, self._log_s = client.problem, now_s + _LOG_PERIOD_S
            _LOG.warning("%s: problem with a datagram: %s", client.where, client.problem)

    def _receive(self) -> None:
        """Read all that has arrived and deliver the newest pose."""
        client = self.client
        poses = client.poses()
        if self._device.ball is not None:
            self._markers = client.markers()
        if self._device.bar_id is not None:
            self._bar = client.bar()
        if not self._received.is_set():
            self._note_opening(client, poses)
        if not poses:
            return
        self._superseded += len(poses) - 1
        self._frames += 1
        self._latest = pose = poses[-1]
        try:
            self._on_pose(pose)
        except Exception as error:
            if self._callback_error is None:
                self._callback_error = one_line(error)
                _LOG.exception("%s: on_pose failed; reception continues; further failures are not logged", client.where)

    def _note_opening(self, client: ContainedClient, poses: list[MocapPose]) -> None:
        self._name = self._name or client.server_name
        if self._name and not self._answered.is_set():
            self._answered.set()
            client.keep_connected()  # the next requests follow the answer
        frames = self._make_client is not None and client.extended.bodies() is not None
        if frames or (poses and poses[-1].tracking_valid):
            self._received.set()

    def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._client is not None:
            for opened in self._client.extended.sockets:
                asyncio.get_running_loop().remove_reader(opened.fileno())
            self._client.close()


def _is_address(server: str) -> bool:
    try:
        return bool(socket.inet_aton(server))
    except OSError:
        return False
