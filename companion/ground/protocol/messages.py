"""Messages between a vehicle and its ground stations over MQTT, version 2: one frozen record per topic, JSON on the wire.

All topics of a vehicle lie below ``companion/VEHICLE/``:

=============  =========  ========  ============================================================================
topic          record     QoS       what
=============  =========  ========  ============================================================================
``state``      `State`    1, ret.   who is there, and how it ended; the broker says ``lost`` when the vehicle falls silent
``scene``      `Scene`    1, ret.   what does not change in a flight: geometry, limits, planned path
``preflight``  `Preflight`  1, ret. the rows of the last preflight
``events``     `Events`   1, ret.   the newest events, all of them again each time: whoever comes late knows them too
``stream``     `Stream`   0         20 Hz: where it is, what it does, how it is
``command``    `Command`  1         ground to vehicle: signed, fresh, once
``ack``        `Ack`      1         what came of a command
=============  =========  ========  ============================================================================

World ENU, body FLU, SI units, quaternions (w, x, y, z), as in `companion.model.types`. A field that is None is left out of the JSON.
``t_s`` is the flight clock of the session; ``wall_s`` seconds since 1970 by the vehicle's wall clock, for people only.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

from companion.ground.protocol.strict_json import WireError, check_finite, parse
from companion.model.codec import RecordError, from_jsonable, json_text, to_jsonable
from companion.model.frozen import quick
from companion.model.types import Quat, Vec2, Vec3, Vec4

VERSION = 2
ROOT = "companion"
STREAM_PERIOD_S = 0.05
MESSAGE_MAX_BYTES = 200_000
"""Nothing larger is ever sent on any of the topics; a receiver throws larger ones away unread."""
COMMAND_MAX_BYTES = 1024

M = TypeVar("M")


class MessageError(ValueError):
    """A payload that is none of ours; says why in one line."""


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
        """Full name of this topic of a vehicle; ``+`` for those of every vehicle."""
        return f"{ROOT}/{vehicle}/{self.value}"


class Presence(Enum):
    """What is known of a vehicle's process."""

    FLYING = "flying"  # it ticks, on the ground or in the air: `Stream.kind` says which
    SILENT = "silent"  # its recorder lives, but the flight process says nothing: the guardian may be landing it
    ENDED = "ended"  # over, in order; `outcome` says how
    LOST = "lost"  # the connection broke without a word: nothing is known


class Light(Enum):
    """Health of one device at a glance."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    OFF = "off"  # not there, or not known yet


@quick
@dataclass(frozen=True, slots=True)
class State:
    """``state``, retained; also the last will."""

    v: int
    vehicle: str
    session: str
    """Drawn at random at the start of each flight; commands name it."""
    presence: Presence
    simulated: bool
    mission: str
    law: str
    preset: str
    wall_s: float
    """When it was said; 0.0 in the last will."""
    commands: bool
    """Commands are heard."""
    outcome: str | None = None
    """`companion.model.types.Outcome`, once known."""
    text: str | None = None
    """For people: why it is silent, why commands are not heard, ..."""


@quick
@dataclass(frozen=True, slots=True)
class Scene:
    """``scene``, retained: what a picture of the machine in its room is drawn from."""

    v: int
    session: str
    room_min_world_m: Vec3
    room_max_world_m: Vec3
    anchor_world_m: Vec3
    tether_length_m: float
    tether_margin_m: float
    attachment_body_m: Vec3
    radius_m: float
    """Horizontal reach, rotor disks included."""
    ground_clearance_m: float
    shoulder_body_m: Vec3
    link_lengths_m: Vec2
    net_radius_m: float
    joint_min_rad: Vec2
    joint_max_rad: Vec2
    tilt_abort_rad: float
    tracking_warn_m: float
    tracking_abort_m: float
    mission_s: float
    """Planned duration from take-off to touch-down."""
    path_world_m: tuple[Vec3, ...]
    """Planned path, evenly in time, at most 300 points; empty until it is planned."""
    phases: tuple[str, ...]


@quick
@dataclass(frozen=True, slots=True)
class PreflightRow:
    """One row of the preflight."""

    id: str
    level: str
    """``ok``, ``warn``, ``refuse`` or ``skipped``."""
    text: str


@quick
@dataclass(frozen=True, slots=True)
class Preflight:
    """``preflight``, retained."""

    v: int
    session: str
    rows: tuple[PreflightRow, ...]


@quick
@dataclass(frozen=True, slots=True)
class EventLine:
    """One event as people read it."""

    t_s: float
    mission_t_s: float
    id: str
    severity: str
    """`companion.model.types.Severity`."""
    action: str
    """`companion.model.types.SafetyAction`."""
    text: str


EVENTS_KEPT = 100


@quick
@dataclass(frozen=True, slots=True)
class Events:
    """``events``, retained: the newest `EVENTS_KEPT`, oldest first."""

    v: int
    session: str
    count: int
    """Of the whole session, those included that are kept no more."""
    lines: tuple[EventLine, ...]


@quick
@dataclass(frozen=True, slots=True)
class Health:
    """One light."""

    name: str
    light: Light
    text: str
    """What was measured: ``3 ms old``, ``15.9 V, 82 %``."""


@quick
@dataclass(frozen=True, slots=True)
class TetherView:
    """The tether as far as people need it; see `companion.model.types.TetherState`."""

    slack_m: float
    stop_slack_m: float
    pull_n: float
    turns: float
    taut: bool
    snagged: bool


@quick
@dataclass(frozen=True, slots=True)
class ControlView:
    """Inside of the controller; see `companion.model.types.ControlLog`."""

    rho: float
    h_hat: Vec4
    tau: Vec3
    """Force on the vehicle, world, N."""
    arm_torque_nm: Vec2
    force_ext_world_n: Vec3
    hover_thrust: float
    saturated: bool
    payload_estimate_kg: float | None = None


@quick
@dataclass(frozen=True, slots=True)
class Timing:
    """The loop and the wires, worst of the ticks since the message before."""

    lateness_ms: float
    mocap_age_ms: float | None
    mocap_to_setpoint_ms: float | None
    joint_read_to_write_ms: float | None
    core_ms: float
    """Inputs taken to decision made, `Sent.core_s - Sent.joint_read_s`."""
    missed: int
    """Ticks of this session that began a whole period late."""
    dropped: int
    """Records of this session that the recorder lost."""
    whole_ms: float | None = None
    """Tick begun to everything sent, the later of `Sent.setpoint_sent_s` and `Sent.current_sent_s`."""
    bus_read_ms: float | None = None
    """One read of all servos, by the bus thread."""


@quick
@dataclass(frozen=True, slots=True)
class Stream:
    """``stream``, 20 Hz. Position and attitude are motion capture's, PX4's where that is lost."""

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
    hold: int | None
    """Number of the hold that stands, `companion.model.types.Sent.hold`: `resume` names it. None: it does not hold."""
    armed: bool | None
    mode: str | None
    landed: str | None
    pose_from: str | None
    """``mocap`` or ``px4``."""
    position_world_m: Vec3 | None
    attitude_wxyz: Quat | None
    velocity_world_m_s: Vec3 | None
    arm_rad: Vec2 | None
    reference_world_m: Vec3 | None
    reference_yaw_rad: float | None
    reference_arm_rad: Vec2 | None
    e_p_m: float | None
    e_q_deg: float | None
    """Angle between attitude and setpoint."""
    thrust: float | None
    """Normalised, as sent."""
    battery_v: float | None
    battery_remaining: float | None
    tether: TetherView | None
    control: ControlView | None
    timing: Timing
    lights: tuple[Health, ...]
    bent_by: tuple[str, ...]
    waits_for_start: bool
    """All is well and it waits on the ground for `start`."""
    proofs: tuple[str, ...] = ()
    """One for each operator whose key the vehicle holds (`companion.ground.protocol.proof`); empty if it hears no commands."""


class CommandName(Enum):
    """What people may ask for."""

    HOLD = "hold"
    LAND = "land"
    ABORT = "abort"
    RESUME = "resume"  # go on after a hold
    START = "start"  # take off; for flights that wait for it


@quick
@dataclass(frozen=True, slots=True)
class Command:
    """``command``: signed with the operator's key over every other field (`companion.ground.protocol.commands`)."""

    v: int
    vehicle: str
    session: str
    operator: str
    command: CommandName
    t_ms: int
    """The vehicle's flight clock as the sender knows it: `Stream.t_s` of the last proven message and the time since, in ms. No two
    wall clocks need to agree."""
    hold: int
    """`Stream.hold` that a `resume` is to end; 0: none, and in every other command."""
    nonce: str
    """32 hexadecimal digits, never used twice."""
    mac: str
    """HMAC-SHA256, hexadecimal."""


@quick
@dataclass(frozen=True, slots=True)
class Ack:
    """``ack``: one for every command that was well signed, and for none of the others."""

    v: int
    session: str
    nonce: str
    operator: str
    command: CommandName
    accepted: bool
    """It did something, or what it asks for is done already."""
    text: str
    """What was done, or why nothing was."""
    t_s: float
    phase: str
    action: str
    proof: str = ""
    """For the operator who commanded (`companion.ground.protocol.proof`)."""


RECORDS: dict[Topic, type] = {
    Topic.STATE: State,
    Topic.SCENE: Scene,
    Topic.PREFLIGHT: Preflight,
    Topic.EVENTS: Events,
    Topic.STREAM: Stream,
    Topic.COMMAND: Command,
    Topic.ACK: Ack,
}
RETAINED = frozenset({Topic.STATE, Topic.SCENE, Topic.PREFLIGHT, Topic.EVENTS})


def encode(message: object) -> bytes:
    """A record as it goes over the wire."""
    return json_text(to_jsonable(message)).encode()


def decode(cls: type[M], payload: bytes, *, max_bytes: int = MESSAGE_MAX_BYTES) -> M:
    """A record from the wire.

    Raises:
        MessageError: the payload is too large, is not strict JSON (`companion.ground.protocol.strict_json`), has another version, does
            not fit the record, or holds a number that is not finite.
    """
    if len(payload) > max_bytes:
        raise MessageError(f"{len(payload)} bytes, at most {max_bytes} expected")
    try:
        data = parse(payload)
        if not isinstance(data, dict) or data.get("v") != VERSION:
            version = data.get("v") if isinstance(data, dict) else None
            raise MessageError(f"version {version!r:.20}, expected {VERSION}")
        record = from_jsonable(cls, data)
        check_finite(record)
    except (RecordError, WireError) as error:
        raise MessageError(str(error)) from None
    except RecursionError:  # nested so deeply that the refusal cannot even quote it
        raise MessageError("nested too deeply") from None
    return record


def vehicle_of(topic: str) -> tuple[str, Topic] | None:
    """(vehicle, topic) of a full name; None if it is none of ours."""
    parts = topic.split("/")
    if len(parts) != 3 or parts[0] != ROOT or not parts[1]:
        return None
    try:
        return parts[1], Topic(parts[2])
    except ValueError:
        return None
