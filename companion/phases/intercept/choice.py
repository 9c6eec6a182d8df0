"""The choice of a vehicle to whose rotors a ball comes: go on, stop, or move aside. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Final

from msgspec.structs import replace

from companion.mission.air import Air
from companion.model.types import SafetyAction, Severity, Vec3
from companion.phases.intercept.ball import HORIZON_S, Point
from companion.phases.intercept.meeting import Plan, Reach, reach_of
from companion.phases.intercept.motion import Bounds, Motion
from companion.phases.intercept.net import net_m
from companion.phases.intercept.rotors import clearance_m, places_body_m
from companion.phases.intercept.state import PUSHED, Dodge, Interception, Mode
from companion.safety.notices import EventDefinition

BALL_M: Final = 0.05
"""Distance of its centre from the rotor disks at which a ball passes them; it may be this large."""
CHASED_M: Final = 0.04
"""The same for a ball that is chased: what a newer frame shows differs by about a centimetre, and a ball is 35 mm in radius."""
DODGE_STEP_S, DODGE_STEPS = 0.06, 6
"""Steps in which it is looked what the limits leave of a dodge."""
JUDGED_S: Final = 0.04
"""Time between two choices of what to do about a ball that comes to the rotors."""
BETTER_M: Final = 0.005
"""Room at the rotors by which a dodge must be better than what the vehicle would do else."""

BALL_AT_ROTORS = EventDefinition(
    "ball_at_rotors",
    Severity.WARNING,
    SafetyAction.NOMINAL,
    "a ball comes to the rotor disks: the vehicle does what leaves it the most room",
)
_REST: list[Vec3] = [(0.0, 0.0, 0.0)]


def chosen(air: Air, s: Interception, bounds: Bounds, path: list[Point]) -> Interception:
    """Return the state that leaves a ball the most room at the rotors: this one, a stop, or a dodge."""
    if s.mode is Mode.CHASE and s.plan is not None:
        kept_m = room_of_plan_m(air, s, bounds, path, s.plan)
    else:
        kept_m = room_m(air, s, path, push_of(air, s))
    if kept_m >= enough_m(s) or not path or air.t_s - s.judged_s < JUDGED_S:
        return s
    s = replace(s, judged_s=air.t_s)
    stop_m = room_of_stop_m(air, s, bounds, path)
    rooms = []
    for push in _aside(bounds, path):
        steps = bounds.pushes(air.t_s, s.now, partial(_stepped, air.t_s, [push]), DODGE_STEP_S, DODGE_STEPS)
        rooms.append((room_m(air, s, path, partial(_stepped, air.t_s, steps)), push))
    aside_m, push = max(rooms)
    dodges = aside_m > max(kept_m, stop_m) + BETTER_M
    if not s.at_rotors:
        does = "moves aside" if dodges else "stops" if stop_m > kept_m else "stays"
        air.report(
            BALL_AT_ROTORS, f"a ball comes within {max(0.0, kept_m):.2f} m of the rotor disks; the vehicle {does}"
        )
        s = replace(s, at_rotors=True)
    if dodges:
        body_m = s.now.position_m
        nearest = min(path, key=lambda point: math.dist(point.position_m, body_m))
        return replace(s, mode=Mode.DODGE, motion=None, dodge=Dodge(push, nearest.t_s))
    return replace(s, mode=Mode.STOP) if stop_m > kept_m and s.mode in PUSHED else s


def enough_m(s: Interception) -> float:
    """Return the distance from the rotors that a ball must keep."""
    return CHASED_M if s.mode is Mode.CHASE else BALL_M


def push_of(air: Air, s: Interception) -> Callable[[float], Vec3]:
    """Return the acceleration of the reference at a time, if the vehicle goes on as it does."""
    if s.mode is Mode.CHASE and s.plan is not None:
        return partial(s.plan.push_m_s2, drop_m=reach(air, s).drop_m)
    if s.mode is Mode.DODGE and s.dodge is not None:
        return partial(_stepped, air.t_s, [s.dodge.push_m_s2])
    return partial(_stepped, air.t_s, _REST) if s.motion is None else partial(_acceleration_m_s2, s.motion)


def room_of_plan_m(air: Air, s: Interception, bounds: Bounds, path: list[Point], plan: Plan) -> float:
    """Return the smallest distance of a ball from the rotors before it is met as planned."""
    wanted = partial(plan.push_m_s2, drop_m=reach(air, s).drop_m)
    count = max(1, math.ceil((plan.point.t_s - air.t_s) / DODGE_STEP_S))
    steps = bounds.pushes(air.t_s, s.now, wanted, DODGE_STEP_S, count)
    before = [point for point in path if point.t_s <= plan.point.t_s]
    return room_m(air, s, before, partial(_stepped, air.t_s, steps))


def room_of_stop_m(air: Air, s: Interception, bounds: Bounds, path: list[Point]) -> float:
    """Return the smallest distance of a ball from the rotors if the vehicle stops."""
    return room_m(air, s, path, partial(_acceleration_m_s2, bounds.stop(now_s(air, s), s.now)))


def room_m(air: Air, s: Interception, path: list[Point], push: Callable[[float], Vec3]) -> float:
    """Return the smallest distance of a ball from the rotors of a vehicle whose reference accelerates like this."""
    places = places_body_m(air.i.vehicle, s.home.yaw_rad, now_s(air, s), s.now, s.lag, path, push)
    return clearance_m(air.vehicle.airframe, places)


def now_s(air: Air, s: Interception) -> float:
    """Return the time of the reference's motion: if it is pushed, that of the last tick until this one has pushed it."""
    return air.t_s - air.dt_s if s.mode in PUSHED else air.t_s


def reach(air: Air, s: Interception) -> Reach:
    """Return how far the net comes."""
    return reach_of(-net_m(air.manipulator, s.home)[2], HORIZON_S)


def _aside(bounds: Bounds, path: list[Point]) -> list[Vec3]:
    """Return the accelerations of the dodges that are tried: to both sides of the ball's way, along it and against it, up and down."""
    x, y, _ = path[0].velocity_m_s
    most = bounds.acceleration_m_s2 / max(1e-6, math.hypot(x, y))
    x, y, up = most * x, most * y, bounds.acceleration_m_s2
    tried = [(-y, x, 0.0), (y, -x, 0.0), (x, y, 0.0), (-x, -y, 0.0), (0.0, 0.0, up), (0.0, 0.0, -up)]
    return [bounds.within(push) for push in tried]


def _stepped(begin_s: float, steps_m_s2: list[Vec3], t_s: float) -> Vec3:
    """Return the acceleration of a time in steps of `DODGE_STEP_S`; the last one lasts."""
    return steps_m_s2[max(0, min(len(steps_m_s2) - 1, int((t_s - begin_s) / DODGE_STEP_S)))]


def _acceleration_m_s2(motion: Motion, t_s: float) -> Vec3:
    return motion.at(t_s).acceleration_m_s2
