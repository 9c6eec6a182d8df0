"""What a preflight has seen: plain records, gathered by `companion.preflight.observe`, judged by the rooms beside it. No I/O here."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from companion.model.codec import Record
from companion.model.types import ArmState, AutopilotStatus, ForceSample, MocapPose, VehicleState


class EstimatorReport(Record, frozen=True, kw_only=True):
    """ESTIMATOR_STATUS (MAVLink 230), stamped on arrival with the flight clock."""

    stamp_s: float
    flags: int
    """ESTIMATOR_STATUS_FLAGS."""
    velocity_ratio: float
    """Innovation test ratios: below 1 the measurements are accepted; 0 exactly: nothing is fused."""
    position_horizontal_ratio: float
    position_vertical_ratio: float
    position_horizontal_accuracy_m: float
    """One sigma."""
    position_vertical_accuracy_m: float


class ServoReport(Record, frozen=True, kw_only=True):
    """One servo's identity and settings, registers of the XM430 control table."""

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
    """The computer itself; None: not told here."""

    disk_free_bytes: int | None
    """Where the flight's files go."""
    governors: tuple[str, ...]
    """Of each core, /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor; empty: none is told."""
    realtime: str | None
    """What `companion.runtime.realtime` would be permitted; None: SCHED_FIFO is refused."""
    memory_lock: str | None
    """Why `companion.runtime.realtime` would lock no memory; None: it would."""
    cpus: tuple[int, ...]
    """Cores that a process may be put on, in order."""
    arm_latency_ms: int | None
    """FTDI latency timer of the arm's serial port; None: not an FTDI port."""
    force_latency_ms: int | None


class MocapCounts(Record, frozen=True, kw_only=True):
    """Counts of the motion-capture driver since it was opened."""

    frames: int
    """Frames that became a pose."""
    superseded: int
    """Frames that were read together with a newer one and therefore not delivered."""
    out_of_order: int
    malformed: int
    foreign: int
    """Datagrams from another address than the server's."""
    problem: str | None
    """Why the newest rejected datagram was rejected; None if none was."""
    callback_error: str | None
    """First exception that the receiver of the poses raised."""


class MocapServer(Record, frozen=True):
    """The program that streams motion capture."""

    name: str
    """Program, its version and the protocol, such as `Motive 3.1, NatNet 4.1`."""
    protocol_version: str
    """Such as `4.1`."""


class ForceCounts(Record, frozen=True, kw_only=True):
    """Counts of the force sensor's driver since the port was opened."""

    samples: int
    skipped_bytes: int
    """Bytes that belong to no packet."""
    bad_sums: int
    lost: str | None
    """Why the port is no longer read; None while it is."""


class MocapStream(Record, frozen=True, kw_only=True):
    """What the motion-capture driver counted while it was watched."""

    frames: int
    """Frames of any kind that arrived."""
    lost: int
    """Gaps in the frame numbers."""
    application: str
    """Server's name and version."""
    other_bodies: tuple[int, ...] = ()
    """Rigid bodies in the stream that are not ours."""
    body_name: str = ""
    """Of ours, as the server says it; empty: it does not."""


class ForceStream(Record, frozen=True, kw_only=True):
    """What the force sensor's driver counted while it was watched."""

    samples: int
    bad_sums: int
    """Packets with a wrong checksum since the port was opened."""
    product: str
    """The sensor's own name and firmware."""
    lost: str | None = None
    """Why the port is not read any more; None: it is."""


class StateCounts(Record, frozen=True):
    """Messages of PX4's state while it was watched."""

    position: int
    """LOCAL_POSITION_NED."""
    attitude: int
    """ATTITUDE_QUATERNION."""
    imu: int
    """HIGHRES_IMU."""


class Observations(Record, frozen=True, kw_only=True):
    """Everything that was seen in `duration_s`, newest last. Empty or None: nothing came."""

    start_s: float
    """Flight clock."""
    duration_s: float
    firmware: str | None = None
    """As `MavsdkAutopilot.firmware` tells it: `PX4 1.16.1 release (git ...)`."""
    params: Mapping[str, float | int] = msgspec.field(default_factory=dict)
    """PX4's parameters by name; one that PX4 does not have is absent."""
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
    """None: no broker was asked for. Empty: it answered. Else why it did not."""
    hand_test: str | None = None
    """None: not asked for. Else what is on record of the guided hand test of this set-up; empty: nothing is."""
    hand_test_changed: str = ""
    """What the set-up differs in from the one that the test was passed with; empty: it never was."""
    state_counts: StateCounts | None = None
    force_stream: ForceStream | None = None
    arm_reads: tuple[int, int] | None = None
    """Bus cycles, and how many of them brought no answer."""
    mission_s: float | None = None
    """Length of the planned mission."""
    plan: tuple[str, ...] | None = None
    """Why the mission cannot be flown as written, one line each; None: that was looked at before."""
    recorder: str | None = None
    """None: not tried. Empty: a log could be opened. Else why not."""
    failures: Mapping[str, str] = msgspec.field(default_factory=dict)
    """Device that could not be opened or read (`autopilot`, `mocap`, `arm`, `force`), and the driver's error line."""


class Waiting(Record, frozen=True):
    """What is worth waiting for, beyond the observation itself."""

    what: str
    longest_s: float
