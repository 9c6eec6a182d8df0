"""Messages between a vehicle and its ground stations over MQTT, version 2: one frozen record per topic, JSON on the wire.

All topics of a vehicle are below ``companion/VEHICLE/``:

=============  ===========  ========  ==========================================================================
topic          record       QoS       content
=============  ===========  ========  ==========================================================================
``state``      `State`      1, ret.   presence and outcome; the broker publishes ``lost`` when the vehicle falls silent
``scene``      `Scene`      1, ret.   constants of the flight: geometry, limits, planned path
``preflight``  `Preflight`  1, ret.   rows of the last preflight
``events``     `Events`     1, ret.   the newest events, all in each message, for late subscribers
``stream``     `Stream`     0         20 Hz: pose, phase, health
``command``    `Command`    1         ground to vehicle: signed, recent, once
``ack``        `Ack`        1         result of a command
=============  ===========  ========  ==========================================================================

World ENU, body FLU, SI units, quaternions (w, x, y, z), as in `companion.model.types`. A field that is None is left out of the JSON.
``t_s`` is the flight clock of the session; ``wall_s`` is seconds since 1970 on the vehicle's wall clock, for display only.
"""

from __future__ import annotations

from enum import Enum
from typing import TypeVar

from companion.ground.protocol.strict_json import StrictJsonError, parse
from companion.model.codec import Record, RecordError, from_jsonable
from companion.model.types import Event, Joints, OperatorCommand, Quat, Vec3, Vec4

VERSION = 2
ROOT = "companion"
MESSAGE_MAX_BYTES = 200_000
"""Largest message on any topic; receivers drop larger ones unread."""
COMMAND_MAX_BYTES = 1024

M = TypeVar("M")


class MessageError(ValueError):
    """The payload is not a valid message. The exception's text is one line."""


class Topic(Enum):
    """Last level of a topic's name."""

    STATE = "state"
    SCENE = "scene"
    PREFLIGHT = "preflight"
    EVENTS = "events"
    STREAM = "stream"
    COMMAND = "command"
    ACK = "ack"

    def of(self, vehicle: str) -> str:
        """Return the full name of a vehicle's topic; ``+`` matches every vehicle."""
        return f"{ROOT}/{vehicle}/{self.value}"


class Presence(Enum):
    """State of a vehicle's processes."""

    FLYING = "flying"  # the control loop runs, on the ground or in the air (`Stream.kind`)
    SILENT = "silent"  # the recorder runs but the flight process sends nothing: the guardian may be landing the vehicle
    ENDED = "ended"  # the flight has ended normally, see `outcome`
    LOST = "lost"  # the connection was lost without notice


class HealthLevel(Enum):
    """Health of one device."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    OFF = "off"  # not present, or not known yet


class State(Record, frozen=True, kw_only=True):
    """Retained message on topic ``state``; also the last will."""

    v: int
    vehicle: str
    session: str
    """Random id of the flight, which commands must name."""
    presence: Presence
    simulated: bool
    mission: str
    law: str
    preset: str
    wall_s: float
    """Time of the message; 0.0 in the last will."""
    commands: bool
    """The vehicle accepts commands."""
    outcome: str | None = None
    """`companion.model.types.Outcome`, once known."""
    text: str | None = None
    """Text for display: why the vehicle is silent, why it accepts no commands, ..."""


class Scene(Record, frozen=True, kw_only=True):
    """Retained message on topic ``scene``: geometry and limits for drawing the vehicle in its room."""

    v: int
    session: str
    room_min_world_m: Vec3
    room_max_world_m: Vec3
    anchor_world_m: Vec3 | None = None
    """None without a tether, as are the other three values of the tether."""
    tether_length_m: float | None = None
    tether_margin_m: float | None = None
    attachment_body_m: Vec3 | None = None
    radius_m: float
    """Horizontal reach including the rotor disks."""
    rotors_body_m: tuple[Vec3, ...] = ()
    """Position of each rotor; empty in messages of version 0.1.0."""
    ground_clearance_m: float
    shoulder_body_m: Vec3
    link_lengths_m: Joints
    """Distance from each joint to the next one, and from the last joint to the net."""
    links_body_m: tuple[Vec3, ...]
    """Vector from each joint to the next one, and from the last joint to the net, in the body frame at joint angles 0."""
    joint_axes_body: tuple[Vec3, ...]
    """Axis of each joint in the body frame at joint angles 0; positive angles turn by the right-hand rule."""
    net_radius_m: float | None = None
    """None without a net."""
    joint_min_rad: Joints
    joint_max_rad: Joints
    tilt_abort_rad: float
    tracking_warn_m: float
    tracking_abort_m: float
    mission_s: float
    """Planned duration from take-off to touchdown."""
    path_world_m: tuple[Vec3, ...]
    """Planned path at equal time steps, at most 300 points; empty until it is planned."""
    phases: tuple[str, ...]
    has_contact: bool | None = None
    """True if the mission has contact phases, else None."""
    bar_length_m: float | None = None
    """Distance between the handles of the bar whose one end the vehicle grips; None if the mission has no bar."""
    partner: str | None = None
    """Name in topics of the vehicle that grips the other end; None if there is none."""


class PreflightRow(Record, frozen=True):
    """One row of the preflight."""

    id: str
    level: str
    """``ok``, ``warn``, ``refuse`` or ``skipped``."""
    text: str


class Preflight(Record, frozen=True):
    """Retained message on topic ``preflight``."""

    v: int
    session: str
    rows: tuple[PreflightRow, ...]


class EventLine(Record, frozen=True, kw_only=True):
    """One event for display."""

    t_s: float
    mission_t_s: float
    id: str
    severity: str
    """`companion.model.types.Severity`."""
    action: str
    """`companion.model.types.SafetyAction`."""
    text: str

    @staticmethod
    def of(event: Event, mission_t_s: float) -> EventLine:
        """Return the line of an event."""
        severity, action = event.severity.value, event.action.value
        return EventLine(
            t_s=event.t_s, mission_t_s=mission_t_s, id=event.id, severity=severity, action=action, text=event.text
        )


EVENTS_KEPT = 100


class Events(Record, frozen=True, kw_only=True):
    """Retained message on topic ``events``: the newest `EVENTS_KEPT` events, oldest first."""

    v: int
    session: str
    count: int
    """Number of events in the session, including those no longer kept."""
    lines: tuple[EventLine, ...]


class DeviceHealth(Record, frozen=True):
    """Health of one device."""

    name: str
    light: HealthLevel
    text: str
    """Measured values, such as ``3 ms old`` or ``15.9 V, 82 %``."""


class TetherView(Record, frozen=True, kw_only=True):
    """State of the tether for display; see `companion.model.outputs.TetherState`."""

    slack_m: float
    stop_slack_m: float
    pull_n: float
    turns: float
    taut: bool
    snagged: bool


class ControlView(Record, frozen=True, kw_only=True):
    """Internal values of the controller; see `companion.model.outputs.ControlLog`."""

    rho: float
    h_hat: Vec4
    tau: Vec3
    """Force on the vehicle, world, N."""
    arm_torque_nm: Joints
    force_ext_world_n: Vec3 | None = None
    """External force on the net, world frame, N; None without a force sensor."""
    hover_thrust: float
    saturated: bool
    payload_estimate_kg: float | None = None


class ContactView(Record, frozen=True, kw_only=True):
    """Contact with a surface; see `companion.model.contact.ContactState`."""

    mode: str
    """`companion.model.contact.ContactMode`."""
    force_n: float
    """Measured force of the surface against the direction of the approach."""
    wanted_n: float


class BallView(Record, frozen=True, kw_only=True):
    """The ball that the vehicle sees; see `companion.model.markers.BallState`."""

    position_world_m: Vec3
    meeting_world_m: Vec3 | None = None
    meets_in_s: float | None = None
    """Time until the net is to meet it."""


class BarView(Record, frozen=True, kw_only=True):
    """The bar that two vehicles carry; see `companion.model.team.BarPose`."""

    position_world_m: Vec3
    """Middle between the handles."""
    attitude_wxyz: Quat
    """Attitude; x points to the left end."""


class Timing(Record, frozen=True, kw_only=True):
    """Durations of the loop and the links: the largest of all ticks since the previous message."""

    lateness_ms: float
    mocap_age_ms: float | None = None
    mocap_to_setpoint_ms: float | None = None
    joint_read_to_write_ms: float | None = None
    core_ms: float
    """Time from the inputs to the core's decision, `Sent.core_s - Sent.joint_read_s`."""
    missed: int
    """Ticks of this session that began at least one period late."""
    dropped: int
    """Records of this session that the recorder lost."""
    whole_ms: float | None = None
    """Time from the start of the tick to the last output, the later of `Sent.setpoint_sent_s` and `Sent.current_sent_s`."""
    bus_read_ms: float | None = None
    """Duration of one read of all servos by the bus thread."""


class Stream(Record, frozen=True, kw_only=True):
    """Message on topic ``stream``, published at 20 Hz, with the pose from motion capture, or from PX4 while that is lost."""

    v: int
    session: str
    seq: int
    wall_s: float
    t_s: float
    mission_t_s: float
    phase: str
    kind: str
    """`companion.model.types.PhaseKind`."""
    progress: float
    action: str
    """`companion.model.types.SafetyAction`."""
    hold: int | None = None
    """Number of the current hold, `companion.model.outputs.Sent.hold`, which `resume` names; None if the vehicle does not hold."""
    armed: bool | None = None
    mode: str | None = None
    landed: str | None = None
    pose_from: str | None = None
    """``mocap`` or ``px4``."""
    position_world_m: Vec3 | None = None
    attitude_wxyz: Quat | None = None
    velocity_world_m_s: Vec3 | None = None
    arm_rad: Joints | None = None
    reference_world_m: Vec3 | None = None
    reference_yaw_rad: float | None = None
    reference_arm_rad: Joints | None = None
    e_p_m: float | None = None
    e_q_deg: float | None = None
    """Angle between the attitude and its setpoint."""
    thrust: float | None = None
    """Normalised thrust as sent."""
    battery_v: float | None = None
    battery_remaining: float | None = None
    tether: TetherView | None = None
    control: ControlView | None = None
    contact: ContactView | None = None
    """None outside contact phases."""
    ball: BallView | None = None
    bar: BarView | None = None
    """None while motion capture does not see it."""
    timing: Timing
    lights: tuple[DeviceHealth, ...]
    limited_by: tuple[str, ...]
    waits_for_start: bool
    """The vehicle is ready on the ground and waits for `start`."""
    proofs: tuple[str, ...]
    """One proof per operator whose key the vehicle holds (`companion.ground.protocol.proof`); empty if it accepts no commands."""


class Command(Record, frozen=True, kw_only=True):
    """Message on topic ``command``, signed with the operator's key over every other field (`companion.ground.protocol.commands`)."""

    v: int
    vehicle: str
    session: str
    operator: str
    command: OperatorCommand
    t_ms: int
    """The vehicle's flight clock as estimated by the sender, ms: `Stream.t_s` of the last proven message plus the time since."""
    hold: int
    """`Stream.hold` that a `resume` ends; 0 in every other command."""
    nonce: str
    """32 hexadecimal digits, never used twice."""
    mac: str
    """HMAC-SHA256, hexadecimal."""


class Ack(Record, frozen=True, kw_only=True):
    """Message on topic ``ack``, sent in answer to every correctly signed command and to nothing else."""

    v: int
    session: str
    nonce: str
    operator: str
    command: OperatorCommand
    accepted: bool
    """The command took effect, or the requested state had already been reached."""
    text: str
    """What was done, or why the command was refused."""
    t_s: float
    phase: str
    action: str
    proof: str
    """Proof for the operator who sent the command (`companion.ground.protocol.proof`)."""


RECORDS: dict[Topic, type] = dict(zip(Topic, (State, Scene, Preflight, Events, Stream, Command, Ack), strict=True))
RETAINED = frozenset({Topic.STATE, Topic.SCENE, Topic.PREFLIGHT, Topic.EVENTS})


def decode(cls: type[M], payload: bytes) -> M:
    """Return the record of a payload.

    Raises:
        MessageError: the payload is too large, is not strict JSON (`companion.ground.protocol.strict_json`), has a different
            version, or does not fit the record.
    """
    if len(payload) > MESSAGE_MAX_BYTES:
        raise MessageError(f"{len(payload)} bytes, expected at most {MESSAGE_MAX_BYTES}")
    try:
        data = parse(payload)
        if not isinstance(data, dict) or data.get("v") != VERSION:
            version = data.get("v") if isinstance(data, dict) else None
            raise MessageError(f"version {version!r:.20}, expected {VERSION}")
        return from_jsonable(cls, data)
    except (RecordError, StrictJsonError) as error:
        raise MessageError(str(error)) from None
    except RecursionError:  # nested too deeply to be quoted
        raise MessageError("nested too deeply") from None


def vehicle_of(topic: str) -> tuple[str, Topic] | None:
    """Return (vehicle, topic) of a full topic name, or None if it is not a vehicle's topic."""
    parts = topic.split("/")
    if len(parts) != 3 or parts[0] != ROOT or not parts[1]:
        return None
    try:
        return parts[1], Topic(parts[2])
    except ValueError:
        return None
