"""Faults of the simulated world: the kinds, the meaning of their sizes, and the settings of one injected fault.

The world, `companion faults --list` and docs/internals/faults.md use the same table. `sitl.faults` implements the effect of each kind;
a campaign flies each with its default size, or as `companion.campaigns.faults.variants` lists it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from companion.config.base import JOINTS_MAX, Location, Model, NonNegative, Positive, refuse
from companion.config.vehicle import Vehicle

FlightPhase = Literal["ground", "takeoff", "line", "catch", "return", "landing", "touch", "press", "slide", "detach"]
CONTACT_PHASES: tuple[FlightPhase, ...] = ("touch", "press", "slide", "detach")
"""Phases of a mission that presses on a surface or slides along it."""
PHASES: tuple[FlightPhase, ...] = tuple(phase for phase in get_args(FlightPhase) if phase not in CONTACT_PHASES)
IN_FLIGHT: tuple[FlightPhase, ...] = PHASES[1:]


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault."""

    what: str
    size: str | None = None
    """Meaning of the size; None if the kind has no size."""
    unit: str = ""
    default: float | None = None
    named_by: tuple[str, ...] = ()
    """Events that report the fault or its consequence."""
    phases: tuple[FlightPhase, ...] = IN_FLIGHT
    """Phases in which a campaign injects the fault."""
    signed: bool = False
    """Whether the size may be negative."""
    process: bool = False
    """Whether the fault acts on a process of the companion instead of on the world."""


_MOCAP_GONE = ("mocap_lost", "mocap_invalid", "mocap_too_late", "vision_lost")
_MOCAP_WRONG = (
    "mocap_jump", "mocap_swapped", "mocap_frozen", "mocap_dragged", "estimate_disagrees", "yaw_disagrees", "tracking_warn",
    "tracking_hold", "tracking_error", "vision_rejected",
)  # fmt: skip
_PX4_GONE = ("vehicle_state_lost", "heartbeat_lost", "px4_rebooted", "px4_disarmed", "estimate_frozen", "offboard_left")
_ARM_GONE = ("arm_lost", "arm_read_failures", "servo_watchdog_tripped")
_PULLED = (
    "tether_taut", "tether_short", "tether_snagged", "tether_near", "tracking_warn", "tracking_hold", "tracking_error",
    "thrust_saturated", "tilt",
)  # fmt: skip
_WEAK = ("thrust_saturated", "tracking_warn", "tracking_hold", "tracking_error", "sinks_too_fast", "tilt", "crashed")
_GUARDIAN = ("guardian_took_over",)
_CONTACT_ENDS = ("contact_disagrees", "contact_lost", "contact_interrupted", "contact_slipped", "surface_missing")

KINDS: dict[str, Kind] = {
    "mocap_loss": Kind("no frame leaves the motion-capture computer", named_by=_MOCAP_GONE),
    "mocap_occluded": Kind("frames arrive, but the body is not tracked", named_by=_MOCAP_GONE),
    "mocap_jump": Kind(what="poses are shifted sideways", size="shift", unit="m", default=0.3, named_by=_MOCAP_WRONG),
    "mocap_drag": Kind(
        what="poses drift sideways, further with every frame",
        size="speed",
        unit="m/s",
        default=1.0,
        named_by=_MOCAP_WRONG,
    ),
    "mocap_swap": Kind(
        what="the poses are those of another body, which lies on the floor",
        size="distance to that body",
        unit="m",
        default=1.0,
        named_by=_MOCAP_WRONG,
    ),
    "mocap_freeze": Kind("frames continue with the same pose", named_by=(*_MOCAP_WRONG, *_MOCAP_GONE)),
    "mocap_flip": Kind(
        what="every second pose is turned about the vertical: the markers fit the body in two ways",
        size="angle",
        unit="deg",
        default=180.0,
        named_by=_MOCAP_WRONG,
    ),
    "mocap_flicker": Kind(
        what="every second pose is shifted sideways", size="shift", unit="m", default=0.3, named_by=_MOCAP_WRONG
    ),
    "mocap_latency": Kind(
        what="frames leave the motion-capture computer later",
        size="additional latency",
        unit="s",
        default=0.1,
        named_by=("mocap_late", *_MOCAP_GONE, *_MOCAP_WRONG),
    ),
    "mocap_network": Kind(
        what="frames wait on the network, after the server has stamped them",
        size="additional delay",
        unit="s",
        default=0.15,
        named_by=("mocap_late", *_MOCAP_GONE, *_MOCAP_WRONG),
    ),
    "mocap_rate": Kind(
        what="fewer frames are sent",
        size="frames per second",
        unit="Hz",
        default=30.0,
        named_by=("mocap_slow", *_MOCAP_GONE),
    ),
    "link_loss": Kind("the MAVLink link is dead in both directions", named_by=_PX4_GONE),
    "link_delay": Kind(
        what="the MAVLink link is slow in both directions",
        size="delay in each direction",
        unit="s",
        default=0.05,
        named_by=("link_slow", "link_late", "oscillates", *_PX4_GONE, *_MOCAP_WRONG, "gate"),
    ),
    "autopilot_reboot": Kind(
        what="PX4 reboots: it is disarmed, the rotors stop and its clock restarts at zero; in the air, the vehicle falls",
        size="time to boot",
        unit="s",
        default=2.0,
        named_by=(*_PX4_GONE, "inputs_missing", "vision_not_fused", "crashed", "tilt"),
        phases=("ground",),
    ),
    "offboard_refused": Kind(
        "PX4 leaves OFFBOARD and refuses to enter it", named_by=("offboard_refused", "offboard_left"), phases=PHASES
    ),
    "arming_refused": Kind("PX4 refuses to arm", named_by=("arming_refused",), phases=("ground",)),
    "servo_loss": Kind("a servo neither receives nor answers", named_by=_ARM_GONE),
    "servo_overload": Kind(
        "a servo reports overload and releases its torque", named_by=("servo_error", "servo_watchdog_tripped")
    ),
    "servo_hot": Kind(
        what="a servo is hot; above 80 degC it releases its torque",
        size="temperature",
        unit="degC",
        default=78.0,
        named_by=("servo_warm", "servo_hot", "servo_error"),
    ),
    "servo_angle": Kind(
        what="a servo's angle is wrong: its horn has slipped",
        size="offset",
        unit="deg",
        default=30.0,
        named_by=("joint_jump", "joint_beyond_limit", "joint_far_beyond_limit", "joint_rate", "servo_overload"),
    ),
    "clamp_overload": Kind("the clamp's servo reports overload and releases its torque", named_by=("clamp_error",)),
    "bus_noise": Kind(
        what="packets on the servo bus are corrupted",
        size="fraction of packets",
        unit="",
        default=0.3,
        named_by=_ARM_GONE,
    ),
    "bus_delay": Kind(
        what="the servos' answers arrive later, as behind a USB adapter with a long latency timer",
        size="additional delay",
        unit="s",
        default=0.01,
        named_by=("joint_states_late", "joint_swings", "joint_swings_on", *_ARM_GONE),
    ),
    "force_loss": Kind("the force sensor stops sending", named_by=("force_lost", "contact_lost")),
    "force_stuck": Kind("the force sensor repeats its last reading", named_by=("force_stuck", "contact_lost")),
    "force_bias": Kind(
        what="the force sensor's zero shifts",
        size="shift of each axis",
        unit="N",
        default=4.0,
        named_by=(
            "force_disagrees",
            "force_drift",
            "force_overload",
            "tether_snagged",
            "tether_taut",
            "catch",
            *_CONTACT_ENDS,
        ),
        signed=True,
    ),
    "motor_weak": Kind(what="a rotor loses thrust", size="fraction lost", unit="", default=0.15, named_by=_WEAK),
    "battery_sag": Kind(
        what="the battery's voltage drops, and the thrust with the square of the voltage",
        size="drop",
        unit="V",
        default=2.0,
        named_by=("battery_voltage", *_WEAK),
    ),
    "gust": Kind(
        what="a wind blows away from the tether's anchor, or into the world's first surface",
        size="speed",
        unit="m/s",
        default=6.0,
        named_by=(*_WEAK, *_CONTACT_ENDS, "contact_force_high", "too_fast", "geofence_near", "tether_short"),
    ),
    "tether_taut": Kind(
        what="the tether jams: its free length cannot grow",
        size="slack left",
        unit="m",
        default=0.1,
        named_by=_PULLED,
        phases=("takeoff", "line", "catch", "return"),
    ),
    "tether_snag": Kind(
        what="the tether catches on the floor beneath the vehicle",
        size="slack left",
        unit="m",
        default=0.15,
        named_by=_PULLED,
    ),
    "tether_cut": Kind("the tether breaks", named_by=("tether_separated",)),
    "payload_missed": Kind(
        what="the throw misses the net",
        size="distance by which it misses",
        unit="m",
        default=0.4,
        named_by=(),
        phases=("catch",),
    ),
    "payload_double": Kind(
        what="a second payload is thrown into the net",
        size="its mass",
        unit="kg",
        default=0.2,
        named_by=("catch", *_WEAK, "servo_overload"),
    ),
    "payload_dropped": Kind("the payload falls out of the net", named_by=(), phases=("catch", "return", "landing")),
    "payload_heavy": Kind(
        what="the payload is heavier",
        size="its mass",
        unit="kg",
        default=0.6,
        named_by=("catch", "servo_overload", *_WEAK),
        phases=("catch",),
    ),
    "surface_gone": Kind("the surfaces give way at once", named_by=_CONTACT_ENDS, phases=CONTACT_PHASES),
    "surface_slippery": Kind(
        what="the friction of the surfaces changes",
        size="coefficient of friction",
        default=0.05,
        named_by=_CONTACT_ENDS,
        phases=CONTACT_PHASES,
    ),
    "tool_broken": Kind("the rod or brush breaks off", named_by=_CONTACT_ENDS, phases=CONTACT_PHASES),
    "disk_full": Kind("the log can no longer be written", named_by=("recorder_drops",), process=True),
    "clock_step": Kind(
        what="the clock of the motion-capture computer jumps",
        size="step",
        unit="s",
        default=5.0,
        named_by=("mocap_late", "mocap_too_late"),
        process=True,
    ),
    "stall_loop": Kind(
        "a call blocks the event loop", named_by=("loop_late", "loop_stalled", *_GUARDIAN), process=True
    ),
    "hold_gil": Kind("the interpreter lock (GIL) is held permanently", named_by=_GUARDIAN, process=True),
    "stop_flight": Kind(
        "the flight process receives SIGSTOP", named_by=("loop_late", "loop_stalled", *_GUARDIAN), process=True
    ),
    "kill_flight": Kind("the flight process receives SIGKILL", named_by=_GUARDIAN, process=True),
    "kill_recorder": Kind("the recorder receives SIGKILL", named_by=("recorder_drops",), process=True),
    "kill_guardian": Kind("the guardian receives SIGKILL", named_by=("guardian_lost",), process=True),
    "pilot_takeover": Kind(
        what="a pilot switches PX4 to Hold, and later to Land",
        size="time in Hold",
        unit="s",
        default=3.0,
        named_by=("pilot_took_over",),
        process=True,
    ),
    "kill_switch": Kind(
        "the pilot stops the rotors by the kill switch and, at the end of the fault, releases it; in the air, the vehicle falls",
        named_by=("killed",),
        phases=("ground",),
    ),
}

if TYPE_CHECKING:
    FaultKind = str
else:
    FaultKind = Literal[tuple(KINDS)]


def absent_part(kind: FaultKind, vehicle: Vehicle) -> str | None:
    """Return the vehicle-file key of the part that this kind of fault needs but the vehicle lacks; None if no part is missing."""
    if kind.startswith("force_") and vehicle.devices.force is None:
        return "devices.force"
    if kind.startswith("tether_") and vehicle.tether is None:
        return "tether"
    if kind.startswith(("servo_", "bus_")) and not vehicle.arm.joints:
        return "arm"
    if kind.startswith("payload_") and not vehicle.has_net:
        return "tool (a net)"
    if kind.startswith("clamp_") and vehicle.jaws is None:
        return "tool (a clamp)"
    if kind == "tool_broken" and (vehicle.tool is None or vehicle.has_net):
        return "tool (a rod or a brush)"
    return None


class Fault(Model):
    """An injected fault with its start, duration and size. docs/internals/faults.md describes kinds and sizes."""

    kind: FaultKind
    t_s: NonNegative | None = None
    """Time from the event in `after` to the start of the fault. If it is absent, `phase` determines the start."""
    after: Literal["start", "arming", "throw", "catch", "touch", "press", "lift"] = "arming"
    """Event from which `t_s` counts: the start of the world, arming, the first throw, the catch, the first touch of a surface, the
    beginning of the first one that lasts for 2.5 s, or the lift of a bar that two vehicles carry."""
    phase: FlightPhase | None = None
    """Alternative to `t_s`: the fault starts in the middle of this part of the mission, or just after the catch. `touch`, `press`,
    `slide` and `detach` are parts of a contact with a surface."""
    duration_s: Positive | None = None
    """Duration. If it is absent, the fault is permanent."""
    size: float | None = Field(default=None)
    """Size, with the meaning and unit of the kind. If it is absent, the kind's default is used."""
    servo: Annotated[int, Field(ge=1, le=JOINTS_MAX)] = 1
    """The servo on which the fault acts, for faults of one servo: 1 is the shoulder's."""

    @property
    def magnitude(self) -> float:
        """Return the size, or the kind's default; 0 for a kind without a size."""
        default = KINDS[self.kind].default
        return self.size if self.size is not None else default if default is not None else 0.0

    @model_validator(mode="after")
    def _whole(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if (self.t_s is None) == (self.phase is None):
            problems.append((("t_s",), "give either t_s or phase for the start of the fault"))
        kind = KINDS[self.kind]
        if self.size is not None and kind.size is None:
            problems.append((("size",), f"a {self.kind} has no size; remove it"))
        elif self.magnitude < 0.0 and not kind.signed:
            problems.append((("size",), f"must not be negative, got {self.magnitude:g}"))
        elif kind.unit == "Hz" and self.magnitude == 0.0:
            problems.append((("size",), "must be above 0"))
        elif kind.size is not None and kind.size.startswith("fraction") and self.magnitude > 1.0:
            problems.append((("size",), f"is a fraction, 0 to 1, got {self.magnitude:g}"))
        refuse("fault", problems)
        return self
