"""What a preflight observes; `companion.preflight.observe` gathers it, the other modules of `companion.preflight` evaluate it."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from companion.model.codec import Record
from companion.model.types import ArmState, AutopilotStatus, ForceSample, MocapPose, VehicleState


class EstimatorReport(Record, frozen=True, kw_only=True):
    """ESTIMATOR_STATUS (MAVLink 230), stamped on arrival with the flight clock."""

    stamp_s: float
    flags: int
    """Bits of ESTIMATOR_STATUS_FLAGS."""
    velocity_ratio: float
    """Innovation test ratios: below 1 if the measurements are accepted, exactly 0 if nothing is fused. The next three fields are of the
    same kind.
    """
    position_horizontal_ratio: float
    position_vertical_ratio: float
    position_horizontal_accuracy_m: float
    """Accuracies are one standard deviation."""
    position_vertical_accuracy_m: float


class ServoReport(Record, frozen=True, kw_only=True):
    """Identity and settings of one servo, from registers of the XM430 control table."""

    servo_id: int
    model: int
    """Register 0; 1030 is the XM430-W210."""
    firmware: int
    """Register 6."""
    operating_mode: int
    """Register 11; 0 is current control."""
    return_delay_us: int
    """Register 9, times 2 us."""
    current_limit_counts: int
    """Register 38."""
    watchdog_ms: int
    """Register 98, times 20 ms."""
    voltage_v: float
    """Register 144."""


class Machine(Record, frozen=True, kw_only=True):
    """State of the onboard computer. A field is None if the system does not provide it."""

    disk_free_bytes: int | None
    """Free space where the flight's files are written."""
    governors: tuple[str, ...]
    """Frequency governor of each core (/sys/devices/system/cpu/cpu*/cpufreq/scaling_governor); empty if unknown."""
    realtime: str | None
    """Real-time priority that the system permits, as `companion.runtime.realtime` describes it; None if SCHED_FIFO is refused."""
    memory_lock: str | None
    """Why memory must not be locked; None if it may be."""
    cpus: tuple[int, ...]
    """Cores that a process may run on, in ascending order."""
    arm_latency_ms: int | None
    """FTDI latency timer of the arm's serial port; None if it is not an FTDI port. The next field is for the force sensor's port."""
    force_latency_ms: int | None


class MocapCounts(Record, frozen=True, kw_only=True):
    """Counts of the motion-capture driver since it was opened."""

    frames: int
    """Frames that yielded a pose."""
    superseded: int
    """Frames that were read together with a newer one and therefore not delivered."""
    out_of_order: int
    malformed: int
    foreign: int
    """Datagrams from addresses other than the server's."""
    problem: str | None
    """Reason of the newest rejected datagram; None if none was rejected."""
    callback_error: str | None
    """First exception that `on_pose` raised."""


class MocapServer(Record, frozen=True):
    """The program that streams motion capture."""

    name: str
    """Program, its version and the protocol, such as `Motive 3.1, NatNet 4.1`."""
    protocol_version: str
    """NatNet version, such as `4.1`."""


class ForceCounts(Record, frozen=True, kw_only=True):
    """Counts of the force sensor's driver since the port was opened."""

    samples: int
    skipped_bytes: int
    """Bytes that belong to no packet."""
    bad_sums: int
    lost: str | None
    """Why the port is no longer read; None while it is."""


class MocapStream(Record, frozen=True, kw_only=True):
    """What the motion-capture driver counted during the observation."""

    frames: int
    """Frames that arrived, with or without the body in view."""
    lost: int
    """Frames missing in the sequence of frame numbers."""
    application: str
    other_bodies: tuple[int, ...] = ()
    """Ids of the other rigid bodies in the stream."""
    body_name: str = ""
    """Name of the vehicle's rigid body on the server; empty if the server does not send it."""


class ForceStream(Record, frozen=True, kw_only=True):
    """What the force sensor's driver counted during the observation."""

    samples: int
    bad_sums: int
    """Packets with a wrong checksum since the port was opened."""
    product: str
    """Name and firmware version that the sensor reports."""
    lost: str | None = None
    """Why the port is no longer read; None while it is."""


class StateCounts(Record, frozen=True):
    """Number of state messages received from PX4 during the observation."""

    position: int
    """Number of LOCAL_POSITION_NED."""
    attitude: int
    """Number of ATTITUDE_QUATERNION."""
    imu: int
    """Number of HIGHRES_IMU."""


class Observations(Record, frozen=True, kw_only=True):
    """Everything that was observed for `duration_s`, newest last. A field is empty or None if nothing was received."""

    start_s: float
    """Flight clock at the start of the observation."""
    duration_s: float
    firmware: str | None = None
    """PX4's version as `MavsdkAutopilot.firmware` returns it, such as `PX4 1.16.1 release (git ...)`."""
    params: Mapping[str, float | int] = msgspec.field(default_factory=dict)
    """PX4's parameters by name, without those that PX4 does not have."""
    vehicle: tuple[VehicleState, ...] = ()
    status: tuple[AutopilotStatus, ...] = ()
    estimator: tuple[EstimatorReport, ...] = ()
    mocap: tuple[MocapPose, ...] = ()
    mocap_stream: MocapStream | None = None
    arm: tuple[ArmState, ...] = ()
    servos: tuple[ServoReport, ...] = ()
    force: tuple[ForceSample, ...] = ()
    machine: Machine | None = None
    broker: str | None = None
    """Why the broker did not answer; empty if it did, None if no broker is configured."""
    hand_test: str | None = None
    """The recorded hand test of this setup; empty if there is none, None if no hand test is required."""
    hand_test_changed: str = ""
    """Differences between this setup and the one that last passed the hand test; empty if none ever passed."""
    state_counts: StateCounts | None = None
    force_stream: ForceStream | None = None
    arm_reads: tuple[int, int] | None = None
    """Number of bus cycles, and of cycles without an answer."""
    mission_s: float | None = None
    plan: tuple[str, ...] | None = None
    """Reasons why the mission cannot be flown, one line each; None if this was already checked."""
    recorder: str | None = None
    """Why no log can be opened; empty if one can, None if this was not tried."""
    failures: Mapping[str, str] = msgspec.field(default_factory=dict)
    """Error line of the driver, by device that could not be opened or read (`autopilot`, `mocap`, `arm`, `force`)."""


class Waiting(Record, frozen=True):
    """A condition that the preflight should wait for after the observation."""

    what: str
    longest_s: float
