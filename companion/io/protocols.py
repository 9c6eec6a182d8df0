"""Protocols of the vehicle's devices, for flight and preflight. Hardware and SITL differ in addresses only.

A device is an async context manager: entering it opens and checks it within a deadline, leaving it shuts it down safely and never
raises because the device is gone. Entering raises `DeviceError`. `latest()` never blocks and does no I/O.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import TracebackType
from typing import Protocol, Self

from companion.model.estimator import EstimatorReport
from companion.model.markers import MarkerFrame
from companion.model.observations import (
    ArmStatement,
    ForceCounts,
    LinkCounts,
    MocapCounts,
    MocapServer,
    ServoReport,
    StateCounts,
)
from companion.model.outputs import Outputs
from companion.model.team import BarPose, ClampCommand, ClampState, PartnerState, TeamState
from companion.model.types import (
    ArmState,
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    ForceSample,
    Inputs,
    Joints,
    LinkIdentity,
    MocapPose,
    VehicleState,
)


class DeviceError(Exception):
    """A device is missing or not as expected. One line: device, address, expected, found, and how to fix it."""


class Device(Protocol):
    """A device that can be opened and closed."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Autopilot(Device, Protocol):
    """The link to PX4."""

    def vehicle(self) -> VehicleState | None:
        """Return the latest fused state in world ENU / body FLU, or None before the first complete state."""

    def status(self) -> AutopilotStatus | None:
        """Return the latest status, or None before the first heartbeat."""

    def estimator(self) -> EstimatorReport | None:
        """Return the latest report of PX4's estimator, or None before the first."""

    def counts(self) -> StateCounts:
        """Return the number of state messages since the link was opened."""

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        """Send a setpoint at once; None stops the setpoints. Return False if nothing was sent."""

    def send_vision(self, pose: MocapPose) -> bool:
        """Send a motion-capture pose at once. Return False if nothing was sent."""

    def request(self, request: AutopilotRequest) -> None:
        """Send a request without waiting for the answer, unless the same request is in progress."""

    def start_sums(self) -> None:
        """Start the sums over PX4's samples, such as the change of velocity, at zero; called when the flight begins."""

    def take_messages(self) -> list[str]:
        """Return PX4's messages and notices about its link since the last call, oldest first."""

    def identity(self) -> LinkIdentity:
        """Return the ids of both ends of the link."""

    async def firmware(self) -> str:
        """Return PX4's version as text.

        Raises:
            DeviceError: no answer.
        """

    async def read_params(self, names: Iterable[str]) -> dict[str, float | int]:
        """Return PX4's parameters by name, int or float as PX4 stores them; a name that PX4 does not have is left out.

        Raises:
            DeviceError: no answer.
        """

    async def read_param(self, name: str) -> float | int:
        """Return one parameter of PX4.

        Raises:
            DeviceError: no such parameter, or no answer.
        """


class Mocap(Device, Protocol):
    """Motion capture of the vehicle's rigid body."""

    def latest(self) -> MocapPose | None:
        """Return the newest pose, or None before the first."""

    def markers(self) -> MarkerFrame | None:
        """Return the single markers of the newest frame, or None without `devices.mocap.ball`."""

    def bar(self) -> BarPose | None:
        """Return the bar's rigid body in the newest frame that had it, or None without `devices.mocap.bar_id`."""

    def counts(self) -> MocapCounts:
        """Return the numbers of frames since the device was opened."""

    @property
    def server(self) -> MocapServer | None:
        """Return the server that streams the poses, or None before it has answered."""

    @property
    def bodies(self) -> dict[int, str]:
        """Return the rigid bodies of the newest frame by streaming id; the name is empty if the server has not sent it."""


class Arm(Device, Protocol):
    """The motors of the arm. A cycle is `begin_read`, `read`, then `write_torque`."""

    def latest(self) -> ArmState | None:
        """Return the newest joint state, or None before the first."""

    @property
    def servos(self) -> tuple[ServoReport, ...]:
        """Return the servos' identity and settings as read when the arm was opened."""

    @property
    def statement(self) -> ArmStatement | None:
        """Return what a plug-in states about its arm; None for servos, which are read instead."""

    @property
    def read_takes_s(self) -> float:
        """Return the time within which most reads complete, s."""

    def begin_read(self, at_s: float = 0.0) -> None:
        """Start the read that the next `read` waits for, at a time of the flight clock or at once; never blocks."""

    async def read(self, timeout_s: float) -> ArmState | None:
        """Return the newest joint state, whose `read_failures` counts failed reads, or None before the first."""

    def write_torque(self, torque_nm: Joints) -> Joints:
        """Command both joint torques, N m. Return the torques that are sent, clipped and rounded to counts."""

    def clamp(self) -> ClampState | None:
        """Return the newest state of the clamp, or None without one."""

    def command_clamp(self, command: ClampCommand | None) -> None:
        """Command the clamp, which keeps the last command; None commands nothing. Never waits."""


class ForceTorque(Device, Protocol):
    """The force-torque sensor."""

    product_name: str
    firmware: str
    """Version of the sensor's firmware; empty if it does not report one."""

    def latest(self) -> ForceSample | None:
        """Return the newest sample as measured, or None before the first."""

    def read_in_ticks(self) -> None:
        """Read the port in `latest` from now on instead of on arrival, if the event loop reads it: a wake-up less per sample."""

    def counts(self) -> ForceCounts:
        """Return the numbers of samples and invalid packets since the device was opened."""


class Team(Device, Protocol):
    """The link to the other vehicle of a team."""

    def announce(self, said: TeamState) -> None:
        """Send this vehicle's state; called in each tick. Never waits."""

    @property
    def partner_session(self) -> int:
        """Return the session of the newest announcement, which the guardian names; 0 before the first."""

    def newest(self) -> PartnerState | None:
        """Return the newest announcement of the other vehicle, or None before the first."""

    def counts(self) -> LinkCounts:
        """Return the numbers of announcements and of rejected datagrams since the link was opened."""


class GroundLink(Device, Protocol):
    """MAVLink forwarding to a ground station."""

    @property
    def line(self) -> str:
        """Return the destination of the forwarded MAVLink, as one line for the operator."""

    def report_tick(self, inputs: Inputs, outputs: Outputs) -> None:
        """Report one control tick to the ground station."""

    def take_messages(self) -> list[str]:
        """Return the changes of the link since the last call, oldest first."""
