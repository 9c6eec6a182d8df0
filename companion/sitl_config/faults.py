"""What can be made to go wrong in the simulated world: the kinds of faults, what their size means, and one planted fault.

One table for everybody: the world plants by it, `companion faults --list` prints it, docs/faults.md shows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, get_args

from pydantic import Field, model_validator

from companion.config.base import Location, Model, NonNegative, Positive, refuse

FaultKind = Literal[
    "mocap_loss",
    "mocap_occluded",
    "mocap_jump",
    "mocap_drag",
    "mocap_swap",
    "mocap_freeze",
    "mocap_latency",
    "mocap_rate",
    "link_loss",
    "link_delay",
    "autopilot_reboot",
    "offboard_refused",
    "arming_refused",
    "servo_loss",
    "servo_overload",
    "servo_hot",
    "servo_angle",
    "bus_noise",
    "force_loss",
    "force_stuck",
    "force_bias",
    "motor_weak",
    "battery_sag",
    "gust",
    "tether_taut",
    "tether_snag",
    "tether_cut",
    "payload_missed",
    "payload_double",
    "payload_dropped",
    "payload_heavy",
    "disk_full",
    "clock_step",
    "stall_loop",
    "hold_gil",
    "stop_flight",
    "kill_flight",
    "kill_recorder",
    "kill_guardian",
    "pilot_takeover",
]
FlightPhase = Literal["ground", "takeoff", "line", "catch", "return", "landing"]
PHASES: tuple[FlightPhase, ...] = get_args(FlightPhase)
IN_FLIGHT: tuple[FlightPhase, ...] = PHASES[1:]


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault."""

    what: str
    """What happens, in words."""
    size: str | None = None
    """What the size means; None: the kind has none."""
    unit: str = ""
    default: float | None = None
    """Size if none is given."""
    named_by: tuple[str, ...] = ()
    """Events that name the fault, or its consequence."""
    phases: tuple[FlightPhase, ...] = IN_FLIGHT
    """Where a campaign plants it."""
    process: bool = False
    """Of a process of the companion, not of the world."""


_MOCAP_GONE = ("mocap_lost", "mocap_invalid", "mocap_too_late")
_MOCAP_WRONG = (
    "mocap_jump", "mocap_swapped", "mocap_frozen", "mocap_dragged", "estimate_disagrees", "yaw_disagrees", "tracking_warn",
    "tracking_hold", "tracking_error",
)  # fmt: skip
_PX4_GONE = ("vehicle_state_lost", "heartbeat_lost", "px4_rebooted", "px4_disarmed", "estimate_frozen", "offboard_left")
_ARM_GONE = ("arm_lost", "arm_read_failures", "arm_let_go")
_PULLED = (
    "tether_taut", "tether_short", "tether_snagged", "tether_near", "tracking_warn", "tracking_hold", "tracking_error",
    "thrust_saturated", "tilt",
)  # fmt: skip
_WEAK = ("thrust_saturated", "tracking_warn", "tracking_hold", "tracking_error", "sinks_too_fast", "tilt", "crashed")
_GUARDIAN = ("guardian_took_over",)

KINDS: dict[FaultKind, Kind] = {
    "mocap_loss": Kind("no frame leaves the motion-capture machine", named_by=_MOCAP_GONE),
    "mocap_occluded": Kind("frames come, but the body is not seen in them", named_by=_MOCAP_GONE),
    "mocap_jump": Kind("poses are shifted sideways", "shift", "m", 0.3, _MOCAP_WRONG),
    "mocap_drag": Kind("poses are dragged sideways, further with every frame", "speed", "m/s", 1.0, _MOCAP_WRONG),
    "mocap_swap": Kind(
        "poses are those of another body that lies on the floor", "distance to it", "m", 1.0, _MOCAP_WRONG
    ),
    "mocap_freeze": Kind("frames go on with the same pose", named_by=(*_MOCAP_WRONG, *_MOCAP_GONE)),
    "mocap_latency": Kind(
        "frames come later", "additional latency", "s", 0.1, ("mocap_late", *_MOCAP_GONE, *_MOCAP_WRONG)
    ),
    "mocap_rate": Kind("fewer frames", "frames a second", "Hz", 30.0, ("mocap_slow", *_MOCAP_GONE)),
    "link_loss": Kind("the MAVLink link is dead both ways", named_by=_PX4_GONE),
    "link_delay": Kind(
        "the MAVLink link is slow both ways",
        "delay each way",
        "s",
        0.05,
        ("link_late", *_PX4_GONE, *_MOCAP_WRONG, "gate"),
    ),
    "autopilot_reboot": Kind(
        "PX4 restarts: rotors off, disarmed, its clock at zero; from a height that is a fall",
        "time to boot",
        "s",
        2.0,
        (*_PX4_GONE, "inputs_missing", "vision_not_fused", "crashed", "tilt"),
        ("ground",),
    ),
    "offboard_refused": Kind(
        "PX4 refuses OFFBOARD, and leaves it", named_by=("offboard_refused", "offboard_left"), phases=PHASES
    ),
    "arming_refused": Kind("PX4 refuses to arm", named_by=("arming_refused",), phases=("ground",)),
    "servo_loss": Kind("a servo neither hears nor answers", named_by=_ARM_GONE),
    "servo_overload": Kind("a servo reports overload and lets go", named_by=("servo_error", "arm_let_go")),
    "servo_hot": Kind(
        "a servo is hot; above 80 degC it lets go",
        "temperature",
        "degC",
        78.0,
        ("servo_warm", "servo_hot", "servo_error"),
    ),
    "servo_angle": Kind(
        "a servo's angle is off: its horn has slipped",
        "offset",
        "deg",
        30.0,
        ("joint_jump", "joint_wall", "joint_far_past_wall", "joint_rate", "servo_overload"),
    ),
    "bus_noise": Kind("packets on the servo bus are damaged", "share of them", "", 0.3, _ARM_GONE),
    "force_loss": Kind("the force sensor falls silent", named_by=("force_lost",)),
    "force_stuck": Kind("the force sensor repeats its last reading", named_by=("force_stuck",)),
    "force_bias": Kind(
        "the force sensor's zero moves",
        "shift of each axis",
        "N",
        4.0,
        ("force_drift", "force_overload", "tether_snagged", "tether_taut", "catch"),
    ),
    "motor_weak": Kind("a rotor loses thrust", "share lost", "", 0.15, (*_WEAK, "crashed")),
    "battery_sag": Kind(
        "the battery's voltage drops, thrust with its square", "drop", "V", 2.0, ("battery_voltage", *_WEAK)
    ),
    "gust": Kind(
        "wind, away from the tether's anchor",
        "speed",
        "m/s",
        6.0,
        (*_WEAK, "too_fast", "geofence_near", "tether_short"),
    ),
    "tether_taut": Kind(
        "the tether jams: no more of it comes out",
        "slack left",
        "m",
        0.1,
        _PULLED,
        ("takeoff", "line", "catch", "return"),
    ),
    "tether_snag": Kind("the tether catches on the floor beneath the vehicle", "slack left", "m", 0.15, _PULLED),
    "tether_cut": Kind("the tether parts", named_by=("tether_separated",)),
    "payload_missed": Kind("the throw goes beside the net", "aside", "m", 0.4, (), ("catch",)),
    "payload_double": Kind(
        "a second payload is thrown into the net", "its mass", "kg", 0.2, ("catch", *_WEAK, "servo_overload")
    ),
    "payload_dropped": Kind("the payload falls out of the net", named_by=(), phases=("catch", "return", "landing")),
    "payload_heavy": Kind(
        "the payload is heavier", "its mass", "kg", 0.6, ("catch", "servo_overload", *_WEAK), ("catch",)
    ),
    "disk_full": Kind("nothing more can be written to the log", named_by=("recorder_drops",), process=True),
    "clock_step": Kind(
        "the clock of the motion-capture machine steps",
        "step",
        "s",
        5.0,
        ("mocap_late", "mocap_too_late"),
        process=True,
    ),
    "stall_loop": Kind(
        "a blocking call on the event loop", named_by=("loop_late", "loop_stalled", *_GUARDIAN), process=True
    ),
    "hold_gil": Kind("the interpreter's lock is held for good", named_by=_GUARDIAN, process=True),
    "stop_flight": Kind(
        "SIGSTOP to the flight process", named_by=("loop_late", "loop_stalled", *_GUARDIAN), process=True
    ),
    "kill_flight": Kind("SIGKILL to the flight process", named_by=_GUARDIAN, process=True),
    "kill_recorder": Kind("SIGKILL to the recorder", named_by=("recorder_drops",), process=True),
    "kill_guardian": Kind("SIGKILL to the guardian", named_by=("guardian_lost",), process=True),
    "pilot_takeover": Kind(
        "a pilot switches PX4 to Hold, and later to Land", "time in Hold", "s", 3.0, ("pilot_took_over",), process=True
    ),
}


class Fault(Model):
    """One planted fault: when, for how long, how large. Kinds and sizes: docs/faults.md."""

    kind: FaultKind
    t_s: NonNegative | None = None
    """Seconds since what `after` says; absent: as `phase` says."""
    after: Literal["start", "arming", "catch"] = "arming"
    """The world's start, the rotors' arming or the catch."""
    phase: FlightPhase | None = None
    """Instead of `t_s`: in the middle of that part of the mission, or just after the catch."""
    duration_s: Positive | None = None
    """Absent: for good."""
    size: float | None = Field(default=None)
    """Absent: the kind's default."""
    servo: Literal[1, 2] = 1
    """Of faults of one servo."""

    @property
    def magnitude(self) -> float:
        """The size, or the kind's default; 0 of a kind that has none."""
        default = KINDS[self.kind].default
        return self.size if self.size is not None else default if default is not None else 0.0

    @model_validator(mode="after")
    def _whole(self) -> Self:
        problems: list[tuple[Location, str]] = []
        if (self.t_s is None) == (self.phase is None):
            problems.append((("t_s",), "give either t_s or phase, so that the world knows when"))
        kind = KINDS[self.kind]
        if self.size is not None and kind.size is None:
            problems.append((("size",), f"a {self.kind} has no size; leave it out"))
        elif self.magnitude < 0.0:
            problems.append((("size",), f"must not be negative, got {self.magnitude:g}"))
        elif kind.unit == "Hz" and self.magnitude == 0.0:
            problems.append((("size",), "must be above 0"))
        elif kind.size is not None and kind.size.startswith("share") and self.magnitude > 1.0:
            problems.append((("size",), f"is a share, 0 to 1, got {self.magnitude:g}"))
        refuse("fault", problems)
        return self
