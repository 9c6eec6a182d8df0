"""The ladder flown: hold, go on, retract, abort, a pilot who takes over, broken inputs. Fast closed loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise

import msgspec
import pytest

from companion.core.flight_core import FlightCore
from companion.model.codec import differences
from companion.model.frames import tilt_rad
from companion.model.outputs import Outputs
from companion.model.types import (
    AutopilotRequest,
    FlightMode,
    Inputs,
    OperatorCommand,
    Outcome,
    SafetyAction,
    VehicleState,
)
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.flights.ends import Changed, after, flown_until
from tests.support import HOVER, LOW_HOVER, SHORT_CATCH, tether_of

pytestmark = pytest.mark.usefixtures("short_start")

replace = msgspec.structs.replace
Change = Callable[[Inputs], Inputs]


def configured(*overrides: str) -> SitlConfig:
    return load_sitl("configs/missions/catch.yaml", preset="recommended", overrides=overrides)


def flown(change: Change, *overrides: str, limit_s: float = 90.0) -> FastResult:
    return Changed(configured(*overrides), change).run(limit_s)


def short(*overrides: str) -> SitlConfig:
    """Take-off at 3.2 s, on the line from 4.7 s, the catch at 5.7 s, landing from 7.7 s on."""
    return load_sitl(SHORT_CATCH, preset="recommended", overrides=overrides)


HIGHER = (
    "mission.phases[0].height_m=0.9",
    "mission.phases[0].duration_s=2.5",
    "mission.phases[1].to_m=[0.4, 0.0, 0.9]",
)
"""Of the short flight: high enough to stay there. Everything is a second later."""


def short_flown(change: Change, *overrides: str, limit_s: float = 90.0) -> FastResult:
    return Changed(short(*overrides), change).run(limit_s)


def asking(*script: tuple[float, OperatorCommand]) -> Change:
    """Each command from its time on."""

    def change(i: Inputs) -> Inputs:
        asked = [command for t_s, command in script if i.t_s >= t_s]
        return replace(i, command=asked[-1]) if asked else i

    return change


def event_ids(result: FastResult) -> list[str]:
    return [event.id for outputs in result.outputs for event in outputs.events]


def at(result: FastResult, t_s: float) -> Outputs:
    return next(outputs for outputs in result.outputs if outputs.t_s >= t_s)


def assert_safe(result: FastResult) -> None:
    assert not result.crashed
    assert max(tilt_rad(truth.attitude_wxyz) for truth in result.truth) < math.radians(25)
    assert result.truth[-1].position_world_m[2] < 0.35


def test_held_it_stays_and_going_on_it_completes() -> None:
    result = short_flown(asking((5.2, OperatorCommand.HOLD), (6.8, OperatorCommand.RESUME)), *HIGHER)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert event_ids(result) == ["takeoff", "operator_hold", "operator_resume", "catch", "touchdown"]
    held = [truth.position_world_m for truth in result.truth if 6.2 < truth.t_s < 6.8]
    assert max(math.dist(held[0], p) for p in held) < 0.05
    assert at(result, 6.7).action is SafetyAction.HOLD
    assert at(result, 7.3).action is SafetyAction.NOMINAL
    assert_safe(result)


def test_held_too_long_it_lands() -> None:
    flight = Changed(short(*HIGHER, "vehicle.safety.hold_max_s=0.5"), asking((6.0, OperatorCommand.HOLD)))
    result = flight.run(until=after("hold_expired", 1.0))
    assert event_ids(result) == ["takeoff", "operator_hold", "hold_expired"]
    assert result.outputs[-1].action is SafetyAction.LAND and not result.crashed


def test_aborted_it_lands_at_once_with_the_arm_folded() -> None:
    script = (6.0, OperatorCommand.HOLD), (6.5, OperatorCommand.ABORT), (7.0, OperatorCommand.RESUME)
    result = short_flown(asking(*script), *HIGHER)
    last = result.outputs[-1]
    assert (last.outcome, last.action) == (Outcome.ABORTED, SafetyAction.LAND)
    assert last.t_s < 12.5
    folded = [math.degrees(angle) for angle in result.truth[-1].joint_angle_rad]
    assert max(abs(a - b) for a, b in zip(folded, (165.0, 140.0), strict=True)) < 12
    assert_safe(result)


TAUT = (
    "vehicle.tether.length_m=1.98",
    "vehicle.tether.margin_m=0.05",
    "vehicle.tether.taut_slack_m=0.15",
    "vehicle.safety.tether_stop_slack_min_m=0",
)
"""Taut on the last centimetres of the way up; the predicted stop, which would hold it before, is let by."""


@cache
def retracted() -> tuple[FastFlight, FastResult]:
    flight = FastFlight(configured(*TAUT))
    return flight, flight.run()


def test_taut_it_goes_back_along_the_tether_and_lands() -> None:
    _, result = retracted()
    ids = event_ids(result)
    assert ids == ["takeoff", "tether_taut", "retract_done", "touchdown"]
    assert result.outputs[-1].outcome is Outcome.ABORTED
    anchor = tether_of(load_sitl("configs/missions/catch.yaml").vehicle).anchor_world_m
    way = [o.reference.position_world_m for o in result.outputs if o.action is SafetyAction.RETRACT and o.reference]
    away = [math.dist(p[:2], anchor[:2]) for p in way]
    # The governor takes the little that is left of the climb out within its acceleration.
    assert max(b - a for a, b in pairwise(away)) < 1e-4
    assert max(p[2] for p in way) - way[0][2] < 0.01
    assert at(result, result.outputs[-1].t_s - 2.5).tether.slack_m > 0.55  # type: ignore[union-attr]
    assert_safe(result)


def test_a_way_back_that_takes_too_long_becomes_a_landing() -> None:
    flight = FastFlight(configured(*TAUT, "vehicle.safety.retract_max_s=1.0"))
    result = flight.run(until=after("retract_expired", 1.0))
    assert event_ids(result) == ["takeoff", "tether_taut", "retract_expired"]
    assert result.outputs[-1].action is SafetyAction.LAND and not result.crashed


@pytest.mark.parametrize(
    ("command", "overrides", "stolen_s"),
    [(OperatorCommand.HOLD, HIGHER, 6.4), (OperatorCommand.NONE, TAUT, 5.0), (OperatorCommand.LAND, HIGHER, 6.4)],
    ids=["in a hold", "in a retract", "in a landing"],
)
def test_a_pilot_who_takes_over_is_left_alone(
    command: OperatorCommand, overrides: tuple[str, ...], stolen_s: float
) -> None:
    asked = asking((6.0, command))

    def change(i: Inputs) -> Inputs:
        i = asked(i)
        if i.status is not None and i.t_s >= stolen_s:
            i = replace(i, status=replace(i.status, mode=FlightMode.MANUAL))
        return i

    fly = flown if overrides is TAUT else short_flown
    result = fly(change, *overrides, limit_s=stolen_s + 0.6)
    assert "pilot_took_over" in event_ids(result)
    after = [o for o in result.outputs if o.t_s >= stolen_s]
    assert all(o.attitude is None and o.request is AutopilotRequest.NONE for o in after)
    assert len(after) > 100


def test_a_pilot_who_takes_over_from_px4s_landing_is_left_alone() -> None:
    """Motion capture is lost, PX4 lands, somebody takes the sticks: no request goes against them."""

    def change(i: Inputs) -> Inputs:
        if i.status is not None and i.t_s >= 6.0:
            i = replace(i, status=replace(i.status, mode=FlightMode.MANUAL))
        return i

    config = short("world.faults=[{kind: mocap_loss, t_s: 3.0}]")
    result = flown_until(Changed(config, change), lambda o: o.t_s >= 6.6)
    after = [o for o in result.outputs if o.t_s >= 6.0]
    assert result.outputs[after[0].tick - 1].action is SafetyAction.AUTOPILOT_LAND
    assert any(event.text == "a pilot took over" for o in after for event in o.events)
    assert all(o.attitude is None and o.request is AutopilotRequest.NONE for o in after)


def test_a_pilot_who_takes_over_after_touch_down_is_not_disarmed() -> None:
    """PX4's land detector takes its time, and in the middle of that the pilot switches to Hold: FORCE_DISARM left all the same."""
    slow = "world.px4_params={LNDMC_TRIG_TIME: 5.0}"
    taken = "world.faults=[{kind: pilot_takeover, t_s: 8.0, size: 3.0}]"
    low = [f"{key}={value}" for key, value in LOW_HOVER.items()]
    result = flown_until(FastFlight(load_sitl(HOVER, overrides=[*low, slow, taken])), lambda o: o.t_s >= 11.5)
    assert event_ids(result) == ["takeoff", "touchdown", "pilot_took_over"]
    last = result.inputs[-1].status
    assert last is not None and last.armed, "PX4 disarms when the pilot has landed"
    assert not {o.request for o in result.outputs} & {AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM}
    assert not result.crashed


def test_released_after_a_kill_on_the_floor_the_vehicle_stays_there() -> None:
    """Killed just before it lifts, released after a second: it jumped to 0.7 m."""
    fault = "world.faults=[{kind: kill_switch, t_s: 2.4, duration_s: 1.0}]"
    late = "world.px4_params={COM_KILL_DISARM: 5.0}"
    result = FastFlight(load_sitl(HOVER, overrides=[fault, late])).run()
    begins_s = next(o.t_s for o in result.outputs for event in o.events if event.id == "killed")
    assert all(o.attitude is None for o in result.outputs if o.t_s >= begins_s)
    assert {o.request for o in result.outputs if o.t_s >= begins_s} == {AutopilotRequest.NONE}
    floor_m = result.snapshots[0].q[2]
    assert max(snapshot.q[2] for snapshot in result.snapshots) < floor_m + 0.02
    assert result.outputs[-1].outcome is Outcome.ABORTED and not result.armed


# -- broken inputs ---------------------------------------------------------------------------------------------------

NAN3 = (math.nan, math.nan, math.nan)
BROKEN: dict[str, Callable[[Inputs], Inputs]] = {
    "mocap": lambda i: replace(i, mocap=replace(i.mocap, position_world_m=NAN3)),  # type: ignore[type-var]
    "vehicle": lambda i: replace(i, vehicle=replace(i.vehicle, velocity_world_m_s=NAN3)),  # type: ignore[type-var]
    "status": lambda i: replace(i, status=replace(i.status, battery_voltage_v=math.inf)),  # type: ignore[type-var]
    "arm": lambda i: replace(i, arm=replace(i.arm, angle_rad=(math.nan, 1.0))),  # type: ignore[type-var]
    "force": lambda i: replace(i, force=replace(i.force, force_sensor_n=(math.inf, 0.0, 0.0))),  # type: ignore[type-var]
}


def test_broken_values_for_a_moment_never_reach_the_law_and_the_mission_goes_on() -> None:
    """Each part in turn, for 20 ms every 0.5 s."""

    def change(i: Inputs) -> Inputs:
        part, tick = divmod(i.tick % 100, 20)
        return list(BROKEN.values())[part](i) if 2.0 <= i.t_s < 6.5 and tick < 4 else i

    result = short_flown(change)
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert {f"{part}_not_finite" for part in BROKEN} <= set(event_ids(result))
    for o in result.outputs:
        numbers = [*(o.attitude.attitude_wxyz if o.attitude else ()), *(o.arm_torque_nm or ())]
        if o.control is not None:
            numbers += [*o.control.tau, *o.control.h_hat, *o.control.gamma, o.control.hover_thrust]
        assert all(map(math.isfinite, numbers))
    assert_safe(result)


def test_broken_values_for_good_are_a_lost_device() -> None:
    """Of the other parts: tests/safety/test_rules.py."""
    result = short_flown(lambda i: BROKEN["vehicle"](i) if i.t_s >= 5.0 else i)
    assert "vehicle_state_lost" in event_ids(result)
    assert result.outputs[-1].outcome is Outcome.ABORTED
    assert not result.crashed


def test_poses_of_another_body_are_not_passed_on_and_px4_lands() -> None:
    def change(i: Inputs) -> Inputs:
        if i.mocap is None or i.t_s < 5.2:
            return i
        x, y, z = i.mocap.position_world_m
        return replace(i, mocap=replace(i.mocap, position_world_m=(x + 0.8, y, z)))

    result = short_flown(change)
    ids = event_ids(result)
    assert ids[:3] == ["takeoff", "mocap_jump", "mocap_swapped"]
    swapped = next(e for o in result.outputs for e in o.events if e.id == "mocap_swapped")
    assert swapped.t_s - 5.2 < short().vehicle.safety.mocap_timeout_s + 0.05
    assert all(o.mocap_trusted == (o.t_s < 5.2) for o in result.outputs if o.t_s < 7.2)


# -- nothing is sent again -------------------------------------------------------------------------------------------


@cache
def ordinary() -> FastResult:
    return FastFlight(short()).run(limit_s=3.5)


@pytest.mark.parametrize("part", ["vehicle", "arm"])
def test_no_command_answers_a_state_that_is_older_than_it_may_be(part: str) -> None:
    """The link falls silent: the edge goes on showing the last state. Attitude ends within 100 ms, torque within 50 ms."""
    inputs = ordinary().inputs
    begin = next(k for k, i in enumerate(inputs) if i.t_s >= 3.0)
    core = FlightCore(FastFlight(short()).config)
    for i in inputs[:begin]:
        core.step(i)
    sent = []
    for i in inputs[begin : begin + 60]:
        o = core.step(replace(i, **{part: getattr(inputs[begin], part)}))
        frozen = inputs[begin].vehicle if part == "vehicle" else inputs[begin].arm
        assert frozen is not None
        stamp_s = frozen.attitude_stamp_s if isinstance(frozen, VehicleState) else frozen.stamp_s
        sent.append((i.t_s - stamp_s, o.attitude if part == "vehicle" else o.arm_torque_nm))
    limit_s = 0.1 if part == "vehicle" else 0.05
    assert all((command is not None) == (age_s <= limit_s) for age_s, command in sent)
    assert sent[-1][0] > 2 * limit_s


def test_the_same_inputs_give_the_same_outputs_bit_for_bit_also_through_a_retract() -> None:
    flight, result = retracted()
    core = FlightCore(flight.config)
    for i, o in zip(result.inputs, result.outputs, strict=True):
        assert differences(o, core.step(i)) is None
