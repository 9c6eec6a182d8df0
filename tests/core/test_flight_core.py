"""What the flight core makes of its own state between two transitions: one function at a time, from a state that the test makes up."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from companion.config.loader import load_flight
from companion.control.types import Tuning
from companion.core.flight_core import FlightCore
from companion.mission.air import Expectation
from companion.model.flight_stage import Stage
from companion.model.markers import BallState
from companion.model.outputs import ChaseState, TetherState
from companion.model.team import Grip
from companion.model.types import OperatorCommand, PhaseKind, SafetyAction, Vec3
from companion.safety.rules import PARTNER_HOLDS
from companion.safety.supervisor import SupervisorState
from tests.control.states import at_rest
from tests.core.test_reactions import PLAN, in_plan
from tests.safety.healthy import SLOW, flying, healthy

CONFIG = load_flight("configs/missions/catch.yaml")
HOVERING = CONFIG.model_copy(
    update={
        "vehicle": CONFIG.vehicle.model_copy(
            update={"airframe": CONFIG.vehicle.airframe.model_copy(update={"hover_thrust": 0.5})}
        )
    }
)
NOW_S = healthy().t_s
INTO: Vec3 = (0.6, 0.8, 0.0)
CHASE = ChaseState(predicted_s=0.5, replans=1, relative_speed_m_s=4.0)


def core_in_flight(observes: bool = False, **fields: Any) -> Any:
    """A core in the middle of its mission; `fields` of the state have other values."""
    core: Any = FlightCore(HOVERING)
    core._observes, core._state = observes, in_plan(**fields)
    return core


def test_before_the_first_control_tick_there_is_no_error_and_no_mission_time() -> None:
    core: Any = FlightCore(HOVERING)
    _, observation = core._observe(healthy(), 0.005)
    assert (observation.position_error_m, observation.yaw_error_rad) == ((0.0, 0.0, 0.0), 0.0)
    assert (observation.force_world_n, observation.reference) == (None, None)
    assert not core._context.waiting
    core._observe(replace(healthy(1), status=None), 0.005)
    assert core._context.waiting, "the rules judge nothing while inputs are missing"
    assert core.step(replace(healthy(1), status=None)).mission_t_s == 0.0


def test_the_force_on_the_tool_is_known_while_px4_lands() -> None:
    """The law, which measures it in flight, does not run then, and a bar that pulls too hard is to be let go all the same."""
    core, i = core_in_flight(stage=Stage.AUTOPILOT_LAND), healthy()
    core._control.disturbance_world_n = (1.0, 2.0, 3.0)
    found = core._observe(i, 0.005)[1]
    assert found.force_world_n is None, "without a tare"
    assert found.disturbance_world_n is None, "it is that of the last tick in which the law ran"
    core._control.begin_tare()
    core._control.collect_tare(i)
    core._control.finish_tare()
    assert i.force is not None
    x, y, z = i.force.force_sensor_n
    pulls = replace(i, force=replace(i.force, force_sensor_n=(x + 12.0, y, z - 16.0)))
    force = core._observe(pulls, 0.005)[1].force_world_n
    assert force is not None and math.hypot(*force) == pytest.approx(20.0)
    old_s = i.t_s - HOVERING.vehicle.safety.force_timeout_s - 0.01
    stale = replace(pulls, force=replace(i.force, stamp_s=old_s))
    assert core._observe(stale, 0.005)[1].force_world_n is None


@pytest.mark.parametrize(
    ("grip", "action", "command", "asked"),
    [
        (Grip.FREE, SafetyAction.HOLD, OperatorCommand.NONE, []),
        (Grip.CARRYING, SafetyAction.WARN, OperatorCommand.NONE, []),
        (Grip.FREE, SafetyAction.HOLD, OperatorCommand.RESUME, [None]),
        (Grip.CARRYING, SafetyAction.WARN, OperatorCommand.RESUME, [None]),
        (Grip.CARRYING, SafetyAction.HOLD, OperatorCommand.NONE, [PARTNER_HOLDS]),
    ],
)
def test_rules_that_forbid_to_resume_are_looked_up_for_a_resume_and_in_a_hold_with_a_bar(
    grip: Grip, action: SafetyAction, command: OperatorCommand, asked: list[str | None]
) -> None:
    core = core_in_flight(grip=grip, supervisor=SupervisorState(action, "cause", NOW_S))
    looked_up: list[str | None] = []

    def standing(besides: str | None = None) -> str:
        looked_up.append(besides)
        return "a rule"

    core._monitors.standing = standing
    _, observation = core._observe(replace(healthy(), command=command), 0.005)
    assert looked_up == asked
    assert observation.standing == ("a rule" if asked else None)


@pytest.mark.parametrize(
    ("expected", "acceleration_m_s2", "chases"),
    [
        (Expectation(chase=CHASE), 1.1, True),
        (Expectation(chase=CHASE), 0.9, False),
        (Expectation(ball=BallState(position_world_m=(1.0, 0.0, 1.0))), 1.1, True),
        (Expectation(), 1.1, False),
    ],
    ids=["chase", "chase-at-rest", "aside-for-a-ball", "neither"],
)
def test_a_chase_and_a_move_aside_swing_the_vehicle_while_the_reference_accelerates(
    expected: Expectation, acceleration_m_s2: float, chases: bool
) -> None:
    core = core_in_flight(expected=expected)
    core._reference = replace(at_rest((0.0, 0.0, 1.0), 0.0, ()), acceleration_world_m_s2=(0.0, acceleration_m_s2, 0.0))
    core._observe(healthy(), 0.005)
    assert core._context.chases is chases


@pytest.mark.parametrize(
    ("observes", "expected", "tool_n"),
    [
        (False, Expectation(), (1.0, 0.0, 0.0)),
        (False, Expectation(into_world=INTO, touches=True, force_n=5.0), (2.0, 0.0, 0.0)),
        (True, Expectation(), (2.0, 0.0, 0.0)),
        (True, Expectation(into_world=INTO), (2.0, 0.0, 0.0)),
        (True, Expectation(into_world=INTO, touches=True, force_n=5.0), (-3.0, -4.0, 0.0)),
        (
            False,
            Expectation(into_world=INTO, touches=True, friction_max_n=0.8),
            (1.36, 0.48, 0.0),
        ),  # across it 0.8 of 1.6 N
    ],
)
def test_the_force_on_the_tool_that_is_no_pull_of_the_tether(
    observes: bool, expected: Expectation, tool_n: Vec3
) -> None:
    """The law's force without a touch; with one, what the sensor measures, and with the observer what the phase presses with."""
    core = core_in_flight(observes, expected=expected)
    told: list[Any] = []
    log = flying().control
    assert log is not None
    core._log = replace(log, force_ext_world_n=(1.0, 0.0, 0.0), force_measured_world_n=(2.0, 0.0, 0.0))

    def update(*inputs: Any) -> TetherState:
        told.append(inputs[6])
        return SLOW

    core._watch = SimpleNamespace(update=update)
    core._watch_tether(healthy())
    assert told == [], "not armed"
    core._tether_watched = True
    core._watch_tether(replace(healthy(), vehicle=None))
    assert told == [], "no state"
    core._watch_tether(healthy())
    core._log = None
    core._watch_tether(healthy())
    assert told == [pytest.approx(tool_n), None]


LANDING_S = next(s.start_s for s in PLAN.segments if s.kind is PhaseKind.LANDING) + 0.1


@pytest.mark.parametrize(
    ("changes", "tuning"),
    [
        ({}, Tuning.RUN),
        ({"plan_s": LANDING_S}, Tuning.UNDO),
        ({"supervisor": SupervisorState(SafetyAction.WARN)}, Tuning.FREEZE),
        ({"plan_s": LANDING_S, "supervisor": SupervisorState(SafetyAction.WARN)}, Tuning.FREEZE),
        ({"expected": Expectation(into_world=INTO)}, Tuning.FREEZE),
        ({"limited_by": ("tether",)}, Tuning.FREEZE),
        ({"trusted": False}, Tuning.FREEZE),
        ({"pose_s": NOW_S - 0.099}, Tuning.RUN),
        ({"pose_s": NOW_S - 0.101}, Tuning.FREEZE),
    ],
)
def test_the_impedance_is_optimised_only_while_nothing_disturbs_and_undone_for_the_landing(
    changes: dict[str, Any], tuning: Tuning
) -> None:
    fields = dict(changes)
    limited_by, trusted = fields.pop("limited_by", ()), fields.pop("trusted", True)
    pose_s = fields.pop("pose_s", NOW_S)
    core = core_in_flight(**fields)
    core._limited_by, core._pose_s, core._monitors = limited_by, pose_s, SimpleNamespace(mocap_trusted=trusted)
    assert core._tuning(NOW_S) is tuning
