"""Observations for the preflight check. `companion.preflight.observe` gathers them; other modules of `companion.preflight` evaluate
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import msgspec

from companion.model.codec import Record
from companion.model.estimator import EstimatorReport
from companion.model.markers import MarkerFrame
from companion.model.types import ArmState, AutopilotStatus, ForceSample, MocapPose, VehicleState


class ServoReport(Record, frozen=True, kw_only=True):
    """Identity and settings of one servo, from registers of its control table."""

    servo_id: int
    model: int
    """Model number (register 0), as in `companion.model.servos`."""
    firmware: int
    """Firmware version (register 6)."""
    operating_mode: int
    """Operating mode (register 11); 0 is current control."""
    return_delay_us: int
    """Return delay time (register 9, unit 2 us)."""
    current_limit_counts: int
    """Current limit (register 38)."""
    watchdog_ms: int
    """Bus watchdog timeout (register 98, unit 20 ms)."""
    voltage_v: float
    """Supply voltage (register 144)."""


class ArmStatement(Record, frozen=True):
    """What a plug-in states about its arm."""

    product: str
    """Model and firmware of the motors."""
    watchdog: str
    """What makes the arm limp when the companion dies."""


class Machine(Record, frozen=True, kw_only=True):
    """State of the onboard computer. A field is None if the system does not provide it."""

    disk_free_bytes: int | None
    """Free space in the file system to which the flight's files are written."""
    governors: tuple[str, ...]
    """Frequency governor of each core (/sys/devices/system/cpu/cpu*/cpufreq/scaling_governor); empty if unknown."""
    realtime: str | None
    """Real-time priority that the system allows, as described by `companion.runtime.realtime`; None if SCHED_FIFO is refused."""
    memory_lock: str | None
    """Reason why memory cannot be locked; None if it can be."""
    cpus: tuple[int, ...]
    """Cores on which a process may run, in ascending order."""
    arm_latency_ms: int | None
    """FTDI latency timer of the arm's serial port; None if that is not an FTDI port."""
    force_latency_ms: int | None
    """FTDI latency timer of the force sensor's serial port; None if that is not an FTDI port."""


class MocapCounts(Record, frozen=True, kw_only=True):
    """Counts of the motion-capture driver since it was opened."""

    frames: int
    superseded: int
    """Frames that were read together with a newer frame and therefore not delivered."""
    out_of_order: int
    malformed: int
    foreign: int
    """Datagrams from an address other than the server's."""
    problem: str | None
    """Reason why the newest rejected datagram was rejected; None if none was rejected."""
    callback_error: str | None
    """First exception that `on_pose` raised; None if it raised none."""


class MocapServer(Record, frozen=True):
    """The program that streams motion capture."""

    name: str
    """Name and version of the program and of the protocol, such as `Motive 3.1, NatNet 4.1`."""
    protocol_version: str
    """NatNet version, such as `4.1`, or the type of another motion-capture system."""


class ForceCounts(Record, frozen=True, kw_only=True):
    """Counts of the force sensor's driver since the port was opened."""

    samples: int
    skipped_bytes: int
    """Bytes that belonged to no packet."""
    bad_sums: int
    lost: str | None
    """Reason why the port is no longer being read; None if it still is."""


class LinkCounts(NamedTuple):
    """Announcements on the link of a team since it was opened."""

    sent: int = 0
    unsent: int = 0
    """Announcements that the network did not take."""
    received: int = 0
    foreign: int = 0
    """Datagrams from another address than the other vehicle's."""
    malformed: int = 0
    """Datagrams of another length or version, or with a state that is not one."""
    forged: int = 0
    """Datagrams with a wrong proof."""
    unanswered: int = 0
    """Announcements to another process than this: from before the other vehicle heard this one, or recordings of an earlier flight."""
    repeated: int = 0
    """Announcements that are not newer than one before, or of a process that another has replaced."""


class MocapStream(Record, frozen=True, kw_only=True):
    """Counts of the motion-capture driver during the observation, and properties of the stream."""

    frames: int
    """Frames that arrived, with or without the body in view."""
    lost: int
    """Frames that are missing in the sequence of frame numbers."""
    application: str
    other_bodies: tuple[int, ...] = ()
    """Ids of the other rigid bodies in the stream."""
    body_name: str = ""
    """Name of the vehicle's rigid body on the server; empty if the server does not send it."""


class ForceStream(Record, frozen=True, kw_only=True):
    """Counts of the force sensor's driver during the observation, and the sensor's identity."""

    samples: int
    bad_sums: int
    """Packets with a wrong checksum since the port was opened."""
    product: str
    """Name and firmware version that the sensor reports."""
    lost: str | None = None
    """Reason why the port is no longer being read; None if it still is."""


class StateCounts(Record, frozen=True):
    """Number of state messages received from PX4 during the observation."""

    position: int
    """Number of LOCAL_POSITION_NED messages."""
    attitude: int
    """Number of ATTITUDE_QUATERNION messages."""
    imu: int
    """Number of HIGHRES_IMU messages."""


class Observations(Record, frozen=True, kw_only=True):
    """Everything that was observed for `duration_s`; the newest entries are last. A field is empty or None if nothing was received."""

    start_s: float
    """Flight clock at the start of the observation."""
    duration_s: float
    firmware: str | None = None
    """PX4's version as `MavsdkAutopilot.firmware` returns it, such as `PX4 1.16.1 release (git ...)`."""
    params: Mapping[str, float | int] = msgspec.field(default_factory=dict)
    """Values of PX4's parameters by name; a parameter that PX4 does not have is omitted."""
    vehicle: tuple[VehicleState, ...] = ()
    status: tuple[AutopilotStatus, ...] = ()
    estimator: tuple[EstimatorReport, ...] = ()
    mocap: tuple[MocapPose, ...] = ()
    mocap_stream: MocapStream | None = None
    markers: tuple[MarkerFrame, ...] = ()
    """Single markers of some frames; empty without `devices.mocap.ball`."""
    arm: tuple[ArmState, ...] = ()
    servos: tuple[ServoReport, ...] = ()
    """The arm's servos; empty if a plug-in drives the arm."""
    arm_statement: ArmStatement | None = None
    """Statement of the plug-in that drives the arm; None for servos."""
    force: tuple[ForceSample, ...] = ()
    machine: Machine | None = None
    hand_test: str | None = None
    """The recorded hand test of this setup; empty if there is none, None if no hand test is required."""
    hand_test_changed: str = ""
    """Differences between this setup and the setup that last passed the hand test; empty if no setup has passed it."""
    state_counts: StateCounts | None = None
    force_stream: ForceStream | None = None
    arm_reads: tuple[int, int] | None = None
    """(number of bus cycles, number of cycles without an answer)."""
    mission_s: float | None = None
    plan: tuple[str, ...] | None = None
    """Reasons why the mission cannot be flown, one line each; None if the mission was already checked."""
    left_out: tuple[str, ...] | None = None
    """Figures that the vehicle file leaves out; None if that is unknown, because the configuration does not come from its files."""
    recorder: str | None = None
    """Reason why no log can be opened; empty if a log can be opened, None if this was not tried."""
    failures: Mapping[str, str] = msgspec.field(default_factory=dict)
    """Error message of the driver for each device that could not be opened or read (`autopilot`, `mocap`, `arm` or `force`)."""


class Waiting(Record, frozen=True):
    """A condition for which the preflight check should wait after the observation."""

    what: str
    longest_s: float
