"""Phase `grip`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec.structs import replace
from pydantic import Field

from companion.config.arm import JAWS_TOLERANCE_DEG, Jaws
from companion.config.phase import ArmPose, Duration, PhaseSettings
from companion.control.arm_model import manipulator_of
from companion.mission.air import Air, Expectation, HeldBar
from companion.mission.bar_landing import BACK_M, RISE_M
from companion.mission.minsnap import least_line_s
from companion.mission.phase import Checking, Phase, Planning
from companion.model.algebra import minus, plus, scaled
from companion.model.codec import Record
from companion.model.frames import quat_rotate
from companion.model.team import ClampCommand, Grip, Together
from companion.model.types import Inputs, Reference, SafetyAction, Severity, Vec3
from companion.phases.carry.bar import (
    Bar,
    BarPose,
    End,
    body_in_bar_m,
    body_m,
    problems_of,
    sign_of,
    turned_about_z,
    vehicle_yaw_rad,
)
from companion.safety.notices import EventDefinition

GRIPPED = EventDefinition(
    "gripped", Severity.INFO, SafetyAction.NOMINAL, "the clamp has closed around the bar's handle"
)
GRIPPED_NOTHING = EventDefinition(
    "gripped_nothing", Severity.WARNING, SafetyAction.NOMINAL,
    "the jaws have closed beside the handle: they open, and the clamp is led to a place 4 cm beside where it was",
)  # fmt: skip
NOT_GRIPPED = EventDefinition(
    "not_gripped", Severity.CRITICAL, SafetyAction.LAND,
    "the clamp did not reach the handle or did not close, or the other vehicle was not ready in time: the vehicle lets go and lands",
)  # fmt: skip

SETTLE_S: Final = 1.5
"""Time for which the clamp must be at the handle before it closes."""
LIFT_AFTER_S: Final = 0.5
"""Time from the decision to lift until both vehicles do, in which the announcement arrives many times."""
PARTNER_FRESH_S: Final = 0.3
"""Age up to which the other vehicle's announcement counts."""


class Gripping(Record, frozen=True, kw_only=True):
    """State of the phase."""

    at_handle_s: float = math.inf
    """Flight clock since which the clamp has been at the handle; infinite while it is not."""
    over_bar: bool = False
    """Whether a landing must first move away from the bar."""
    waits_since_s: float = math.inf
    """Flight clock at the end of the way to the handle."""
    handle_m: Vec3 = (0.0, 0.0, 0.0)
    """Measured minus planned place of the handle, world frame, low-passed; 0 while the bar has not been seen."""
    beside_m: Vec3 = (math.inf, 0.0, 0.0)
    """Place of the clamp minus that of the handle, low-passed; infinite before the end of the way."""
    offset_m: Vec3 = (0.0, 0.0, 0.0)
    """Offset of the reference: to where the handle is, and from the grip on to where the vehicle is held."""
    closes: bool = False
    misses: int = 0
    """How often the jaws have closed beside the handle."""
    stopped_s: float = math.inf
    """Flight clock since which the jaws have been closed as far as around a handle; infinite while they are not."""
    closed_s: float = math.inf
    """Flight clock at which the clamp had closed."""
    lift_server_s: float | None = None


class GripHandle(Phase):
    """Fly to an end of the bar, grip its handle, and wait until the other vehicle has gripped the other one."""

    acts: ClassVar[bool] = True

    type: Literal["grip"]
    bar: Bar
    end: End = "left"
    """The end that this vehicle grips; a team file sets it for each member."""
    arm_deg: ArmPose
    """Joint angles with which the bar is held."""
    above_m: Annotated[float, Field(ge=0.05, le=0.5)] = 0.15
    """Height of the clamp above the handle before it is lowered."""
    lower_s: Duration = 2.0
    """Duration of the lowering."""
    tolerance_m: Annotated[float, Field(ge=0.005, le=0.05)] = 0.02
    """Distance of the clamp from the handle up to which it closes: the jaws are wider than the handle by this much."""
    wait_max_s: Duration = 45.0
    """Longest time at the handle until both vehicles are ready."""
    let_go_height_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.1
    """Height of the bar's feet above the floor below which an emergency may let go of it."""

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return f"grip the {self.end} end"

    def unfinished(self, after: PhaseSettings) -> str | None:
        """Return what must come between this phase and `after`."""
        return None if after.type == "carry" else "a bar that is gripped must be carried next (type: carry)"

    def pose(self, height_m: float) -> BarPose:
        """Return the bar's pose with its handles at a height."""
        return BarPose((*self.bar.position_m, height_m), math.radians(self.bar.yaw_deg))

    def arm_rad(self) -> tuple[float, ...]:
        """Return the joint angles with which the bar is held."""
        return tuple(math.radians(angle) for angle in self.arm_deg)

    def plan(self, p: Planning) -> None:
        """Append the way to above the handle, on which the arm moves, and the lowering."""
        arm_rad, builder = self.arm_rad(), p.builder
        in_bar_m = body_in_bar_m(manipulator_of(p.vehicle), self.end, self.bar, arm_rad)
        above_m, at_m = (
            body_m(self.pose(self.bar.handle_height_m + height_m), in_bar_m) for height_m in (self.above_m, 0.0)
        )
        duration_s = max(least_line_s(builder.line_m(above_m), p.limits), builder.least_arm_s(arm_rad, p.arm_limits))
        builder.move_vehicle(above_m, duration_s)
        builder.turn(vehicle_yaw_rad(math.radians(self.bar.yaw_deg), self.end), duration_s)
        builder.move_arm(arm_rad, 0.0, duration_s, p.arm_limits)
        builder.t_s += duration_s
        builder.move_vehicle(at_m, self.lower_s)
        builder.t_s += self.lower_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check vehicle and bar."""
        yield from problems_of(c.vehicle, self.bar)
        if c.vehicle.devices.team is None:
            yield (
                "grips a bar that another vehicle carries, too, but this vehicle flies alone: fly a team file with `companion team fly`"
            )
        room_m = 2.0 * c.vehicle.airframe.radius_m
        apart_m = 2.0 * math.hypot(*body_in_bar_m(manipulator_of(c.vehicle), self.end, self.bar, self.arm_rad())[:2])
        if apart_m < room_m + APART_M:
            yield (
                f"holds a bar of {self.bar.length_m:g} m, at whose ends the vehicles are {apart_m:.2f} m apart, but two rotor circles "
                f"and {APART_M:g} m need {room_m + APART_M:.2f} m; use a longer bar, or an arm pose that reaches further forward"
            )

    def begin(self, air: Air) -> Gripping:
        """Return the state at the start."""
        return Gripping()

    def step(self, air: Air, own: Any) -> Gripping | None:
        """Return the state after one tick; None when both vehicles lift the bar."""
        air.stay(air.engaged)
        s: Gripping = own
        s = self._yielding(air, s) if s.closed_s < math.inf else self._seeing(air, s)
        if s.waits_since_s == math.inf:
            end_m = body_m(
                self.pose(self.bar.handle_height_m),
                body_in_bar_m(air.manipulator, self.end, self.bar, self.arm_rad()),
            )
            left_m = math.dist(air.plan_reference().position_world_m, end_m)
            s = replace(s, over_bar=left_m < OVER_BAR_M, waits_since_s=air.t_s if left_m < ARRIVED_M else math.inf)
        if s.waits_since_s == math.inf:
            return s
        if not s.closes:
            s = replace(s, at_handle_s=self._at_handle_since_s(air, s))
            ready = not air.holds and air.t_s - s.at_handle_s >= SETTLE_S
            s = replace(s, closes=ready and self._is_near(air, s) and is_at(air.i, air.vehicle.jaws, ClampCommand.OPEN))
        elif s.closed_s == math.inf and is_empty(air.i, air.vehicle.jaws):
            air.report(GRIPPED_NOTHING, f"the jaws have closed beside the {self.end} handle; trying again beside it")
            s = replace(s, closes=False, misses=s.misses + 1, at_handle_s=math.inf, stopped_s=math.inf)
        elif s.closed_s == math.inf:
            stops = is_at(air.i, air.vehicle.jaws, ClampCommand.CLOSE)
            s = replace(s, stopped_s=min(s.stopped_s, air.t_s) if stops else math.inf)
        if s.closed_s == math.inf and air.t_s - s.stopped_s >= STOPPED_S:
            s = replace(s, closed_s=air.t_s)
            air.report(GRIPPED, f"the {self.end} end of the bar is gripped")
        if (lift_s := self._lift_server_s(air, s)) is not None:
            s = replace(s, lift_server_s=lift_s)
            if server_s(air.i) >= lift_s:
                return None
        if air.t_s - s.waits_since_s > self.wait_max_s and not air.holds:
            air.report(NOT_GRIPPED, f"after {self.wait_max_s:g} s {self._missing(s)}; landing")
        return s

    def reference(self, reference: Reference, own: Any) -> Reference:
        """Return the reference with its offset."""
        s: Gripping = own
        return replace(reference, position_world_m=plus(reference.position_world_m, s.offset_m))

    def leave(self, own: Any, t_s: float) -> Gripping:
        """Return the state in which the vehicle waits; a lift that was agreed is cancelled."""
        s: Gripping = own
        return replace(s, lift_server_s=None)

    def expects(self, own: Any) -> Expectation:
        """Return the clamp's command and what the other vehicle must know."""
        s: Gripping = own
        return Expectation(
            clamp=ClampCommand.CLOSE if s.closes else ClampCommand.OPEN,
            grip=Grip.READY if s.closed_s < math.inf else Grip.FREE,
            together=Together(go_server_s=s.lift_server_s if self.end == "left" else None),
            bar=self.held() if s.closes else None,
            back_m=self._back_m() if s.over_bar else None,
        )

    def _back_m(self) -> Vec3:
        return turned_about_z((-BACK_M, 0.0, RISE_M), vehicle_yaw_rad(math.radians(self.bar.yaw_deg), self.end))

    def held(self) -> HeldBar:
        """Return what a landing must know of the bar."""
        stands_m = self.bar.handle_height_m
        return HeldBar(stands_m=stands_m, let_go_m=stands_m + self.let_go_height_m)

    def _at_handle_since_s(self, air: Air, s: Gripping) -> float:
        return math.inf if math.hypot(*s.beside_m) > self.tolerance_m else min(s.at_handle_s, air.t_s)

    def _is_near(self, air: Air, s: Gripping) -> bool:
        tip = air.tip_world_m()
        return tip is not None and math.dist(tip, self._seen_m(s)) <= self.tolerance_m

    def _seen_m(self, s: Gripping) -> Vec3:
        """Return where the handle is, or is searched after the jaws have missed it."""
        yaw_rad = vehicle_yaw_rad(math.radians(self.bar.yaw_deg), self.end)
        beside = turned_about_z(SEARCH_M[s.misses % len(SEARCH_M)], yaw_rad)
        return plus(plus(self._handle_m(), s.handle_m), beside)

    def _half(self) -> Vec3:
        return (sign_of(self.end) * 0.5 * self.bar.length_m, 0.0, 0.0)

    def _handle_m(self) -> Vec3:
        return body_m(self.pose(self.bar.handle_height_m), self._half())

    def _seeing(self, air: Air, s: Gripping) -> Gripping:
        """Return the state whose reference leads to the handle that motion capture sees."""
        bar, tip, share = air.i.bar, air.tip_world_m(), air.dt_s / SEE_S
        if bar is not None and bar.tracking_valid and air.t_s - bar.stamp_s <= SEEN_S:
            at = plus(bar.position_world_m, quat_rotate(bar.attitude_wxyz, self._half()))
            s = replace(s, handle_m=toward(s.handle_m, minus(at, self._handle_m()), share))
        if s.waits_since_s == math.inf:
            offset = toward(s.offset_m, s.handle_m, share)
        elif tip is None:
            return s
        else:
            beside = minus(tip, self._seen_m(s))
            s = replace(s, beside_m=beside if s.beside_m[0] == math.inf else toward(s.beside_m, beside, share))
            offset = minus(s.offset_m, scaled(s.beside_m, air.dt_s / LEAD_S))
        return s if math.hypot(*offset) > BESIDE_MAX_M else replace(s, offset_m=offset)

    def _yielding(self, air: Air, s: Gripping) -> Gripping:
        """Return the state whose reference moves to where the standing bar holds the vehicle, so that the two do not pull at it."""
        x, y, z = air.o.position_error_m
        off = plus(s.offset_m, scaled((x, y, z), air.dt_s / YIELD_S))
        return s if math.hypot(*off) > BESIDE_MAX_M else replace(s, offset_m=off)

    def _lift_server_s(self, air: Air, s: Gripping) -> float | None:
        """Return when the bar is lifted, as the left member has set it; None while one of the two is not ready."""
        partner = air.i.partner
        fresh = partner is not None and air.t_s - partner.stamp_s <= PARTNER_FRESH_S
        if partner is None or not fresh or air.holds or s.closed_s == math.inf:
            return None
        if partner.said.grip is Grip.CARRYING:  # it holds in the air, if a hold here has cancelled the lift: follow it
            return server_s(air.i) if s.lift_server_s is None else s.lift_server_s
        if partner.said.holds:
            return None
        if self.end == "right":
            return partner.said.together.go_server_s or s.lift_server_s
        now_s = server_s(air.i)
        if s.lift_server_s is None and partner.said.grip is Grip.READY and math.isfinite(now_s):
            return now_s + LIFT_AFTER_S
        return s.lift_server_s

    def _missing(self, s: Gripping) -> str:
        if not s.closes:
            return "the clamp was not at the handle"
        return "the clamp has not closed" if s.closed_s == math.inf else "the other vehicle was not ready"


ARRIVED_M: Final = 1e-3
"""Distance of the plan from its end from which the clamp is at the handle."""
SEEN_S: Final = 0.2
"""Age up to which a pose of the bar counts."""
SEE_S: Final = 0.5
"""Time constant of the low-passes of what is seen."""
LEAD_S: Final = 5.0
"""Time constant with which the clamp is led to the handle: slower than the integral action of the control laws."""
YIELD_S: Final = 1.0
"""Time constant with which the reference of a gripping vehicle moves to where it is."""
BESIDE_MAX_M: Final = 0.1
"""Largest offset; a bar further from its place in the mission is not gripped."""
OVER_BAR_M: Final = 0.4
"""Distance from the handle below which the rotors may be above the bar."""
STOPPED_S: Final = 0.3
"""Time for which the handle must stop the jaws."""
SEARCH_M: Final[Sequence[Vec3]] = (
    (0.0, 0.0, 0.0), (0.04, 0.0, 0.0), (-0.04, 0.0, 0.0), (0.0, 0.04, 0.0), (0.0, -0.04, 0.0)
)  # fmt: skip
"""Places beside the handle, forward and left of the vehicle, at which it is searched one after the other."""
APART_M: Final = 0.3
"""Least distance between the rotor circles of the two vehicles."""


def is_empty(i: Inputs, jaws: Jaws | None) -> bool:
    """Return whether the jaws have closed further than a handle between them allows."""
    if jaws is None or i.clamp is None:
        return False
    beyond_deg = (math.degrees(i.clamp.angle_rad) - jaws.closed_deg) * math.copysign(
        1.0, jaws.closed_deg - jaws.open_deg
    )
    return beyond_deg > JAWS_TOLERANCE_DEG


def toward(value: Vec3, goal: Vec3, share: float) -> Vec3:
    """Return the value after a step of a low-pass."""
    return plus(value, scaled(minus(goal, value), share))


def is_at(i: Inputs, jaws: Jaws | None, command: ClampCommand) -> bool:
    """Return whether the clamp's servo is where a command sends it."""
    if jaws is None or i.clamp is None:
        return False
    wanted_deg = jaws.open_deg if command is ClampCommand.OPEN else jaws.closed_deg
    return abs(math.degrees(i.clamp.angle_rad) - wanted_deg) <= JAWS_TOLERANCE_DEG


def server_s(i: Inputs) -> float:
    """Return the exposure of the newest frame on the motion-capture server's clock, which both vehicles share; without a pose, -inf."""
    return -math.inf if i.mocap is None or i.mocap.exposure_server_s is None else i.mocap.exposure_server_s
