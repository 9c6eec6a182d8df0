"""Driver of a motion-capture system that is a plug-in: runs its client (`companion.io.mocap.system.PoseClient`) in the event loop."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from types import TracebackType
from typing import Final, Self

from companion.config.mocap import NATNET, system_class
from companion.config.vehicle import MocapDevice
from companion.io.mocap.driver import NatNetMocap
from companion.io.mocap.system import MocapSettings, PoseClient
from companion.io.protocols import DeviceError, Mocap
from companion.model.observations import MocapCounts, MocapServer
from companion.model.types import MocapPose
from companion.plugins import PluginError, one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_POLL_PERIOD_S: Final = 0.005
"""Period of `poses` for a client without sockets, and of `keep_connected`."""


def open_mocap(device: MocapDevice, clock: Clock, on_pose: Callable[[MocapPose], None]) -> Mocap:
    """Return the driver of the vehicle's motion-capture system, to be opened as a context manager.

    Args:
        device: `devices.mocap` of the vehicle file.
        clock: the flight clock.
        on_pose: called from the event loop with every new pose; an exception is logged once and never stops the reception.
    """
    return (NatNetMocap if device.type == NATNET else PluginMocap)(device, clock, on_pose)


class PluginMocap:
    """Poses of a plug-in's client; implements `companion.io.protocols.Mocap`.

    Of several poses that have arrived only the newest is delivered. An exception of the client is counted as a malformed datagram and
    logged once: without poses the safety rules land the vehicle.

    Args:
        device: `devices.mocap` of the vehicle file.
        clock: the flight clock.
        on_pose: called with every pose; an exception is logged once.
        body_timeout_s: timeout of the first pose in which the body is tracked.
    """

    def __init__(
        self, device: MocapDevice, clock: Clock, on_pose: Callable[[MocapPose], None], *, body_timeout_s: float = 3.0
    ) -> None:
        self._device = device
        self._clock = clock
        self._on_pose = on_pose
        self._body_timeout_s = body_timeout_s
        self._client: PoseClient | None = None
        self._watched: list[socket.socket] = []
        """The client's sockets, unless it has raised: one that raises may leave its datagrams unread, and is called by the timer."""
        self._timer: asyncio.TimerHandle | None = None
        self._tracked = asyncio.Event()
        self._latest: MocapPose | None = None
        self._frames = self._superseded = self._malformed = 0
        self._problem: str | None = None
        self._callback_error: str | None = None

    def latest(self) -> MocapPose | None:
        """Return the newest pose, or None before the first; never blocks."""
        return self._latest

    @property
    def server(self) -> MocapServer | None:
        """Return the system's name and type, or None before a pose has arrived."""
        if self._client is None or self._latest is None:
            return None
        return MocapServer(name=self._client.server_name, protocol_version=self._device.type)

    @property
    def bodies(self) -> dict[int, str]:
        """Return the vehicle's rigid body; a client reports no others."""
        return {} if self._latest is None else {self._device.rigid_body_id: ""}

    def counts(self) -> MocapCounts:
        """Return the counts since the driver was opened."""
        return MocapCounts(
            frames=self._frames,
            superseded=self._superseded,
            out_of_order=0,
            malformed=self._malformed,
            foreign=0,
            problem=self._problem,
            callback_error=self._callback_error,
        )

    async def __aenter__(self) -> Self:
        """Make the client and wait until the body is tracked.

        Raises:
            DeviceError: the client cannot be made, or the body is not tracked.
        """
        try:
            settings = MocapSettings(**{each.name: getattr(self._device, each.name) for each in fields(MocapSettings)})
            self._client = client = system_class(self._device.type)(settings)
        except PluginError as error:
            raise DeviceError(f"{self._where}: {error}") from error
        except Exception as error:
            raise DeviceError(f"{self._where}: the client cannot be made: {one_line(error)}") from error
        self._watched = list(client.sockets)
        for opened in self._watched:
            asyncio.get_running_loop().add_reader(opened.fileno(), self._receive)
        self._poll()
        try:
            async with asyncio.timeout(self._body_timeout_s):
                await self._tracked.wait()
        except BaseException as error:
            self._close()
            if not isinstance(error, TimeoutError):
                raise
            seen = "was not tracked" if self._latest is not None else "was never seen"
            why = f"; the newest problem: {self._problem}" if self._problem else ""
            raise DeviceError(
                f"{self._where}: rigid body {self._device.rigid_body_id} {seen} within {self._body_timeout_s:g} s; check the server, "
                f"its stream and devices.mocap{why}"
            ) from None
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the client; never raises."""
        self._close()

    @property
    def _where(self) -> str:
        return f"mocap {self._device.type} {self._device.server}"

    def _poll(self) -> None:
        assert self._client is not None
        self._timer = asyncio.get_running_loop().call_later(_POLL_PERIOD_S, self._poll)
        try:
            self._client.keep_connected(self._clock())
        except Exception as error:
            self._failed(error)
        if not self._watched:
            self._receive()

    def _receive(self) -> None:
        assert self._client is not None
        try:
            poses = self._client.poses(self._clock())
            if not all(isinstance(pose, MocapPose) for pose in poses):
                raise TypeError(f"poses() returned {poses!r:.80}, expected a list of MocapPose")
            self._problem = self._client.problem or self._problem
        except Exception as error:
            self._failed(error)
            return
        if not poses:
            return
        self._superseded += len(poses) - 1
        self._frames += 1
        self._latest = pose = poses[-1]
        if pose.tracking_valid:
            self._tracked.set()
        try:
            self._on_pose(pose)
        except Exception as error:
            if self._callback_error is None:
                self._callback_error = one_line(error)
                _LOG.exception("%s: on_pose failed; reception goes on, further failures are not logged", self._where)

    def _failed(self, error: Exception) -> None:
        self._malformed += 1
        if self._problem is None:
            _LOG.error("%s: the client failed; further failures are not logged", self._where, exc_info=error)
        self._problem = one_line(error)
        self._unwatch()

    def _unwatch(self) -> None:
        for opened in self._watched:
            asyncio.get_running_loop().remove_reader(opened.fileno())
        self._watched.clear()

    def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._unwatch()
        if self._client is not None:
            with suppress(Exception):
                self._client.close()
            self._client = None
