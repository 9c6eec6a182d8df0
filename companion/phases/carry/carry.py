"""Phase `carry`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec.structs import replace
from pydantic import Field

from companion.config.base import Model, Positive, Vector2
from companion.config.phase import Duration, PhaseSettings
from companion.control.arm_model import manipulator_of
from companion.mission.air import Air, Expectation, HeldBar
from companion.mission.minsnap import least_line_s
from companion.mission.phase import Phase, Planning
from companion.mission.reference import minimum_snap, rest_to_rest
from companion.model.algebra import dot, minus, plus, scaled
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import wrap_rad
from companion.model.team import CarryState, ClampCommand, Grip, TeamState, Together
from companion.model.types import Reference, SafetyAction, Severity, Vec3
from companion.phases.carry.bar import BarPose, body_in_bar_m, body_m, sign_of, turned_about_z, vehicle_yaw_rad
from companion.phases.carry.grip import LIFT_AFTER_S, PARTNER_FRESH_S, GripHandle, server_s
from companion.safety.notices import EventDefinition

FORCE_FILTER_S: Final = 0.1
"""Time constant of the low-pass of the measured force."""
LIFTED_M: Final = 0.05
"""Height of the lift from which the bar must be felt."""
WEIGHT_MIN_N: Final = 0.4
"""Least weight of an end of a bar: twice the resolution of the sensor."""
LIGHT_S: Final = 1.0
BAR_LOST = EventDefinition(
    "bar_lost", Severity.CRITICAL, SafetyAction.LAND,
    "the weight of the lifted bar is not felt: the jaws have closed beside the handle, or it has slipped out of them",
)  # fmt: skip
GOES_ON = EventDefinition(
    "goes_on", Severity.INFO, SafetyAction.NOMINAL, "both vehicles of a team continue after a hold, at one instant"
)
APART_MAX_S: Final = 0.5
"""Longest time by which the two may be apart in their plans after a hold to continue; a hold stops them some 0.04 s apart."""
STAND_S: Final = 0.5
"""Time at the end of the way after which the bar stands."""
SET_DOWN_M: Final = 0.03
"""Depth by which the handles are led below the height at which the bar stands, so that it does stand."""
WAIT_MAX_S: Final = 5.0
"""Longest wait for the other vehicle at the end of the way."""
TURNING_REACH_M: Final = 0.5
"""Distance of a vehicle from the handle, from which the time of a turn is computed: the same for both, whatever their arms are."""
PIECE_RAD: Final = math.radians(6.0)
"""Turn of the bar in one polynomial piece of a vehicle's path, which it then leaves by less than a micrometre."""


class Waypoint(Model):
    """A place to which the bar is carried."""

    position_m: Vector2
    """Middle of the bar, world frame."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    """Yaw of the bar there, turned to in the shorter direction; if it is absent, the bar keeps its yaw."""
    duration_s: Duration | None = None
    """Duration. If it is absent, the shortest duration that the limits allow at both ends of the bar is used."""


class Compliance(Model):
    """The target impedance along the bar: mass, damping and stiffness between the force that the bar exerts on the clamp and the
    deviation of the vehicle from its path.
    """

    mass_kg: Positive = 4.0
    damping_ns_m: Positive = 25.0
    stiffness_n_m: Positive = 10.0
    tension_n: float = 0.0
    """Wanted tension of the bar (F_d); negative to compress it."""
    offset_max_m: Positive = 0.1
    """Largest deviation."""


class Carrying(Record, frozen=True, kw_only=True):
    """State of the phase."""

    bar: HeldBar
    weight_n: float = 0.0
    """Measured downward force of the bar on the clamp, low-passed."""
    tension_n: float = 0.0
    felt: bool = True
    """Whether the force is known. If it is not, the bar's weight is not judged, and the vehicle returns to its path and keeps to it."""
    offset_m: float = 0.0
    rate_m_s: float = 0.0
    acceleration_m_s2: float = 0.0
    along_world: Vec3
    """Unit vector along the bar, towards the other vehicle."""
    pose: tuple[float, float, float, float]
    """Planned centre of the bar, m, and its yaw, rad."""
    begun_s: float
    begun_offset_m: Vec3
    """Offset of the reference at the start, which vanishes during the lift: the vehicle was where the standing bar held it."""
    arrived_s: float = math.inf
    """Flight clock at the end of the way."""
    stands: bool = False
    share: float = 1.0
    """Fraction of `begun_offset_m` that is left."""
    light_s: float = math.inf
    """Flight clock since which the lifted bar weighs too little; infinite while it does not."""
    together: Together = Together()
    """When both go on after a hold."""


class Carry(Phase):
    """Lift the bar together with the other vehicle, carry it from place to place, and set it down at the last."""

    acts: ClassVar[bool] = True

    type: Literal["carry"]
    lift_m: Annotated[float, Field(ge=0.05, le=2.0)]
    """Height to which the bar is lifted above the height at which it stands."""
    lift_s: Duration = 3.0
    """Duration of the lift, and of setting down."""
    waypoints: Annotated[tuple[Waypoint, ...], Field(min_length=1, max_length=50)]
    compliance: Compliance | None = Compliance()
    """null: the vehicle keeps to its path as stiffly as its law does."""

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return "carry the bar"

    def order_problem(self, before: PhaseSettings | None) -> str | None:
        """Return why this phase cannot follow another one."""
        if before is None or before.type != "grip":
            return "the bar must be gripped directly before (type: grip)"
        return None

    def unfinished(self, after: PhaseSettings) -> str | None:
        """Return what must come between this phase and `after`."""
        return None if after.type == "release" else "a bar that is carried must be released next (type: release)"

    def legs(self, grip: GripHandle, p: Planning) -> list[tuple[BarPose, BarPose, float]]:
        """Return the straight moves of the bar from rest to rest: pose before, pose after, and duration."""
        height_m = grip.bar.handle_height_m
        at, legs = grip.pose(height_m), []
        lifted = grip.pose(height_m + self.lift_m)
        legs.append((at, lifted, self.lift_s))
        at = lifted
        for waypoint in self.waypoints:
            turn_rad = 0.0 if waypoint.yaw_deg is None else wrap_rad(math.radians(waypoint.yaw_deg) - at.yaw_rad)
            to = BarPose((*waypoint.position_m, lifted.centre_m[2]), at.yaw_rad + turn_rad)
            reach_m = 0.5 * grip.bar.length_m + TURNING_REACH_M
            way_m = math.dist(at.centre_m, to.centre_m) + reach_m * abs(turn_rad)
            legs.append((at, to, waypoint.duration_s or least_line_s(way_m, p.limits)))
            at = to
        legs.append((at, BarPose((*at.centre_m[:2], height_m - SET_DOWN_M), at.yaw_rad), self.lift_s))
        return legs

    def plan(self, p: Planning) -> None:
        """Append the motion of this vehicle: its end of the bar moves as the bar does, exact in velocity and acceleration."""
        grip = grip_of(p.earlier)
        in_bar_m = body_in_bar_m(manipulator_of(p.vehicle), grip.end, grip.bar, grip.arm_rad())
        for before, after, duration_s in self.legs(grip, p):
            if before.yaw_rad == after.yaw_rad:
                p.builder.move_vehicle(body_m(after, in_bar_m), duration_s)
            else:
                count = max(4, math.ceil(abs(after.yaw_rad - before.yaw_rad) / PIECE_RAD))
                knots_s = [duration_s * n / count for n in range(count + 1)]
                p.builder.pieces(knots_s, [_turning(before, after, in_bar_m, t_s, duration_s) for t_s in knots_s])
                # As the bar turns: a turn by 180 deg has no shorter direction.
                p.builder.turn_by(after.yaw_rad - before.yaw_rad, duration_s)
            p.builder.t_s += duration_s

    def begin(self, air: Air) -> Carrying:
        """Return the state at the start."""
        pose, along = self._bar(air)
        held = grip_of(air.phases[: air.engaged.index]).held()
        before, plan = air.o.reference, air.plan_reference()
        offset = (0.0, 0.0, 0.0) if before is None else minus(before.position_world_m, plan.position_world_m)
        return Carrying(pose=pose, along_world=along, bar=held, begun_s=air.t_s, begun_offset_m=offset)

    def step(self, air: Air, own: Any) -> Carrying | None:
        """Return the state after one tick; None when the bar stands and the other vehicle says so, too."""
        air.stay(air.engaged)
        s: Carrying = self._going_on(air, own)
        pose, along = self._bar(air)
        left = 1.0 - rest_to_rest(min(1.0, (air.t_s - s.begun_s) / self.lift_s))[0]
        s = self._yielding(air, replace(s, pose=pose, along_world=along, share=left))
        lifted = pose[2] > s.bar.stands_m + LIFTED_M
        light = lifted and s.felt and s.weight_n < WEIGHT_MIN_N
        s = replace(s, light_s=min(s.light_s, air.t_s) if light else math.inf)
        if air.t_s - s.light_s > LIGHT_S:
            air.report(
                BAR_LOST, f"the bar weighs {max(0.0, s.weight_n):.1f} N at this end (minimum {WEIGHT_MIN_N:g} N)"
            )
        if s.arrived_s == math.inf:
            grip = grip_of(air.phases[: air.engaged.index])
            if pose[2] - (grip.bar.handle_height_m - SET_DOWN_M) < _AT_END_M and self._last_place(pose):
                s = replace(s, arrived_s=air.t_s)
            return s
        waited_s = air.t_s - s.arrived_s
        s = replace(s, stands=waited_s >= STAND_S)
        return None if s.stands and (_stands_there(air) or waited_s >= WAIT_MAX_S) else s

    def reference(self, reference: Reference, own: Any) -> Reference:
        """Return the reference with the deviation along the bar."""
        s: Carrying = own
        if s.share > 0.0:
            moved = plus(reference.position_world_m, scaled(s.begun_offset_m, s.share))
            reference = replace(reference, position_world_m=moved)
        (px, py, pz), (vx, vy, vz), (ax, ay, az) = (
            reference.position_world_m,
            reference.velocity_world_m_s,
            reference.acceleration_world_m_s2,
        )
        (ux, uy, uz), x, dx, ddx = s.along_world, s.offset_m, s.rate_m_s, s.acceleration_m_s2
        return replace(
            reference,
            position_world_m=(px + x * ux, py + x * uy, pz + x * uz),
            velocity_world_m_s=(vx + dx * ux, vy + dx * uy, vz + dx * uz),
            acceleration_world_m_s2=(ax + ddx * ux, ay + ddx * uy, az + ddx * uz),
        )

    def expects(self, own: Any) -> Expectation:
        """Return the state of the bar."""
        s: Carrying = own
        x, y, z, yaw_rad = s.pose
        return Expectation(
            clamp=ClampCommand.CLOSE,
            grip=Grip.STANDING if s.stands else Grip.CARRYING,
            bar=s.bar,
            together=s.together,
            carry=CarryState(
                tension_n=s.tension_n if s.felt else None,
                weight_n=s.weight_n if s.felt else None,
                offset_m=s.offset_m,
                rate_m_s=s.rate_m_s,
                centre_world_m=(x, y, z),
                yaw_rad=yaw_rad,
            ),
        )

    def _going_on(self, air: Air, s: Carrying) -> Carrying:
        """Return the state with what the other vehicle must know of a hold; end the hold at the instant that the left one sets."""
        said, now_s, plan_s = _fresh(air), server_s(air.i), air.plan_s()
        # A vehicle that cannot continue, or that the other has left behind, says so by not waiting: the other then holds.
        waits = air.waits and math.isfinite(now_s) and said is not None and said.holds
        waits = waits and said is not None and abs(said.together.plan_s - plan_s) <= APART_MAX_S
        together = Together(plan_s=plan_s, waits=waits)
        if said is None or not (waits and said.together.waits):
            return replace(s, together=together)
        left = grip_of(air.phases[: air.engaged.index]).end == "left"
        go_s = s.together.go_server_s if left else said.together.go_server_s
        if left and go_s is None:
            go_s = now_s + LIFT_AFTER_S
        if go_s is None or now_s < go_s:
            return replace(s, together=replace(together, go_server_s=go_s))
        before_m = air.plan_reference().position_world_m
        if not left:
            air.move_to(air.engaged.start_s + said.together.plan_s)
        moved_m = minus(before_m, air.plan_reference().position_world_m)
        air.resume(GOES_ON, "both vehicles continue")
        return replace(
            s,
            together=Together(plan_s=air.plan_s()),
            begun_s=air.t_s,
            begun_offset_m=plus(scaled(s.begun_offset_m, s.share), moved_m),
        )

    def _yielding(self, air: Air, s: Carrying) -> Carrying:
        """Return the state whose reference yields to the force along the bar."""
        force, dt_s, c = air.o.force_world_n, air.dt_s, self.compliance
        s = replace(s, felt=force is not None)
        if force is not None:
            share = dt_s / (dt_s + FORCE_FILTER_S)
            weight_n = s.weight_n + share * (-force[2] - s.weight_n)
            r = air.o.reference
            inertial_n = 0.0 if r is None else weight_n / GRAVITY_M_S2 * dot(r.acceleration_world_m_s2, s.along_world)
            tension_n = s.tension_n + share * (dot(force, s.along_world) + inertial_n - s.tension_n)
            s = replace(s, weight_n=weight_n, tension_n=tension_n)
        if c is None:
            return s
        push_n = (
            (s.tension_n - c.tension_n if s.felt else 0.0) - c.damping_ns_m * s.rate_m_s - c.stiffness_n_m * s.offset_m
        )
        acceleration = push_n / c.mass_kg
        rate = s.rate_m_s + dt_s * acceleration
        offset = s.offset_m + dt_s * rate
        if abs(offset) > c.offset_max_m:
            return replace(s, offset_m=math.copysign(c.offset_max_m, offset), rate_m_s=0.0, acceleration_m_s2=0.0)
        return replace(s, offset_m=offset, rate_m_s=rate, acceleration_m_s2=acceleration)

    def _bar(self, air: Air) -> tuple[tuple[float, float, float, float], Vec3]:
        """Return the planned pose of the bar and the unit vector along it, towards the other vehicle, from this vehicle's plan."""
        grip, r = grip_of(air.phases[: air.engaged.index]), air.plan_reference()
        yaw_rad = r.yaw_rad - vehicle_yaw_rad(0.0, grip.end)
        x, y, z = turned_about_z(body_in_bar_m(air.manipulator, grip.end, grip.bar, grip.arm_rad()), yaw_rad)
        px, py, pz = r.position_world_m
        side = -sign_of(grip.end)
        return (px - x, py - y, pz - z, yaw_rad), (side * math.cos(yaw_rad), side * math.sin(yaw_rad), 0.0)

    def _last_place(self, pose: tuple[float, float, float, float]) -> bool:
        return math.dist(pose[:2], self.waypoints[-1].position_m) < _AT_END_M


_AT_END_M: Final = 1e-3


def grip_of(phases: Sequence[Any]) -> GripHandle:
    """Return the newest phase of type `grip`, which the order of the phases guarantees."""
    return next(phase for phase in reversed(phases) if isinstance(phase, GripHandle))


def _fresh(air: Air) -> TeamState | None:
    """Return the other vehicle's newest announcement; None if it is old."""
    partner = air.i.partner
    return None if partner is None or air.t_s - partner.stamp_s > PARTNER_FRESH_S else partner.said


def _stands_there(air: Air) -> bool:
    said = _fresh(air)
    return said is not None and said.grip in (Grip.STANDING, Grip.FREE)


def _turning(
    before: BarPose, after: BarPose, in_bar_m: Vec3, t_s: float, duration_s: float
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Return position, velocity, acceleration and jerk of a point of the bar that moves straight, with minimum snap, and turns."""
    T = duration_s
    f, f1, f2, f3 = minimum_snap(t_s / T)
    g, g1, g2, g3 = rest_to_rest(t_s / T)
    turn = after.yaw_rad - before.yaw_rad
    w, dw, ddw = turn * g1 / T, turn * g2 / T**2, turn * g3 / T**3
    x, y, z = turned_about_z(in_bar_m, before.yaw_rad + turn * g)
    (cx, cy, cz), (ex, ey, ez) = before.centre_m, after.centre_m
    dx, dy, dz = ex - cx, ey - cy, ez - cz
    # With J the quarter turn: v = w J r, a = dw J r - w^2 r, j = (ddw - w^3) J r - 3 w dw r.
    return (
        (cx + f * dx + x, cy + f * dy + y, cz + f * dz + z),
        (f1 * dx / T - w * y, f1 * dy / T + w * x, f1 * dz / T),
        (f2 * dx / T**2 - dw * y - w * w * x, f2 * dy / T**2 + dw * x - w * w * y, f2 * dz / T**2),
        (
            f3 * dx / T**3 - (ddw - w**3) * y - 3.0 * w * dw * x,
            f3 * dy / T**3 + (ddw - w**3) * x - 3.0 * w * dw * y,
            f3 * dz / T**3,
        ),
    )
