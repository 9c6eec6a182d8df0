"""What the flight app asks of its devices. Real hardware and SITL differ in addresses only.

Every edge is an async context manager: entering opens and verifies the device within a deadline, leaving shuts it down safely (and
never raises because the device is gone). Entering raises `DeviceError` whose text is one clear line: device, address, what was
expected, what was found, how to fix it. `latest()` never blocks and never does I/O.
"""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self

from companion.model.types import (
    ArmState,
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    ForceSample,
    MocapPose,
    Vec2,
    VehicleState,
)


class DeviceError(Exception):
    """A device is not there or not as it must be: one line for the user, preflight refuses (exit 3)."""


class Edge(Protocol):
    """A device that is opened and closed."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Autopilot(Edge, Protocol):
    """PX4 through MAVSDK."""

    def vehicle(self) -> VehicleState | None:
        """Latest fused state in world ENU / body FLU; None before the first complete one."""

    def status(self) -> AutopilotStatus | None:
        """Latest slow state."""

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        """Send at once, synchronously (hot path). None: from now on nothing leaves. False: nothing was sent."""

    def send_vision(self, pose: MocapPose) -> bool:
        """Send VISION_POSITION_ESTIMATE at once, synchronously."""

    def request(self, request: AutopilotRequest) -> None:
        """Start carrying a request out in the background; a request already under way is not started twice."""


class Mocap(Edge, Protocol):
    """OptiTrack through NatNet."""

    def latest(self) -> MocapPose | None:
        """Newest frame of the rigid body."""


class Arm(Edge, Protocol):
    """The servo bus. One thread owns the bus; a cycle is `read`, then `write_torque`."""

    def latest(self) -> ArmState | None:
        """Newest joint state."""

    @property
    def read_takes_s(self) -> float:
        """Time within which most reads are done."""

    def begin_read(self, at_s: float = 0.0) -> None:
        """Begin the read that the next `read` waits for, at that time of the flight clock or as soon as it is wanted; never blocks."""

    async def read(self, timeout_s: float) -> ArmState | None:
        """One sync read; the newest state (its `read_failures` counts the misses). None before the first success."""

    def write_torque(self, torque_nm: Vec2) -> Vec2:
        """Hand one current command to the bus thread; returns what will really be sent, after rounding to counts and clipping, N m."""


class ForceTorque(Edge, Protocol):
    """The force-torque sensor."""

    def latest(self) -> ForceSample | None:
        """Newest sample, as measured."""
