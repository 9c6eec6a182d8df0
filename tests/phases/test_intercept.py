"""Interception of a ball: which marker is one, where it goes, and that no plan to meet it leaves a limit."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from companion.config.loader import load_flight
from companion.control.arm_model import manipulator_of
from companion.io.mocap.markers import marker_frame
from companion.mission.air import Air, Observation
from companion.mission.check import check_mission
from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.mission.segments import Segment
from companion.model.constants import GRAVITY_M_S2, TICK_PERIOD_S
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.markers import MarkerFrame
from companion.model.types import Inputs, OperatorCommand, Reference, Vec3, VehicleState
from companion.phases.intercept import ball, choice, phase
from companion.phases.intercept.ball import Candidate
from companion.phases.intercept.lag import BODY_S2, TILT_S2_M, Lag
from companion.phases.intercept.meeting import APART_S, RISES_S, TRIED_MAX, meetings, reach_of
from companion.phases.intercept.motion import OVERSHOOT, Bounds, State
from companion.phases.intercept.net import net_m, opening
from companion.phases.intercept.phase import Intercept
from companion.phases.intercept.rotors import clearance_m, places_body_m
from companion.phases.intercept.state import Dodge, Interception, Mode
from companion.safety.governor import SafeSet
from companion.safety.notices import EventDefinition
from companion.safety.stop import StopModel

CONFIG = load_flight("configs/missions/intercept.yaml")
PLAN = Plan.build(CONFIG.mission, CONFIG.vehicle)
PHASES = phases_of(CONFIG.mission)
PHASE = next(each for each in PHASES if isinstance(each, Intercept))
SEGMENT = next(segment for segment in PLAN.segments if PHASES[segment.index] is PHASE)
HOME = PLAN.reference(SEGMENT.start_s)
MANIPULATOR, SAFE, LIMITS = manipulator_of(CONFIG.vehicle), SafeSet(CONFIG.vehicle), CONFIG.mission.limits
NET_M = net_m(MANIPULATOR, HOME)
NET_WORLD_M: Vec3 = tuple(a + b for a, b in zip(HOME.position_world_m, NET_M, strict=True))  # type: ignore[assignment]
OPENING = opening(MANIPULATOR, HOME)
BOUNDS = Bounds(CONFIG.vehicle, LIMITS, SAFE, HOME.position_world_m, PHASE.box_m)
REACH = reach_of(-NET_M[2], 1.5)
DRAG_PER_M = PHASE.drag_per_m
NOISE_M = 0.001
Where = Callable[[float], Vec3 | None]


def flight(to_m: Vec3, arrival_m_s: Vec3, arrival_s: float, drag_per_m: float = DRAG_PER_M) -> Where:
    """The path of a ball that arrives at a point with a velocity, integrated backwards in steps of 0.5 ms."""
    h, path = -0.0005, [to_m]
    p, v = list(to_m), list(arrival_m_s)
    while arrival_s + h * (len(path) - 1) > 0.0:
        speed = math.hypot(*v)
        a = [-drag_per_m * speed * x for x in v]
        a[2] -= GRAVITY_M_S2
        p = [x + h * (u + 0.5 * h * w) for x, u, w in zip(p, v, a, strict=True)]
        v = [u + h * w for u, w in zip(v, a, strict=True)]
        path.append((p[0], p[1], p[2]))

    def where(t_s: float) -> Vec3 | None:
        number = round((arrival_s - t_s) / -h)
        return path[number] if 0 <= number < len(path) else None

    return where


def frames(
    places: Sequence[Where], until_s: float, seed: int = 1, lost: Callable[[float], bool] = lambda t_s: False
) -> Iterator[MarkerFrame]:
    """Frames at 200 Hz in which the markers come in any order, with noise, and 3 % of them are not seen."""
    draw = random.Random(seed)
    for number in range(round(until_s * 200.0)):
        t_s = number * TICK_PERIOD_S
        seen = [where(t_s) for where in places]
        markers = [
            (x + draw.gauss(0.0, NOISE_M), y + draw.gauss(0.0, NOISE_M), z + draw.gauss(0.0, NOISE_M))
            for x, y, z in (at for at in seen if at is not None)
            if draw.random() > 0.03 and not lost(t_s)
        ]
        draw.shuffle(markers)
        yield marker_frame(t_s + 0.004, 0.004, number, markers, HOME.position_world_m)


def followed(seen: Iterator[MarkerFrame]) -> Iterator[tuple[float, tuple[Candidate, ...]]]:
    candidates: tuple[Candidate, ...] = ()
    for frame in seen:
        candidates = ball.followed(candidates, frame, DRAG_PER_M)
        yield frame.exposed_s, candidates


def still(at_m: Vec3) -> Where:
    return lambda t_s: at_m


def flickering(draw: random.Random, lasts_s: float = 0.02, begins_s: float = 0.0) -> Where:
    """A reflection that is seen again and again, each time at another place."""
    places = [(draw.uniform(-2.0, 2.0), draw.uniform(-2.0, 2.0), draw.uniform(0.0, 2.0)) for _ in range(100)]

    def where(t_s: float) -> Vec3 | None:
        number = int((t_s + begins_s) / lasts_s)
        return places[number // 2] if number % 2 else None

    return where


def swung(t_s: float) -> Vec3:
    """A marker wand on a vertical circle of 0.4 m, one turn per second."""
    angle = 2.0 * math.pi * t_s
    return (1.0 + 0.4 * math.cos(angle), 0.3, 1.0 + 0.4 * math.sin(angle))


THROWN = flight(NET_WORLD_M, (-3.0, 0.3, -2.0), 0.6)


@pytest.mark.parametrize(
    "others",
    [
        [still((1.8, -1.5, 0.05)), flickering(random.Random(3)), flickering(random.Random(4))],
        [flickering(random.Random(number), 0.05 + 0.005 * number, 0.01 * number) for number in range(40)],
    ],
    ids=["few", "many"],
)
def test_a_ball_is_found_among_reflections_within_0_12_s_and_nothing_else_is_one(others: list[Where]) -> None:
    found: dict[str, float] = {}
    for t_s, candidates in followed(frames([THROWN, *others], 0.55)):
        for candidate in candidates:
            if candidate.is_ball:
                at = THROWN(t_s)
                assert at is not None
                assert math.dist(candidate.position_m, at) < 0.02, "a reflection is taken for a ball"
                found.setdefault("first_s", t_s)
    assert found["first_s"] < 0.12


def test_a_marker_that_does_not_fall_is_no_ball() -> None:
    for where in (still((0.5, 0.2, 0.7)), swung, lambda t_s: (2.0 - 2.0 * t_s, 0.1, 0.8)):
        frames_of_a_ball = [
            t_s for t_s, cs in followed(frames([where], 4.0 if where is swung else 0.9)) if any(c.is_ball for c in cs)
        ]
        assert frames_of_a_ball == []


@pytest.mark.parametrize(("before_s", "limit_m"), [(0.1, 0.01), (0.2, 0.02), (0.3, 0.04)])
@pytest.mark.parametrize("drag_per_m", [0.0, 0.006, 0.018])
def test_the_arrival_is_predicted_although_the_drag_is_not_known(
    before_s: float, limit_m: float, drag_per_m: float
) -> None:
    errors_m = []
    for seed in range(10):
        where = flight(NET_WORLD_M, (-3.0, 0.3, -2.0), 0.6, drag_per_m)
        for t_s, candidates in followed(frames([where], 0.6 - before_s, seed)):
            last = (t_s, candidates)
        (thrown,) = [candidate for candidate in last[1] if candidate.is_ball]
        point = ball.predicted(thrown, 0.6, DRAG_PER_M)
        errors_m.append(math.dist(point.position_m, NET_WORLD_M))
        assert errors_m[-1] < 6.0 * point.sigma_m, "the covariance promises more"
    assert sorted(errors_m)[8] < limit_m


def test_a_ball_is_found_again_after_50_ms_without_frames() -> None:
    is_lost = lambda t_s: 0.2 <= t_s < 0.25  # noqa: E731
    seen = {t_s: any(c.is_ball for c in cs) for t_s, cs in followed(frames([THROWN], 0.5, lost=is_lost))}
    assert all(ball_is_seen for t_s, ball_is_seen in seen.items() if t_s > 0.12)


@pytest.mark.parametrize(
    ("aside_m", "height_m", "sinks"), [(0.2, 0.75, False), (0.35, 0.42, False), (0.42, 0.41, True)]
)
def test_the_net_is_where_the_plan_wants_it_if_body_and_tilt_follow_as_assumed_and_sinks_only_if_it_must(
    aside_m: float, height_m: float, sinks: bool
) -> None:
    arrival_s, ahead_m, dt_s = 0.6, 0.2, 0.001
    now, lag, reach = State((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), Lag(), reach_of(0.35, 1.5)
    point = ball.Point(arrival_s, (ahead_m + 0.05, -aside_m, height_m), (-3.0, 0.0, -3.0), 0.01)
    for start_s in (0.0, 0.3):  # replanned once, in motion
        (plan,) = meetings(start_s, now, lag, [point], (ahead_m, 0.0, -0.35), OPENING, BOUNDS, reach, None)
        for k in range(300):
            (ax, ay, az), (vx, vy, vz), (x, y, z) = (
                plan.push_m_s2(start_s + (k + 0.5) * dt_s, reach.drop_m),
                now.velocity_m_s,
                now.position_m,
            )
            vx, vy, vz = vx + dt_s * ax, vy + dt_s * ay, vz + dt_s * az
            now = State((x + dt_s * vx, y + dt_s * vy, z + dt_s * vz), (vx, vy, vz), (ax, ay, az))
            lag = lag.after(dt_s, (ax, ay, az))
    (x, y, z), tilt = now.position_m, [_weighed(TILT_S2_M, values) for values in (lag.x_m_s2, lag.y_m_s2)]
    net_m = (
        x + _weighed(BODY_S2, lag.x_m_s2) - reach.drop_m * tilt[0] + ahead_m,
        y + _weighed(BODY_S2, lag.y_m_s2) - reach.drop_m * tilt[1],
        z - RISES_S * now.velocity_m_s[2] - ahead_m * tilt[0] - 0.35,
    )
    assert math.dist(net_m, point.position_m) < 0.01
    assert (now.velocity_m_s[2] < -0.01) == sinks


def _weighed(weights: Sequence[float], values: Sequence[float]) -> float:
    return sum(weight * value for weight, value in zip(weights, values, strict=True))


def throws(count: int, seed: int) -> Iterator[tuple[list[ball.Point], Where, float]]:
    """Predicted paths of random throws: around the net, from all sides, 0.2 to 0.7 s before their arrival."""
    draw = random.Random(seed)
    for _ in range(count):
        azimuth, speed = draw.uniform(-math.pi, math.pi), draw.uniform(0.5, 4.5)
        arrival: Vec3 = (-speed * math.cos(azimuth), -speed * math.sin(azimuth), -draw.uniform(0.3, 3.0))
        x, y, z = NET_WORLD_M
        to_m = (x + draw.gauss(0.0, 0.12), y + draw.gauss(0.0, 0.12), z + draw.gauss(0.0, 0.12))
        left_s = draw.uniform(0.2, 0.7)
        where = flight(to_m, arrival, left_s)
        start, after = where(0.0), where(0.001)
        assert start is not None and after is not None
        velocity = tuple((b - a) / 0.001 for a, b in zip(start, after, strict=True))
        begun = replace(ball.begun(0.0, start), velocity_m_s=velocity, vv=1e-6, bb=1.0, falls=ball.FALLS_FRAMES)
        yield ball.path(begun, 1.5, 0.1, DRAG_PER_M), where, left_s


def test_the_way_to_none_of_200_balls_and_the_stop_after_it_leave_a_limit() -> None:
    stops, draw, found, held = StopModel(CONFIG.vehicle.safety), random.Random(5), 0, 0
    airframe, reach = CONFIG.vehicle.airframe, REACH
    most_m_s2 = LIMITS.thrust_share_max * airframe.thrust_max_n / (airframe.mass_kg + airframe.payload_max_kg)
    rest = now = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for path, _, _ in throws(200, 6):
        plan = next(meetings(0.0, now, Lag(), path, NET_M, OPENING, BOUNDS, reach, None), None)
        if plan is None:
            now = rest
            continue
        found += 1
        states, end_s = [now], draw.uniform(0.1, 1.0) * plan.point.t_s
        for tick in range(round(end_s / TICK_PERIOD_S)):
            t_s = tick * TICK_PERIOD_S
            after = BOUNDS.pushed(t_s, now, TICK_PERIOD_S, plan.push_m_s2(t_s, reach.drop_m))
            if after is None:
                held += 1
                break
            now = after
            states.append(now)
        stop = BOUNDS.stop(0.0, now)
        states += [stop.at(stop.duration_s * k / 50) for k in range(51)]
        for s in states:
            (ax, ay, az), speed = s.acceleration_m_s2, math.hypot(*s.velocity_m_s)
            assert speed <= LIMITS.speed_max_m_s and math.hypot(ax, ay, az) <= LIMITS.acceleration_max_m_s2
            assert math.hypot(*s.jerk_m_s3) <= LIMITS.jerk_max_m_s3
            assert math.degrees(math.atan2(math.hypot(ax, ay), az + GRAVITY_M_S2)) <= airframe.tilt_max_deg
            assert math.hypot(ax, ay, az + GRAVITY_M_S2) <= most_m_s2
            assert all(
                abs(p - h) <= b for p, h, b in zip(s.position_m, HOME.position_world_m, PHASE.box_m, strict=True)
            )
            ahead_s = OVERSHOOT * stops.time_s(OVERSHOOT * speed)
            place = tuple(p + ahead_s * v for p, v in zip(s.position_m, s.velocity_m_s, strict=True))
            assert SAFE.holds(s.position_m) and SAFE.holds((place[0], place[1], place[2]))
        assert math.hypot(*stop.at(stop.end_s).velocity_m_s) < 1e-9, "at rest after the stop"
    assert found > 50, "too few balls are met to judge"
    assert held < found / 4, "most ways end at a limit"


def test_the_reference_is_pushed_as_wanted_until_it_must_brake() -> None:
    now, wanted = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), (0.0, 6.2, 0.0)
    for tick in range(20):
        pushed = BOUNDS.pushed(tick * TICK_PERIOD_S, now, TICK_PERIOD_S, wanted)
        assert pushed is not None
        now = pushed
        assert tick < 10 or math.dist(now.acceleration_m_s2, wanted) < 0.05, f"eased after {tick} ticks"


@pytest.mark.parametrize("wanted", [(6.0, 0.0, 0.0), (0.0, 6.0, 0.0), (3.0, -5.0, 1.0), (-4.0, -4.0, -2.0)], ids=str)
def test_the_body_that_lags_behind_a_push_could_always_stop_in_the_room(wanted: Vec3) -> None:
    now, lag, stop = (
        State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        Lag(),
        StopModel(CONFIG.vehicle.safety),
    )
    nearest_m, braking = math.inf, None
    for tick in range(300):
        t_s = tick * TICK_PERIOD_S
        pushed = BOUNDS.pushed(t_s, now, TICK_PERIOD_S, wanted, lag)
        if pushed is None:
            braking = braking or BOUNDS.stop(t_s, now)
            now = braking.at(t_s + TICK_PERIOD_S)
        else:
            now, braking = pushed, None
        lag = lag.after(TICK_PERIOD_S, now.acceleration_m_s2)
        velocity = np.add(now.velocity_m_s, (*lag.body_m_s(now.acceleration_m_s2), 0.0))
        at_m = np.add(now.position_m, (*lag.body_m(), 0.0)) + velocity * stop.time_s(float(np.linalg.norm(velocity)))
        place = (float(at_m[0]), float(at_m[1]), float(at_m[2]))
        out_m = max(SAFE.breach_walls_m(place), SAFE.breach_tether_m(place))
        assert out_m < CONFIG.vehicle.safety.geofence_tolerance_m, f"after {t_s:.2f} s"
        nearest_m = min(nearest_m, -out_m)
    assert nearest_m < 0.1, "it never comes near a limit"


class Tick(Air):
    """A tick of the phase that records what it reports."""

    def __init__(
        self,
        t_s: float,
        frame: MarkerFrame | None,
        nominal: bool,
        reports: list[tuple[str, str]],
        *,
        holds: bool = False,
    ) -> None:
        i = Inputs(tick=round(t_s * 200), t_s=t_s, command=OperatorCommand.NONE, recorder_dropped=0, markers=frame)
        o = Observation(
            inputs=i, airborne=True, armed_by_others=False, standing=None, reference=HOME, tether=None, thrust_share=1.0,
            pose_s=t_s, dt_s=TICK_PERIOD_S, force_world_n=None, disturbance_world_n=None, position_error_m=(0.0, 0.0, 0.0),
            yaw_error_rad=0.0,
        )  # fmt: skip
        super().__init__(o, CONFIG.vehicle, MANIPULATOR, PHASES, SEGMENT, SEGMENT, LIMITS, SAFE, nominal, holds)
        self._reports = reports

    def plan_reference(self) -> Reference:
        return HOME

    def report(self, notice: EventDefinition, text: str) -> None:
        self._reports.append((notice.id, text))

    def stay(self, segment: Segment) -> None:
        pass


class Flown:
    """What the phase did with some frames."""

    def __init__(
        self,
        seen: Iterator[MarkerFrame],
        until_s: float,
        *,
        nominal: bool = True,
        hold_s: float = math.inf,
        resume_s: float = math.inf,
        warn_s: float = math.inf,
    ) -> None:
        self.reports: list[tuple[str, str]] = []
        self.states: list[Interception] = []
        self.references: list[Reference] = []
        waiting = {frame.frame_number + 1: frame for frame in seen}
        frame: MarkerFrame | None = None
        was_held = False
        state: Any = PHASE.begin(Tick(0.0, None, nominal, self.reports))
        for number in range(1, round(until_s * 200.0)):
            frame = waiting.get(number, frame)
            t_s = number * TICK_PERIOD_S
            holds = hold_s <= t_s < resume_s
            if holds and not was_held:
                state = PHASE.leave(state, t_s)
            was_held = holds
            tick = Tick(t_s, frame, nominal and t_s < warn_s, self.reports, holds=holds)
            state = None if state is None else PHASE.step(tick, state)
            if state is None:
                break
            self.states.append(state)
            self.references.append(PHASE.reference(HOME, state))
        self.over = state is None
        self.ids = [name for name, _ in self.reports]
        self.farthest_m = max(math.dist(r.position_world_m, HOME.position_world_m) for r in self.references)


def beside(right_m: float, up_m: float) -> Vec3:
    x, y, z = NET_WORLD_M
    return (x, y + right_m, z + up_m)


MEETABLE = flight(beside(0.0, 0.08), (-3.0, 0.0, -1.5), 0.6)


def test_the_vehicle_meets_a_ball_comes_to_rest_and_returns() -> None:
    flown = Flown(frames([MEETABLE], 0.6), 12.0)
    assert flown.ids == ["ball_seen", "meeting_planned"] and flown.over
    assert {state.mode for state in flown.states} == set(Mode) - {Mode.DODGE}
    at_meeting = next(s for s in flown.states if s.mode is Mode.STOP)
    assert (
        at_meeting.now.position_m[2] > HOME.position_world_m[2] + 0.05
        and at_meeting.chase is not None
        and at_meeting.chase.replans > 0
    )
    assert math.dist(flown.references[-1].position_world_m, HOME.position_world_m) < 1e-3
    steps_m = [
        math.dist(a.position_world_m, b.position_world_m)
        for a, b in zip(flown.references, flown.references[1:], strict=False)
    ]
    assert max(steps_m) <= LIMITS.speed_max_m_s * TICK_PERIOD_S * 1.01, "the reference jumps"
    turns = [
        math.dist(a.velocity_world_m_s, b.velocity_world_m_s) / TICK_PERIOD_S
        for a, b in zip(flown.references, flown.references[1:], strict=False)
    ]
    assert max(turns) <= LIMITS.acceleration_max_m_s2 * 1.01, "the reference's velocity jumps"


@pytest.mark.parametrize(
    "places",
    [
        [still((0.6, 0.1, 0.8)), flickering(random.Random(3)), flickering(random.Random(8))],
        [swung, lambda t_s: (swung(t_s)[0], 0.35, swung(t_s)[2] + 0.3)],
        [],
    ],
    ids=["reflections", "wand", "nothing"],
)
def test_without_a_ball_the_vehicle_stays_and_goes_on_with_one_event(places: list[Where]) -> None:
    flown = Flown(frames(places, 4.0), PHASE.wait_max_s + 1.0)
    assert flown.ids == ["no_ball"] and flown.over and flown.farthest_m == 0.0


def test_a_ball_out_of_reach_is_not_chased_and_one_event_tells_how_far() -> None:
    flown = Flown(frames([flight(beside(0.9, 0.0), (-3.0, 0.0, -2.0), 0.6)], 0.7), 2.0)
    assert flown.ids == ["ball_seen", "ball_out_of_reach"] and flown.farthest_m == 0.0
    assert 0.7 < float(flown.reports[1][1].split()[3]) < 1.0


def test_a_second_ball_is_never_chased() -> None:
    other = flight(beside(-0.12, 0.08), (-3.0, 0.0, -1.5), 0.6)
    both = Flown(frames([MEETABLE, other], 0.6), 6.0)
    assert both.ids.count("meeting_planned") == 1
    aside_m = [state.plan.point.position_m[1] for state in both.states if state.plan is not None]
    assert max(aside_m) - min(aside_m) < 0.06, "the vehicle turns to the other ball"


@pytest.mark.parametrize("aside_m", [(0.2, 0.2), (0.3, -0.2)], ids=str)
def test_a_vehicle_that_waits_moves_aside_for_a_ball_that_comes_to_its_rotors_and_comes_back(
    aside_m: tuple[float, float],
) -> None:
    x, y, z = HOME.position_world_m
    thrown = flight((x + aside_m[0], y + aside_m[1], z - 0.3), (3.0, 0.5, -4.0), 0.6)  # from behind
    flown = Flown(frames([thrown], 0.6), 12.0)
    assert "ball_at_rotors" in flown.ids and Mode.DODGE in {state.mode for state in flown.states} and flown.over
    assert math.dist(flown.references[-1].position_world_m, HOME.position_world_m) < 1e-3
    airframe = CONFIG.vehicle.airframe
    for number, state in enumerate(flown.states, 1):
        at_m = thrown(number * TICK_PERIOD_S)
        if at_m is not None:
            place = in_body_m(state.now, state.lag, at_m)
            for rotor in airframe.rotor_layout.positions_body_m:
                x, y, z = place - rotor
                assert abs(z) >= 0.035 or math.hypot(x, y) - airframe.disk_radius_m >= 0.035, "it strikes a rotor"


@pytest.mark.parametrize("push", [(0.0, 0.0, -6.0), (0.0, 0.0, 6.0), (0.0, 6.0, 0.0), (-4.0, 4.0, -2.0)], ids=str)
def test_a_vehicle_that_moves_aside_for_long_stays_in_its_box(push: Vec3) -> None:
    state = replace(PHASE.begin(Tick(0.0, None, True, [])), mode=Mode.DODGE, dodge=Dodge(push, 1.0))
    farthest = np.zeros(3)
    for number in range(1, 400):
        after = PHASE.step(Tick(number * TICK_PERIOD_S, None, True, []), state)
        assert after is not None
        state = after
        farthest = np.maximum(farthest, np.abs(np.subtract(state.now.position_m, HOME.position_world_m)))
        assert (farthest <= np.add(PHASE.box_m, 1e-6)).all(), f"after {number * TICK_PERIOD_S:.2f} s"
    assert (farthest > 0.8 * np.array(PHASE.box_m)).any(), "it never comes near a side of the box"


def test_no_ball_crosses_the_rotors_of_a_vehicle_that_tilts_and_lags_on_its_way_to_it() -> None:
    air, airframe = Tick(0.0, None, True, []), CONFIG.vehicle.airframe
    state, changed = PHASE.begin(air), 0
    for path, _, _ in throws(150, 6):
        best = next(meetings(0.0, state.now, state.lag, path, NET_M, OPENING, BOUNDS, REACH, None), None)
        plan = PHASE._meeting(air, state, path, None)
        changed += plan != best
        if plan is None:
            continue
        now, lag, at = state.now, Lag(), dict[float, tuple[State, Lag]]()
        for tick in range(round(plan.point.t_s * 200)):
            t_s = tick * TICK_PERIOD_S
            at[round(t_s, 6)] = (now, lag)
            pushed = BOUNDS.pushed(t_s, now, TICK_PERIOD_S, plan.push_m_s2(t_s, REACH.drop_m))
            if pushed is None:
                break
            now, lag = pushed, lag.after(TICK_PERIOD_S, pushed.acceleration_m_s2)
        for point in path:
            if (found := at.get(round(point.t_s, 6))) is not None:
                place = in_body_m(*found, point.position_m)
                for rotor in airframe.rotor_layout.positions_body_m:
                    x, y, z = place - rotor
                    assert abs(z) >= 0.04 or math.hypot(x, y) >= airframe.disk_radius_m
    assert changed > 0, "the rotors forbid no meeting"


def in_body_m(now: State, lag: Lag, at_m: Vec3) -> np.ndarray:
    """The position of a ball in the frame of the body that follows the reference through its lags, as far as they are modelled."""
    x, y, z = now.position_m
    body_m = (x + _weighed(BODY_S2, lag.x_m_s2), y + _weighed(BODY_S2, lag.y_m_s2), z)
    # Thrust and weight give the acceleration.
    up = now.acceleration_m_s2[2] + GRAVITY_M_S2
    lean = [GRAVITY_M_S2 * _weighed(TILT_S2_M, values) / up for values in (lag.x_m_s2, lag.y_m_s2)]
    axis = np.array([-lean[1], lean[0], 0.0])
    angle_rad = math.atan(math.hypot(*lean))
    attitude = Rotation.from_rotvec(axis * angle_rad / max(1e-12, math.hypot(*lean)))
    return np.asarray(attitude.inv().apply(np.subtract(at_m, body_m)))


@pytest.mark.parametrize("push", [(5.0, 3.0, 4.0), (-6.0, 4.0, -5.0)], ids=["rising", "falling"])
def test_a_ball_is_placed_in_the_frame_of_the_body_that_tilts_and_lags(push: Vec3) -> None:
    path = [ball.Point(0.01 * k, (0.3, -0.2, 1.2), (0.0, 0.0, 0.0), 0.0) for k in range(31)]
    rest = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    found = list(places_body_m(None, 0.0, 0.0, rest, Lag(), path, lambda t_s: push))
    now, lag = rest, Lag()
    for point, place in zip(path, found, strict=True):
        if point.t_s > 0.0:
            v = tuple(point.t_s * a for a in push)
            p = tuple(o + 0.5 * point.t_s**2 * a for o, a in zip(rest.position_m, push, strict=True))
            now, lag = State((p[0], p[1], p[2]), (v[0], v[1], v[2]), push), lag.after(0.01, push)
        assert place == pytest.approx(in_body_m(now, lag, point.position_m), abs=0.015)


def measured(beside_m: Vec3, roll_deg: float, pitch_deg: float) -> VehicleState:
    x, y, z = (a + b for a, b in zip(HOME.position_world_m, beside_m, strict=True))
    return VehicleState(
        position_stamp_s=0.0, attitude_stamp_s=0.0, imu_stamp_s=0.0, position_world_m=(x, y, z), velocity_world_m_s=(0.0, 0.0, 0.0),
        attitude_wxyz=quat_from_euler_zyx(math.radians(roll_deg), math.radians(pitch_deg), HOME.yaw_rad),
        angular_rate_body_rad_s=(0.0, 0.0, 0.0), specific_force_body_m_s2=(0.0, 0.0, GRAVITY_M_S2),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("state", "expected_m"),
    [
        (None, 0.1),
        (measured((0.0, 0.0, 0.0), 0.0, 0.0), 0.1),
        (measured((0.0, 0.0, 0.08), 0.0, 0.0), 0.02),
        (measured((-0.13, 0.0, 0.0), 0.0, 0.0), 0.13 + 0.15 - 0.165),
        (measured((0.0, 0.0, 0.0), 0.0, -15.0), 0.0),  # nose up: the front rotors rise by 0.1 m where the ball flies
        (measured((0.0, 0.0, 0.0), 0.0, 15.0), 0.2),
    ],
    ids=["unknown", "level", "higher", "behind", "nose-up", "nose-down"],
)
def test_the_distance_of_a_ball_is_that_from_the_rotors_as_they_were_measured(
    state: VehicleState | None, expected_m: float
) -> None:
    """A ball falls to 0.1 m above the disk of the front left rotor, 0.15 m before its axis, and stays there."""
    airframe = CONFIG.vehicle.airframe
    rotor = max(airframe.rotor_layout.positions_body_m, key=lambda at: at[0] + at[1])
    x, y, z = quat_rotate(quat_from_euler_zyx(0.0, 0.0, HOME.yaw_rad), (rotor[0] + 0.15, rotor[1], rotor[2] + 0.1))
    px, py, pz = HOME.position_world_m
    path = [ball.Point(0.01 * k, (px + x, py + y, pz + z), (0.0, 0.0, 0.0), 0.0) for k in range(3)]
    rest = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    places = places_body_m(state, HOME.yaw_rad, 0.0, rest, Lag(), path, lambda t_s: (0.0, 0.0, 0.0))
    assert clearance_m(airframe, places) == pytest.approx(expected_m, abs=0.015)


@pytest.mark.parametrize(("of_a_stop_m", "stops"), [(0.03, True), (0.01, False)], ids=["stop-better", "stop-worse"])
def test_a_chase_in_which_the_ball_comes_to_the_rotors_stops_unless_the_stop_or_a_dodge_brings_it_nearer(
    of_a_stop_m: float, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def room_of_plan_m(air: Air, s: Interception, *_: Any) -> float:
        return 1.0 if s.mode is Mode.WAIT else 0.02

    monkeypatch.setattr(phase, "room_of_plan_m", room_of_plan_m)
    monkeypatch.setattr(choice, "room_of_plan_m", room_of_plan_m)
    monkeypatch.setattr(choice, "room_of_stop_m", lambda *_: of_a_stop_m)
    monkeypatch.setattr(choice, "room_m", lambda *_: 0.0)
    flown = Flown(frames([MEETABLE], 0.6), 0.5)
    assert "ball_at_rotors" in flown.ids and (flown.states[-1].mode is Mode.STOP) == stops


def test_a_chase_is_not_given_up_for_the_rotors_before_a_dodge_needs_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    def room_of_plan_m(air: Air, s: Interception, *_: Any) -> float:
        return 1.0 if s.mode is Mode.WAIT else 0.02

    monkeypatch.setattr(phase, "room_of_plan_m", room_of_plan_m)
    monkeypatch.setattr(choice, "room_of_plan_m", room_of_plan_m)
    flown = Flown(frames([MEETABLE], 0.6), 0.5)
    left_s = [
        state.plan.point.t_s - number * TICK_PERIOD_S
        for number, state in enumerate(flown.states, 1)
        if state.at_rotors and state.plan is not None
    ]
    assert phase.UNSURE_S - 0.03 < left_s[0] <= phase.UNSURE_S + TICK_PERIOD_S


@pytest.mark.parametrize(("room_m", "goes_on"), [(0.045, True), (0.035, False)])
def test_a_ball_that_is_chased_may_come_a_centimetre_nearer_to_the_rotors_than_one_that_is_not(
    room_m: float, goes_on: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def room_of_plan_m(air: Air, s: Interception, *_: Any) -> float:
        return 0.06 if s.mode is Mode.WAIT else room_m

    monkeypatch.setattr(phase, "room_of_plan_m", room_of_plan_m)
    monkeypatch.setattr(choice, "room_of_plan_m", room_of_plan_m)
    flown = Flown(frames([MEETABLE], 0.6), 0.5)
    assert ("ball_at_rotors" not in flown.ids) is goes_on


def test_a_chase_that_comes_to_a_limit_follows_the_stop_and_goes_on_when_it_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked = Bounds.pushed

    def pushed(bounds: Bounds, t_s: float, *arguments: Any) -> State | None:
        return None if 0.3 <= t_s < 0.32 else asked(bounds, t_s, *arguments)

    monkeypatch.setattr(Bounds, "pushed", pushed)
    flown = Flown(frames([MEETABLE], 0.6), 12.0)
    assert flown.ids == ["ball_seen", "meeting_planned"] and flown.over
    chased = [k for k, state in enumerate(flown.states, 1) if state.mode is Mode.CHASE]
    assert max(chased) * TICK_PERIOD_S > 0.5
    for before, after in itertools.pairwise(flown.references):
        moved = np.subtract(after.position_world_m, before.position_world_m)
        velocity = np.add(before.velocity_world_m_s, after.velocity_world_m_s) / 2
        assert moved == pytest.approx(TICK_PERIOD_S * velocity, abs=5e-5)


def test_frames_lost_for_50_ms_do_not_end_a_chase() -> None:
    flown = Flown(frames([MEETABLE], 0.6, lost=lambda t_s: 0.3 <= t_s < 0.35), 12.0)
    assert flown.ids == ["ball_seen", "meeting_planned"] and flown.over


def test_a_ball_that_leaves_its_path_is_not_chased_any_further() -> None:
    def stopped(t_s: float) -> Vec3 | None:  # caught by another net
        return slow(min(t_s, 0.3))

    slow = flight(beside(0.0, 0.08), (-3.0, 0.0, -1.5), 0.9)

    flown = Flown(frames([stopped], 2.0), 12.0)
    assert flown.ids[:2] == ["ball_seen", "meeting_planned"] and "ball_lost" in flown.ids and flown.over
    assert flown.farthest_m < 0.15


def test_above_nominal_nothing_is_chased() -> None:
    assert Flown(frames([MEETABLE], 0.6), 2.0, nominal=False).farthest_m == 0.0


@pytest.mark.parametrize("hold_s", [0.35, 2.4], ids=["in-the-chase", "on-the-way-back"])
def test_a_hold_brings_the_vehicle_to_rest_where_it_stays_until_it_is_resumed(hold_s: float) -> None:
    free, flown = (
        Flown(frames([MEETABLE], 0.6), 20.0, hold_s=at_s, resume_s=at_s + 6.0) for at_s in (math.inf, hold_s)
    )
    in_hold = flown.references[round((hold_s + 2.0) * 200) : round((hold_s + 6.0) * 200) - 2]
    assert free.states[round(hold_s * 200)].mode is (Mode.CHASE if hold_s < 1.0 else Mode.RETURN)
    assert {reference.position_world_m for reference in in_hold} == {in_hold[0].position_world_m}
    assert math.dist(in_hold[0].position_world_m, HOME.position_world_m) > 0.01
    assert flown.over and math.dist(flown.references[-1].position_world_m, HOME.position_world_m) < 1e-3


@pytest.mark.parametrize(
    ("options", "until_s"),
    [({}, 0.6), ({"hold_s": 0.4}, 0.6), ({"warn_s": 0.4}, 0.6), ({}, 0.35)],
    ids=["met", "held", "warned", "no-frames-any-more"],
)
def test_the_reference_moves_on_when_a_chase_ends(options: dict[str, Any], until_s: float) -> None:
    flown = Flown(frames([MEETABLE], until_s), 1.5, **options)
    for before, after in itertools.pairwise(flown.references):
        moved = np.subtract(after.position_world_m, before.position_world_m)
        velocity = np.add(before.velocity_world_m_s, after.velocity_world_m_s) / 2
        assert moved == pytest.approx(TICK_PERIOD_S * velocity, abs=5e-5)


def test_a_chase_ends_when_no_frame_shows_its_ball_any_more() -> None:
    flown = Flown(frames([MEETABLE], 0.3), 3.0)
    chased_s = [TICK_PERIOD_S * k for k, state in enumerate(flown.states, 1) if state.mode is Mode.CHASE]
    assert "ball_lost" in flown.ids and max(chased_s) < 0.3 + ball.BALL_COAST_S + 0.01


def test_a_warning_ends_a_chase_and_says_why() -> None:
    flown = Flown(frames([MEETABLE], 0.6), 3.0, warn_s=0.4)
    assert flown.reports[-1] == ("ball_lost", "a rule has warned: no ball is met any more; stopping")


def test_the_room_at_the_rotors_is_computed_a_few_times_a_tick_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    looks, asked = [0], choice.room_m

    def counted(*arguments: Any) -> float:
        looks[0] += 1
        asked(*arguments)
        return 0.0

    monkeypatch.setattr(choice, "room_m", counted)
    worst = 0
    state: Any = PHASE.begin(Tick(0.0, None, True, []))
    for frame in frames([MEETABLE], 0.5):
        looks[0] = 0
        state = PHASE.step(Tick(frame.exposed_s + TICK_PERIOD_S, frame, True, []), state)
        worst = max(worst, looks[0])
    assert 1 < worst <= TRIED_MAX + 8, "more than the meetings, what it does now, a stop, and six dodges"


def test_few_meetings_of_a_ball_are_tried_and_they_differ() -> None:
    rest, counts = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), set()
    for path, _, _ in throws(60, 6):
        plans = list(meetings(0.0, rest, Lag(), path, NET_M, OPENING, BOUNDS, REACH, None))
        times_s = sorted(plan.point.t_s for plan in plans)
        assert all(b - a >= APART_S - 1e-9 for a, b in itertools.pairwise(times_s))
        counts.add(len(plans))
    assert max(counts) == TRIED_MAX


def test_an_old_estimate_of_px4_is_moved_on_and_a_very_old_one_is_not_used() -> None:
    rest = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    point = ball.Point(1.0, HOME.position_world_m, (0.0, 0.0, 0.0), 0.0)

    def x_m(age_s: float) -> float:
        moving = replace(
            measured((0.1, 0.0, 0.0), 0.0, 0.0), velocity_world_m_s=(1.0, 0.0, 0.0), position_stamp_s=1.0 - age_s,
            attitude_stamp_s=1.0 - age_s,
        )  # fmt: skip
        (place,) = places_body_m(moving, HOME.yaw_rad, 1.0, rest, Lag(), [point], lambda t_s: (0.0, 0.0, 0.0))
        return -float(quat_rotate(quat_from_euler_zyx(0.0, 0.0, HOME.yaw_rad), place)[0])

    assert [x_m(age_s) for age_s in (0.0, 0.05, 0.15)] == pytest.approx([0.1, 0.15, 0.0], abs=1e-9)


def test_the_rotors_are_turned_as_the_body_was_measured() -> None:
    rest = State(HOME.position_world_m, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    x, y, z = HOME.position_world_m
    point = ball.Point(0.0, (x + 0.2, y, z), (0.0, 0.0, 0.0), 0.0)
    turned = replace(
        measured((0.0, 0.0, 0.0), 0.0, 0.0),
        attitude_wxyz=quat_from_euler_zyx(0.0, 0.0, HOME.yaw_rad + math.radians(30.0)),
    )
    places = [
        next(places_body_m(state, HOME.yaw_rad, 0.0, rest, Lag(), [point], lambda t_s: (0.0, 0.0, 0.0)))
        for state in (None, turned)
    ]
    angles = [math.atan2(place[1], place[0]) for place in places]
    assert angles[1] - angles[0] == pytest.approx(math.radians(-30.0))


def test_the_same_inputs_give_the_same_states() -> None:
    places = [MEETABLE, flickering(random.Random(3)), swung]
    first, second = (Flown(frames(places, 0.8), 6.0) for _ in range(2))
    assert first.states == second.states and first.reports == second.reports


def test_the_displays_are_told_the_ball_and_where_it_meets_the_net() -> None:
    flown = Flown(frames([MEETABLE], 0.6), 12.0)
    seen = [(state, PHASE.expects(state).ball) for state in flown.states]
    chases = [(state, ball) for state, ball in seen if ball is not None and ball.meeting_world_m is not None]
    assert chases and {state.mode for state, _ in chases} == {Mode.CHASE}
    last, at_end = chases[-1]
    assert last.plan is not None and at_end.meeting_s == last.plan.point.t_s
    assert math.dist(at_end.position_world_m, last.plan.point.position_m) < 0.1, "it is nearly there"
    assert seen[0][1] is None and seen[-1][1] is None


def test_without_sight_of_the_ball_with_a_box_beyond_the_tether_or_a_closed_net_the_mission_is_refused() -> None:
    def found(*overrides: str) -> str:
        config = load_flight("configs/missions/intercept.yaml", overrides=overrides)
        return " ".join(check_mission(config.mission, config.vehicle))

    assert found() == ""
    assert "does not see one; add devices.mocap.ball" in found("vehicle.devices.mocap.ball=null")
    assert "beyond what room and tether allow" in found("mission.phases[3].box_m=[0.5, 1.2, 0.35]")
    assert "above the floor" in found("mission.phases[3].box_m=[0.5, 0.5, 0.7]")
    assert "from upwards (limit 60 deg)" in found("mission.phases[2].arm_deg=[160.0, 20.0]")


def test_the_vehicle_of_the_mission_differs_only_by_the_sight_of_the_ball_and_the_tilt() -> None:
    config = load_flight("configs/missions/catch.yaml")
    mocap = config.vehicle.devices.mocap.model_copy(update={"ball": CONFIG.vehicle.devices.mocap.ball})
    devices = config.vehicle.devices.model_copy(update={"mocap": mocap})
    airframe = config.vehicle.airframe.model_copy(update={"tilt_max_deg": CONFIG.vehicle.airframe.tilt_max_deg})
    changes = {"devices": devices, "airframe": airframe, "name": CONFIG.vehicle.name}
    assert config.vehicle.model_copy(update=changes) == CONFIG.vehicle
