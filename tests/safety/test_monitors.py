"""What comes and goes, what is missing or held up, and the links, oscillations and limits that the monitors watch."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest

from companion.model.types import Event, Inputs, OperatorCommand, SafetyAction
from companion.safety.arm import ForceTracker, error_text
from companion.safety.flight_context import FlightContext
from companion.safety.monitors import Monitors
from companion.safety.oscillation import Oscillation
from companion.safety.validity import InputFilter
from tests.safety.faults import (
    EXTERNAL,
    FAULTS,
    NAN,
    NO_INERTIAL,
    REPEATS,
    VEHICLE,
    at,
    both,
    estimator,
    moved,
    replace,
    slow_link,
    swinging,
)
from tests.safety.healthy import (
    START_S,
    TICK_S,
    after_a_moment,
    control,
    flying,
    healthy,
    put,
    standing,
    stopped,
    watched,
)


def test_vision_that_has_never_been_fused_is_not_lost() -> None:
    assert watched(EXTERNAL, [estimator(flags=0b1111)(healthy(k)) for k in range(100)], standing()) == []


@pytest.mark.parametrize("stamp", ["position_stamp_s", "attitude_stamp_s", "imu_stamp_s"])
def test_a_part_of_the_state_that_falls_silent_alone_is_a_lost_state(stamp: str) -> None:
    silent = put("vehicle", **{stamp: START_S})
    events = watched(EXTERNAL, [silent(healthy(k)) for k in range(100)], flying())
    assert "vehicle_state_lost" in [event.id for event in events]


def test_the_estimators_last_report_counts_until_the_next_one_comes() -> None:
    rejected = estimator(position_horizontal_ratio=1.2)
    inputs = [rejected(healthy(k)) if k < 5 else replace(healthy(k), mocap=None, estimator=None) for k in range(70)]
    assert [event.id for event in watched(EXTERNAL, inputs, flying())] == ["vision_rejected", "estimator_silent"]


def test_what_was_a_warning_on_the_ground_is_judged_anew_in_the_air() -> None:
    monitors = Monitors(VEHICLE)
    no_force = [replace(healthy(k), force=None) for k in range(400)]
    on_ground = watched(VEHICLE, no_force[:200], standing(), monitors)
    in_air = watched(VEHICLE, no_force[200:], flying(), monitors)
    assert [(e.id, e.action) for e in on_ground] == [("force_lost", SafetyAction.LAND)]
    assert [(e.id, e.action) for e in in_air] == [("force_lost", SafetyAction.WARN)]


def broken_fields() -> list[tuple[str, str, int | None]]:
    """Part, field and component of every float of the inputs."""
    found: list[tuple[str, str, int | None]] = []
    for part in ("vehicle", "status", "mocap", "arm", "force"):
        record = getattr(healthy(), part)
        for name in record.__struct_fields__:
            value = getattr(record, name)
            if isinstance(value, float) and name not in ("marker_error_m", "written_s", "asked_s"):
                found.append((part, name, None))
            elif isinstance(value, tuple) and isinstance(value[0], float):
                found += [(part, name, index) for index in range(len(value))]
    return found


@pytest.mark.parametrize(("part", "name", "index"), broken_fields())
def test_a_value_that_is_not_finite_is_reported_and_its_record_counts_as_missing(
    part: str, name: str, index: int | None
) -> None:
    for bad in (NAN, math.inf, -math.inf, 1e300):
        monitors = Monitors(VEHICLE)
        assert watched(VEHICLE, [healthy(0), healthy(1)], flying(), monitors) == []
        value = getattr(getattr(healthy(2), part), name)
        value = bad if index is None else (*value[:index], bad, *value[index + 1 :])
        events = monitors.check(put(part, **{name: value})(healthy(2)), flying())
        assert [(event.id, event.action) for event in events] == [(f"{part}_not_finite", SafetyAction.WARN)]
        assert f"ignored: {name} = " in events[0].text and f"{bad:g}" in events[0].text and len(events[0].text) < 120
        assert monitors.trusted is not None and getattr(monitors.trusted, part) is None
        good = healthy(3)
        assert monitors.check(good, flying()) == ()
        assert monitors.trusted is good


@pytest.mark.parametrize(
    ("part", "names"),
    [
        ("vehicle", ("boot_s", "imu_boot_s", "delta_velocity_body_m_s")),
        ("status", ("battery_stamp_s", "battery_voltage_v", "battery_remaining")),
        ("mocap", ("latency_s", "exposure_server_s", "marker_error_m")),
    ],
)
def test_a_record_without_an_optional_value_is_valid(part: str, names: tuple[str, ...]) -> None:
    without = put(part, **dict.fromkeys(names))(healthy())
    assert InputFilter().clean(without) is without


@pytest.mark.parametrize(
    ("height_m", "context", "reported"),
    [
        (0.46, flying(), True),
        (0.44, flying(), False),
        (1.0, flying(offboard_expected=False), False),
        (1.0, flying(airborne=False), False),
    ],
)
def test_disarmed_is_reported_only_high_in_the_air_and_while_the_companion_flies(
    height_m: float, context: FlightContext, reported: bool
) -> None:
    """It stands at 0.3 m; from 0.15 m above that it flies."""
    disarmed = both(at(0.0, 0.0, height_m), put("status", armed=False))
    found = [event.id for event in watched(VEHICLE, after_a_moment(disarmed, ticks=20, sound=0), context)]
    assert ("px4_disarmed" in found) is reported


WALLS = [(0, 1, 1.81), (0, -1, 1.81), (1, 1, 1.41), (1, -1, 1.41), (2, 1, 2.15)]
"""Axis, side, and the largest coordinate: the room of the vehicle file less 0.49 m for the rotors (0.15 m above), plus 0.1 m."""


@pytest.mark.parametrize(("axis", "side", "most_m"), WALLS)
def test_on_every_side_the_geofence_is_left_when_the_rotors_leave_the_room(axis: int, side: int, most_m: float) -> None:
    def found(off_m: float, speed_m_s: float) -> list[str]:
        place, velocity = [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
        place[axis], velocity[axis] = side * (most_m + off_m), side * speed_m_s
        inputs = after_a_moment(at(*place, *velocity), ticks=60, sound=0)
        return [event.id for event in watched(VEHICLE, inputs, flying())]

    stop_m = 0.5 * (0.21 + 0.6 + 0.5 / 16.0)  # docs/internals/safety.md: 0.5 m/s; reaction, LAND's stop point, braking
    assert found(-0.01, 0.0) == []
    assert found(0.01, 0.0) == ["geofence_left", "geofence_near"]
    assert found(-stop_m - 0.01, 0.5) == []
    assert found(-stop_m + 0.01, 0.5) == ["geofence_near"]
    assert found(-0.01, -0.5) == [], "on its way back"


@pytest.mark.parametrize(
    ("gap_s", "spoken"),
    [(0.04, []), (0.2, [("loop_late", SafetyAction.WARN)]), (1.0, [("loop_stalled", SafetyAction.LAND)])],
)
def test_after_a_late_tick_the_loop_is_reported_and_no_device(
    gap_s: float, spoken: list[tuple[str, SafetyAction]]
) -> None:
    """The first tick after a hold-up sees old stamps of everything; a moment later all is fresh."""
    late_s = START_S + gap_s
    inputs = [healthy(), replace(healthy(), t_s=late_s), *[healthy(k, late_s + k * TICK_S) for k in range(1, 60)]]
    events = watched(VEHICLE, inputs, flying())
    assert [(event.id, event.action) for event in events] == spoken


def test_motion_capture_that_stays_silent_after_a_late_tick_is_lost() -> None:
    inputs = [healthy(), *[stopped("mocap")(healthy(k, START_S + 0.2 + k * TICK_S)) for k in range(40)]]
    assert [event.id for event in watched(VEHICLE, inputs, flying())] == ["loop_late", "mocap_lost"]


@pytest.mark.parametrize(("ticks", "reports"), [(range(5, 700, 20), 1), ((100, 500), 2)])
def test_a_finding_that_flickers_is_reported_once_and_one_that_returns_later_again(
    ticks: Sequence[int], reports: int
) -> None:
    def failing(i: Inputs) -> Inputs:
        return put("arm", read_failures=6)(i) if i.tick in ticks else i

    assert len(watched(VEHICLE, after_a_moment(failing), flying())) == reports


def test_a_finding_that_ends_before_its_hold_time_begins_it_anew() -> None:
    def low_twice(i: Inputs) -> Inputs:
        return put("status", battery_remaining=0.25)(i) if 100 <= i.tick < 280 or 300 <= i.tick < 480 else i

    assert watched(VEHICLE, after_a_moment(low_twice), flying()) == []


def test_a_finding_that_is_active_after_a_resume_is_reported_again() -> None:
    monitors = Monitors(VEHICLE)
    inputs = after_a_moment(at(1.6, 0.0, 1.0, vx=0.8), sound=0)
    before = watched(VEHICLE, inputs[:100], flying(), monitors)
    monitors.forget()
    after = watched(VEHICLE, inputs[100:200], flying(), monitors)
    assert [[event.id for event in events] for events in (before, after)] == [["geofence_near"], ["geofence_near"]]


def test_a_finding_is_active_until_it_was_gone_for_a_second() -> None:
    monitors = Monitors(VEHICLE)
    near = after_a_moment(at(1.6, 0.0, 1.0, vx=0.8), sound=0)[:100]
    watched(VEHICLE, near, flying(), monitors)
    assert "outside the room" in (monitors.standing() or "")
    watched(VEHICLE, [healthy(k) for k in range(100, 295)], flying(), monitors)
    assert "outside the room" in (monitors.standing() or "")
    watched(VEHICLE, [healthy(k) for k in range(295, 310)], flying(), monitors)
    assert monitors.standing() is None


@pytest.mark.parametrize("first_s", [0.0, 0.3])
def test_of_several_active_findings_the_most_severe_is_named(first_s: float) -> None:
    """The arm is lost before or after the vehicle comes near the wall."""
    monitors, near = Monitors(VEHICLE), at(1.6, 0.0, 1.0, vx=0.8)
    lost = [i if i.t_s - START_S < first_s else stopped("arm")(i) for i in map(healthy, range(120))]
    watched(VEHICLE, [i if i.t_s - START_S < 0.3 - first_s else near(i) for i in lost], flying(), monitors)
    assert "joint state" in (monitors.standing() or "")


def test_a_warning_and_an_operators_command_do_not_prevent_resuming() -> None:
    monitors = Monitors(VEHICLE)
    warm = put("arm", temperature_c=(70.0, 35.0))
    events = watched(VEHICLE, [warm(healthy(k)) for k in range(150)], flying(), monitors)
    asked = [replace(warm(healthy(150)), command=OperatorCommand.HOLD)]
    events += watched(VEHICLE, asked, flying(), monitors)
    assert [event.id for event in events] == ["servo_warm", "operator_hold"]
    assert monitors.standing() is None


def test_an_operator_may_repeat_a_command() -> None:
    asked = [
        OperatorCommand.HOLD,
        OperatorCommand.RESUME,
        OperatorCommand.HOLD,
        OperatorCommand.NONE,
        OperatorCommand.HOLD,
    ]
    inputs = [replace(healthy(k), command=command) for k, command in enumerate(asked)]
    told = [event.id for event in watched(VEHICLE, inputs, flying())]
    assert told == ["operator_hold", "operator_resume", "operator_hold", "operator_hold"]


def test_while_inputs_are_missing_only_commands_and_invalid_values_are_reported() -> None:
    nothing = replace(healthy(), vehicle=None, status=None, mocap=None, force=None)
    waiting = standing(waiting=True)
    inputs: list[Inputs] = [replace(nothing, tick=k, t_s=START_S + k) for k in range(10)]
    inputs.append(replace(nothing, t_s=START_S + 11.0, command=OperatorCommand.LAND))
    events: list[Event] = watched(VEHICLE, inputs, waiting)
    assert [(event.id, event.action) for event in events] == [("operator_land", SafetyAction.LAND)]


def test_hardware_errors_are_reported_by_name() -> None:
    assert error_text((0, 0b100100)) == "servo 2: overheating, overload"
    assert error_text((0b1, 0b1000000)) == "servo 1: input voltage; servo 2: fault of the motor"


def test_a_link_that_was_always_slow_is_the_clocks_difference() -> None:
    """What counts is how much later than at the best of times; and after a while the new difference is the clocks'."""
    monitors = Monitors(VEHICLE)
    told = watched(VEHICLE, (slow_link(healthy(k)) for k in range(400)), flying(), monitors)
    assert told == []
    later = watched(
        VEHICLE, (put("vehicle", boot_s=healthy(k).t_s - 0.16)(healthy(k)) for k in range(400, 420)), flying(), monitors
    )
    assert later == [], "60 ms more"


@pytest.mark.parametrize(
    ("growth", "told"),
    [(0.0005, []), (0.04, ["link_slow", "link_late"])],
    ids=["clocks that drift", "a queue that fills"],
)
def test_a_lag_that_grows_faster_than_clocks_drift_apart_is_reported(growth: float, told: list[str]) -> None:
    """At the former rate of forgetting, 50 ms/s, a link that queued 40 ms more each second was never late."""
    queue = (
        put("vehicle", boot_s=i.t_s - 0.01 - growth * k * TICK_S)(i) for k, i in enumerate(map(healthy, range(600)))
    )
    assert [event.id for event in watched(VEHICLE, queue, flying())] == told


@pytest.mark.parametrize(
    ("every", "told"), [(2, ["torque_refused"]), (20, [])], ids=["every other tick", "one in twenty"]
)
def test_torques_that_are_refused_again_and_again_land_although_some_are_sent(every: int, told: list[str]) -> None:
    monitors, ids = Monitors(VEHICLE), []
    for k in range(400):
        refused = None if k % every else "joint torque (nan, 0.0) is not finite"
        ids += [event.id for event in monitors.check(healthy(k), flying(torque_refused=refused))]
    assert ids == told


@pytest.mark.parametrize(
    ("velocity", "rate", "moves"),
    [
        ((0.0, 0.0, 0.029), (0.0, 0.0, 0.049), False),
        ((0.0, 0.0, 0.031), (0.0, 0.0, 0.0), True),
        ((0.0, -0.031, 0.0), (0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.051), True),
        ((0.0, 0.0, 0.0), (0.0, -0.051, 0.0), True),
    ],
)
@pytest.mark.parametrize("found", REPEATS)
def test_values_that_repeat_are_a_fault_only_while_the_vehicle_moves(
    found: str, velocity: tuple[float, float, float], rate: tuple[float, float, float], moves: bool
) -> None:
    """It moved until they began to repeat: that proves nothing."""
    motion = put("vehicle", velocity_world_m_s=velocity, angular_rate_body_rad_s=rate)
    events = watched(VEHICLE, after_a_moment(both(motion, REPEATS[found]), ticks=300, sound=20), flying())
    assert [event.id for event in events] == ([found] if moves else [])


@pytest.mark.parametrize(("context", "trusted"), [(flying, False), (standing, True)])
def test_on_the_ground_a_force_that_repeats_itself_is_still_one(
    context: Callable[[], FlightContext], trusted: bool
) -> None:
    monitors = Monitors(VEHICLE)
    watched(VEHICLE, after_a_moment(REPEATS["force_stuck"], ticks=200), context(), monitors)
    assert monitors.trusted is not None and (monitors.trusted.force is not None) is trusted


SWING_M = VEHICLE.safety.oscillation_m


@pytest.mark.parametrize(
    ("error_m", "rate_rad_s", "oscillates"),
    [
        (lambda t_s: 0.55 * SWING_M * math.sin(3.0 * t_s), 0.4, True),
        (lambda t_s: 0.3 + 0.55 * SWING_M * math.sin(3.0 * t_s), 0.4, True),  # about another place, in wind
        (lambda t_s: 0.45 * SWING_M * math.sin(3.0 * t_s), 0.4, False),
        (lambda t_s: 0.55 * SWING_M * math.sin(3.0 * t_s), 0.2, False),  # the reference wanders, not the vehicle
        (lambda t_s: 3.0 * SWING_M * math.exp(-2.0 * t_s) * math.sin(3.0 * t_s), 0.4, False),  # a blow that dies out
        (lambda t_s: 0.55 * SWING_M * math.sin(0.9 * t_s), 0.4, False),  # drifting air
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_only_swings_that_last_are_an_oscillation(
    error_m: Callable[[float], float], rate_rad_s: float, oscillates: bool, axis: int
) -> None:
    watch = Oscillation(SWING_M)
    found = []
    for k in range(2000):
        error, rate = [0.0, 0.0], [0.0, 0.0]
        error[axis], rate[1 - axis] = error_m(k * TICK_S), rate_rad_s
        watch.update(k * TICK_S, TICK_S, (error[0], error[1]), (rate[0], rate[1]))
        found.append(watch.rate_rad_s is not None)
    assert any(found) is oscillates
    assert not any(found[:400]), "not before two periods, of 2.1 s each"


@pytest.mark.parametrize("chases", [True, False])
def test_swings_that_a_chase_causes_are_not_counted(chases: bool) -> None:
    context = swinging()
    context.chases = chases
    events = watched(VEHICLE, after_a_moment(FAULTS["oscillates"].change), context)
    assert [event.id for event in events] == ([] if chases else ["oscillates"])


@pytest.mark.parametrize(("chased_s", "first_s"), [(0.0, 0.55), (2.0, 3.55)], ids=["no-chase", "chase"])
def test_a_force_that_the_motion_does_not_show_is_judged_from_a_second_after_a_chase_on(
    chased_s: float, first_s: float
) -> None:
    tracker = ForceTracker(VEHICLE.safety.force_stuck_s, 1.0, VEHICLE.airframe.ground_clearance_m)
    context, found_s = (
        flying(control=control(force_ext_world_n=(0.0, 0.0, 1.5)), disturbance_world_n=(0.0, 0.0, -1.5)),
        [],
    )
    for k in range(1000):
        context.chases = k * TICK_S < chased_s
        tracker.update(healthy(k, k * TICK_S), context, k * TICK_S, TICK_S, moving=True)
        found_s += [k * TICK_S] if tracker.off_n is not None else []
    assert found_s[0] == pytest.approx(first_s, abs=0.03)


@pytest.mark.parametrize(("late_s", "id_"), [(0.01, None), (0.03, "link_slow"), (0.06, "link_late")])
@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.02)])
def test_a_link_that_was_always_slow_is_found_when_the_vehicle_moves(
    late_s: float, id_: str | None, offset_m: tuple[float, float, float]
) -> None:
    """PX4's position is where the vehicle was on the way there and back; a wrong pivot makes no difference."""

    def flies(i: Inputs) -> Inputs:
        now_s = i.t_s - START_S

        def at_m(t_s: float) -> float:
            return 0.3 * math.sin(1.5 * t_s)

        x, y, z = offset_m
        px4 = put("vehicle", position_world_m=(x + at_m(now_s - 2.0 * late_s), y, 1.0 + z))
        speed = put("vehicle", velocity_world_m_s=(0.45 * math.cos(1.5 * (now_s - 2.0 * late_s)), 0.0, 0.0))
        return put("mocap", position_world_m=(at_m(now_s), 0.0, 1.0))(speed(px4(i)))

    events = watched(NO_INERTIAL, [flies(healthy(k)) for k in range(1000)], flying())
    assert [event.id for event in events] == ([id_] if id_ else [])


def test_the_lag_is_not_measured_with_poses_that_are_not_trusted_or_repeat() -> None:
    """A pose that stays behind a moving vehicle looks like a lag that is negative or large."""

    def lost(i: Inputs) -> Inputs:
        t_s = i.t_s - START_S
        moving = put("vehicle", velocity_world_m_s=(0.4 * math.sin(2.0 * t_s), 0.0, 0.0))
        shift_m = 0.09 * math.sin(2.0 * t_s)
        return replace(moved("vehicle", (-shift_m, 0.0, 0.0))(moving(i)), mocap=healthy(3).mocap)

    events = watched(NO_INERTIAL, after_a_moment(lost), flying())
    assert {event.id for event in events} == {"mocap_lost"}
