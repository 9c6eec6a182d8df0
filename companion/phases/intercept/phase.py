"""Phase `intercept`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec.structs import replace
from pydantic import Field

from companion.config.base import NonNegative, Positive3
from companion.config.phase import Duration
from companion.control.arm_model import manipulator_of
from companion.mission.air import Air, Expectation
from companion.mission.phase import Checking, Phase, Planning
from companion.model.markers import BallState
from companion.model.outputs import ChaseState
from companion.model.types import Reference, SafetyAction, Severity, Vec3
from companion.phases.intercept import ball
from companion.phases.intercept.ball import Candidate, Point
from companion.phases.intercept.choice import chosen, enough_m, now_s, push_of, reach, room_of_plan_m
from companion.phases.intercept.meeting import FROZEN_S, RISES_S, Plan, meetings
from companion.phases.intercept.motion import Bounds, State, motion_to
from companion.phases.intercept.net import beside_m, net_m, opening
from companion.phases.intercept.state import PUSHED, Interception, Mode
from companion.safety.governor import SafeSet
from companion.safety.notices import EventDefinition

ASTRAY_M: Final = 0.3
"""Distance from the planned meeting point beyond which a ball is another one."""
UNSURE_S: Final = 0.45
"""Time to the meeting above which a chase is not given up for the rotors: later frames show more, and a dodge does not need more."""
AMISS: Final = 0.5
"""Share of the net's deviation from the assumed response that is expected to be left at the meeting."""
REST_S: Final = 1.0
"""Time at rest after a meeting, before the way back."""
BACK_M_S: Final = 0.3
"""Largest speed of the way back."""
FLOOR_M: Final = 0.1
"""Smallest height of the net above the floor in the box."""
TRACKING_M: Final = 0.1
"""Distance from the limits of room and tether in the box."""
_NOMINAL: Final = SafetyAction.NOMINAL
BALL_SEEN = EventDefinition("ball_seen", Severity.INFO, _NOMINAL, "a marker falls freely: it is a ball in flight")
MEETING_PLANNED = EventDefinition(
    "meeting_planned",
    Severity.INFO,
    _NOMINAL,
    "the vehicle moves to meet a ball; the text gives the time and the distance",
)
BALL_OUT_OF_REACH = EventDefinition(
    "ball_out_of_reach", Severity.INFO, _NOMINAL,
    "a ball has passed that could not be met within the box and the limits; the text gives its distance from the net",
)  # fmt: skip
BALL_LOST = EventDefinition(
    "ball_lost",
    Severity.INFO,
    _NOMINAL,
    "a ball that was to be met is not seen any more, or does not fall: the vehicle stops",
)
NO_BALL = EventDefinition("no_ball", Severity.INFO, _NOMINAL, "no ball came within `wait_max_s`: the plan goes on")


class Intercept(Phase):
    """Wait at rest for a ball, fly to where the net meets it, stop, and come back."""

    acts: ClassVar[bool] = True

    type: Literal["intercept"]
    wait_max_s: Duration
    """Longest time at rest before a ball is met. After it, the mission goes on."""
    box_m: Positive3
    """Half sizes of the box, about the position of the body's origin at the start, that the reference does not leave."""
    drag_per_m: Annotated[NonNegative, Field(le=0.2)] = 0.01
    """Drag of the ball: deceleration divided by the square of the speed, air density times drag coefficient times cross-section over
    twice the mass. With a drag coefficient of 0.5 (a sphere, Achenbach 1972) it is 0.006 for 0.2 kg and 7 cm, and 0.018 for a tennis
    ball."""

    @property
    def description(self) -> str:
        """What the phase does, for a phase without a name."""
        return "intercept a ball"

    def plan(self, p: Planning) -> None:
        """Append the longest time of waiting."""
        p.builder.t_s += self.wait_max_s

    def problems(self, c: Checking) -> Iterator[str]:
        """Check the net and the room for the box."""
        vehicle, home = c.vehicle, c.begin
        if not vehicle.has_net:
            yield f"intercepts a ball, but vehicle '{vehicle.name}' has no net; add tool to the vehicle file"
            return
        if vehicle.devices.mocap.ball is None:
            yield f"follows a ball, but vehicle '{vehicle.name}' does not see one; add devices.mocap.ball to the vehicle file"
        manipulator, safe = manipulator_of(vehicle), SafeSet(vehicle)
        if (up := opening(manipulator, home)[2]) < 0.5:
            yield f"waits with the net's opening {math.degrees(math.acos(up)):.0f} deg from upwards (limit 60 deg); unfold the arm"
        low_m = home.position_world_m[2] - self.box_m[2] + net_m(manipulator, home)[2] - vehicle.tip_radius_m
        if low_m < FLOOR_M:
            yield f"may bring the net {low_m:.2f} m above the floor (minimum {FLOOR_M:g} m); lower box_m[2] or wait higher"
        for corner in product((-1.0, 1.0), repeat=3):
            px, py, pz = (p + s * b for p, s, b in zip(home.position_world_m, corner, self.box_m, strict=True))
            beyond_m = max(safe.breach_walls_m((px, py, pz)), safe.breach_tether_m((px, py, pz))) + TRACKING_M
            if beyond_m > 0.0:
                yield (
                    f"may move to ({px:.2f}, {py:.2f}, {pz:.2f}) m, {beyond_m:.2f} m beyond what room and tether allow with a margin "
                    f"of {TRACKING_M:g} m; lower box_m or wait elsewhere"
                )
                return

    def begin(self, air: Air) -> Interception:
        """Return the state at the start."""
        home = air.plan_reference()
        return Interception(
            mode=Mode.WAIT,
            begun_s=air.t_s,
            home=home,
            now=State(home.position_world_m, home.velocity_world_m_s, home.acceleration_world_m_s2),
        )

    def step(self, air: Air, own: Any) -> Interception | None:
        """Return the state after one tick; None when the vehicle is back, or no ball has come."""
        air.stay(air.engaged)
        s: Interception = own
        frame = air.i.markers
        new = frame is not None and frame.frame_number != s.frame_number
        if frame is not None and new:
            s = replace(
                s, candidates=ball.followed(s.candidates, frame, self.drag_per_m), frame_number=frame.frame_number
            )
        elif s.candidates and air.t_s - s.candidates[0].t_s > ball.BALL_COAST_S:
            s = replace(s, candidates=())
        if s.motion is not None:
            now = s.motion.at(air.t_s)
            s = replace(s, now=now, lag=s.lag.after(air.dt_s, now.acceleration_m_s2))
        if s.mode is Mode.WAIT:
            return self._waited(air, s, new)
        if s.mode in PUSHED:
            s = self._pushed(air, self._chased(air, s, new) if s.mode is Mode.CHASE else self._dodged(air, s, new))
            if s.mode in PUSHED:
                return s
        if s.motion is None:
            motion = s.braking or self._bounds(air, s).stop(air.t_s - air.dt_s, s.now)
            now = motion.at(air.t_s)
            return replace(s, motion=motion, braking=None, now=now, lag=s.lag.after(air.dt_s, now.acceleration_m_s2))
        if new and air.nominal:
            s = self._watched(air, s)
        if s.motion is None:  # it dodges
            return self._pushed(air, s)
        if s.mode is Mode.STOP and air.t_s >= s.motion.end_s + REST_S and not air.holds:
            away_m = math.dist(s.now.position_m, s.home.position_world_m)
            back_s = max(1.0, 1.875 * away_m / BACK_M_S)
            back = motion_to(air.t_s, s.now, back_s, s.home.position_world_m)
            return replace(s, mode=Mode.RETURN, motion=back)
        if s.mode is Mode.RETURN and air.t_s >= s.motion.end_s:
            return None
        return s

    def leave(self, own: Any, t_s: float) -> Interception | None:
        """Return the state that stops a chase or the way back; None while waiting."""
        s: Interception = own
        if s.mode is Mode.WAIT:
            return None
        return s if s.mode is Mode.STOP else replace(s, mode=Mode.STOP, motion=None)

    def reference(self, reference: Reference, own: Any) -> Reference:
        """Return the reference of the state."""
        s: Interception = own
        if s.mode is Mode.WAIT:
            return reference
        return replace(
            reference,
            position_world_m=s.now.position_m,
            velocity_world_m_s=s.now.velocity_m_s,
            acceleration_world_m_s2=s.now.acceleration_m_s2,
            jerk_world_m_s3=s.now.jerk_m_s3,
        )

    def expects(self, own: Any) -> Expectation:
        """Return the ball that is seen, and the way to the one that is met or was met last."""
        s: Interception = own
        return Expectation(ball=self._seen(s), chase=s.chase)

    def _seen(self, s: Interception) -> BallState | None:
        """Return the ball that is seen: while one is chased, the one that comes nearest to the meeting."""
        balls = [candidate for candidate in s.candidates if candidate.is_ball]
        met = s.plan.point if s.plan is not None and s.mode is Mode.CHASE else None
        if met is None or not balls:
            return BallState(position_world_m=balls[0].position_m) if balls else None
        at_m, end_s = met.position_m, met.t_s
        chased = balls[0] if len(balls) == 1 else min(balls, key=lambda c: self._astray_m(c, met))
        return BallState(position_world_m=chased.position_m, meeting_world_m=at_m, meeting_s=end_s, sigma_m=met.sigma_m)

    def _waited(self, air: Air, s: Interception, new: bool) -> Interception | None:
        if air.t_s - s.begun_s >= self.wait_max_s:
            if not s.seen:
                air.report(NO_BALL, f"no ball within {self.wait_max_s:g} s; the plan goes on")
            return None
        s = replace(s, beside_m=beside_m(air, s.home, s.beside_m))
        balls = [candidate for candidate in s.candidates if candidate.is_ball]
        if not balls:
            if s.passing_m is not None and not s.at_rotors:
                air.report(
                    BALL_OUT_OF_REACH, f"a ball passes {s.passing_m:.2f} m from the waiting net; it cannot be met"
                )
            return s if s.passing_m is None else replace(s, passing_m=None, at_rotors=False)
        if not new or not air.nominal or not air.o.airborne:
            return s
        net = self._net(air, s)
        for candidate in balls:
            path = self._path(air, s, candidate)
            if s.passing_m is None:
                x, y, z = candidate.position_m
                air.report(BALL_SEEN, f"a ball flies at ({x:.2f}, {y:.2f}, {z:.2f}) m")
            s = replace(
                s,
                seen=True,
                passing_m=min(
                    math.inf if s.passing_m is None else s.passing_m,
                    *[math.dist(at_m, net) for at_m in (candidate.position_m, *[point.position_m for point in path])],
                ),
            )
            if (plan := self._meeting(air, s, path, None)) is not None:
                left_s, away_m = plan.point.t_s - air.t_s, math.dist(plan.point.position_m, net)
                air.report(MEETING_PLANNED, f"meets the ball in {left_s:.2f} s, {away_m:.2f} m from the waiting net")
                return self._pushed(air, _planned(replace(s, mode=Mode.CHASE), plan, left_s))
            s = self._pushed(air, chosen(air, s, self._bounds(air, s), path))
            if s.mode is not Mode.WAIT:
                return s
        return s

    def _chased(self, air: Air, s: Interception, new: bool) -> Interception:
        """Return the state with the plan that the newest frame gives."""
        assert s.plan is not None
        point = s.plan.point
        if air.t_s >= point.t_s:
            return replace(s, mode=Mode.STOP)
        if not air.nominal:
            air.report(BALL_LOST, "a rule has warned: no ball is met any more; stopping")
            return replace(s, mode=Mode.STOP)
        balls, left_s = [c for c in s.candidates if c.is_ball], point.t_s - air.t_s
        if balls and (not new or left_s < FROZEN_S):
            return s
        at_m, number = min([(self._astray_m(c, point), n) for n, c in enumerate(balls)], default=(math.inf, 0))
        if at_m > ASTRAY_M:
            air.report(BALL_LOST, "the ball that was to be met is lost; stopping")
            return replace(s, mode=Mode.STOP)
        path = self._path(air, s, balls[number])
        plan = self._meeting(air, s, path, point.t_s) or self._meeting(air, s, path, None)
        if plan is not None:
            return _planned(s, plan, plan.point.t_s - air.t_s)
        return s if left_s > UNSURE_S else chosen(air, s, self._bounds(air, s), path)

    def _dodged(self, air: Air, s: Interception, new: bool) -> Interception:
        """Return the state of a dodge with what the newest frame shows."""
        assert s.dodge is not None
        if air.t_s >= s.dodge.until_s or not air.nominal:
            return replace(s, mode=Mode.STOP)
        return self._watched(air, s) if new else s

    def _watched(self, air: Air, s: Interception) -> Interception:
        """Return the state of a vehicle that does not chase, after it has looked for balls that come to the rotors."""
        for candidate in s.candidates:
            if candidate.is_ball:
                s = chosen(air, s, self._bounds(air, s), self._path(air, s, candidate))
        return s

    def _pushed(self, air: Air, s: Interception) -> Interception:
        """Return the state of a chase or a dodge after this tick."""
        if s.mode not in PUSHED:
            return s
        bounds = self._bounds(air, s)
        # A dodge is pushed as it was judged: without the lags.
        lag = s.lag if s.mode is Mode.CHASE else None
        now = bounds.pushed(air.t_s, s.now, air.dt_s, push_of(air, s)(air.t_s), lag)
        if now is not None:
            s = replace(s, now=now, braking=None)
        else:  # one stop is followed: one that is planned again in every tick goes too far
            braking = s.braking or bounds.stop(air.t_s - air.dt_s, s.now)
            now = braking.at(air.t_s)
            s = replace(s, now=now, braking=braking)
        return replace(s, lag=s.lag.after(air.dt_s, now.acceleration_m_s2))

    def _astray_m(self, candidate: Candidate, met: Point) -> float:
        """Return the distance from a meeting point at which a ball passes at that time."""
        return math.dist(ball.predicted(candidate, met.t_s, self.drag_per_m).position_m, met.position_m)

    def _path(self, air: Air, s: Interception, candidate: Candidate) -> list[Point]:
        floor_m = self._net(air, s)[2] - self.box_m[2]
        return ball.path(candidate, air.t_s + ball.HORIZON_S, floor_m, self.drag_per_m)

    def _net(self, air: Air, s: Interception) -> Vec3:
        """Return the waiting net's centre, world frame."""
        (x, y, z), (bx, by, bz), (px, py, pz) = net_m(air.manipulator, s.home), s.beside_m, s.home.position_world_m
        return (px + x + bx, py + y + by, pz + z + bz)

    def _bounds(self, air: Air, s: Interception) -> Bounds:
        return Bounds(air.vehicle, air.limits, air.safe, s.home.position_world_m, self.box_m)

    def _meeting(self, air: Air, s: Interception, path: list[Point], kept_s: float | None) -> Plan | None:
        (x, y, z), (bx, by, bz) = net_m(air.manipulator, s.home), s.beside_m
        tip, (px, py, pz), (u, v, w) = (
            air.tip_world_m(),
            s.now.position_m,
            s.lag.net_m(reach(air, s).drop_m, (x, y)),
        )
        if tip is not None and s.mode is Mode.CHASE:
            bx += AMISS * (tip[0] - px - x - bx - u)
            by += AMISS * (tip[1] - py - y - by - v)
            bz += AMISS * (tip[2] - pz - z - bz - w + RISES_S * s.now.velocity_m_s[2])
        net, bounds = (x + bx, y + by, z + bz), self._bounds(air, s)
        plans = meetings(
            now_s(air, s),
            s.now,
            s.lag,
            path,
            net,
            opening(air.manipulator, s.home),
            bounds,
            reach(air, s),
            kept_s,
        )
        return next((plan for plan in plans if room_of_plan_m(air, s, bounds, path, plan) >= enough_m(s)), None)


def _planned(s: Interception, plan: Plan, left_s: float) -> Interception:
    """Return the state with a plan that is new or replaces the one before."""
    speed_m_s, before = math.dist(plan.point.velocity_m_s, s.now.velocity_m_s), s.chase
    predicted_s, replans = (left_s, 0) if before is None else (before.predicted_s, before.replans + 1)
    chase = ChaseState(predicted_s=predicted_s, replans=replans, relative_speed_m_s=speed_m_s)
    return replace(s, plan=plan, chase=chase)
