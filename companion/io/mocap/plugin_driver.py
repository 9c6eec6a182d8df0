"""Driver of a motion-capture system that is a plug-in: runs its client (`companion.io.mocap.system.PoseClient`) in the event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from typing import Final, Self, TypeVar

from companion.config.device_plugins import NATNET, device_class
from companion.config.devices import MocapDevice
from companion.io.mocap.driver import NatNetMocap
from companion.io.mocap.system import MocapSettings, PoseClient, valid_poses
from companion.io.protocols import DeviceError, Mocap
from companion.model.observations import MocapCounts, MocapServer
from companion.model.types import MocapPose
from companion.plugins import MOCAP_SYSTEMS, PluginError, one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_T = TypeVar("_T")
_POLL_PERIOD_S: Final = 0.001
"""Period of `poses`. The event loop does not wait on a client's sockets, because it would fail if the client closed one; the poses are
up to this time late.
"""
_KEEP_CONNECTED_PERIOD_S: Final = 0.01
_CALL_MAX_S: Final = 0.01
"""Longest permitted time of one call of the client."""


def open_mocap(device: MocapDevice, clock: Clock, on_pose: Callable[[MocapPose], None]) -> Mocap:
    """Return the driver of the vehicle's motion-capture system, to be opened as a context manager.

    Args:
        device: `devices.mocap` of the vehicle file.
        clock: the flight clock.
        on_pose: called from the event loop with every new pose; an exception is logged once and never stops the reception.

    Raises:
        DeviceError: another program feeds PX4.
    """
    if device.external:
        raise DeviceError(
            "devices.mocap.type: external: another program feeds PX4; the companion reads no motion capture"
        )
    return (NatNetMocap if device.type == NATNET else PluginMocap)(device, clock, on_pose)


class PluginMocap:
    """Poses of a plug-in's client; implements `companion.io.protocols.Mocap`.

    Of several poses that have arrived only the newest is delivered. An exception of the client and an invalid pose are each counted as
    a malformed datagram, and the first exception is logged: without poses the safety rules land the vehicle.

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
        self._server_name = ""
        self._timer: asyncio.TimerHandle | None = None
        self._keep_connected_s = float("-inf")
        """Earliest flight clock of the next `keep_connected`."""
        self._tracked = asyncio.Event()
        self._latest: MocapPose | None = None
        self._frames = self._superseded = self._malformed = 0
        self._problem: str | None = None
        self._failure_logged = False
        self._callback_error: str | None = None

    def latest(self) -> MocapPose | None:
        """Return the newest pose, or None before the first; never blocks."""
        return self._latest

    @property
    def server(self) -> MocapServer | None:
        """Return the system's name and type, or None before a pose has arrived."""
        if self._client is None or self._latest is None:
            return None
        return MocapServer(name=self._server_name, protocol_version=self._device.type)

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
            self._client = client = device_class(MOCAP_SYSTEMS, self._device.type)(settings)
            self._server_name = str(client.server_name)
        except PluginError as error:
            raise DeviceError(f"{self._where}: {error}") from error
        except Exception as error:
            self._close()
            raise DeviceError(f"{self._where}: the client cannot be made: {one_line(error)}") from error
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

    async def __aexit__(self, *_: object) -> None:
        """Close the client; never raises."""
        self._close()

    @property
    def _where(self) -> str:
        return f"mocap {self._device.type} {self._device.server}"

    def _poll(self) -> None:
        assert self._client is not None
        client = self._client
        self._timer = asyncio.get_running_loop().call_later(_POLL_PERIOD_S, self._poll)
        if self._clock() >= self._keep_connected_s:
            self._keep_connected_s = self._clock() + _KEEP_CONNECTED_PERIOD_S
            self._call("keep_connected()", client.keep_connected, None)
        self._deliver(self._call("poses()", self._receive, []))

    def _receive(self, now_s: float) -> list[MocapPose]:
        assert self._client is not None
        poses, rejected = valid_poses(self._client.poses(now_s), now_s)
        self._problem = str(self._client.problem or "") or self._problem
        if rejected:
            self._malformed += len(rejected)
            self._problem = rejected[-1]
        return poses

    def _deliver(self, poses: list[MocapPose]) -> None:
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

    def _call(self, what: str, call: Callable[[float], _T], otherwise: _T) -> _T:
        """Call the client with the present time; return `otherwise` if it raises. Report an exception or a call that has waited."""
        now_s = self._clock()
        try:
            return call(now_s)
        except Exception as error:
            self._malformed += 1
            if not self._failure_logged:
                self._failure_logged = True
                _LOG.error("%s: the client failed; further failures are not logged", self._where, exc_info=error)
            self._problem = one_line(error)
            return otherwise
        finally:
            took_s = self._clock() - now_s
            if took_s > _CALL_MAX_S and self._problem is None:
                self._problem = (
                    f"{what} took {took_s * 1e3:.0f} ms, limit {_CALL_MAX_S * 1e3:g} ms; no call of a client may wait"
                )

    def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._client is not None:
            with suppress(Exception):
                self._client.close()
            self._client = None
