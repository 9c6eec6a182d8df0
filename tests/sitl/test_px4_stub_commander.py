"""Commander rules of the PX4 stub, as tables: what is refused, with which MAV_RESULT, and what flies when something is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sitl.autopilot.commander import FORCE_MAGIC, OFFBOARD_LOSS_EXTRA_S, Command, Commander, Result
from sitl.autopilot.modes import Health, NavState, OffboardKind
from sitl.autopilot.params import Params

GOOD = Health(
    attitude_valid=True,
    position_valid=True,
    height_valid=True,
    origin_set=True,
    home_set=True,
    landed=True,
    maybe_landed=True,
    setpoint_age_s=0.02,
)
BLIND = replace(GOOD, position_valid=False, height_valid=False)
FLYING = replace(GOOD, landed=False, maybe_landed=False)
LOSS_S = 0.5


def commander(**overrides: int) -> Commander:
    return Commander(Params({"COM_OF_LOSS_T": LOSS_S, **overrides}))


def ask(it: Commander, command: int, *params: float, health: Health = GOOD, t_s: float = 0.0) -> Result:
    p = (*params, *(0.0,) * (7 - len(params)))
    return it.command(t_s, command, (p[0], p[1], p[2], p[3], p[4], p[5], p[6]), health)


def set_mode(it: Commander, state: NavState, health: Health = GOOD) -> Result:
    return ask(it, Command.DO_SET_MODE, 1.0, float(state.value[0]), float(state.value[1]), health=health)


def flying(state: NavState, **overrides: int) -> Commander:
    it = commander(**overrides)
    assert set_mode(it, state) is Result.ACCEPTED
    assert ask(it, Command.COMPONENT_ARM_DISARM, 1.0) is Result.ACCEPTED
    it.update(0.1, FLYING)
    it.notices.clear()
    return it


@pytest.mark.parametrize(
    ("state", "health", "reason"),
    [
        (NavState.LOITER, GOOD, None),
        (NavState.LOITER, replace(GOOD, origin_set=False), "No valid global position estimate"),
        (NavState.TAKEOFF, replace(GOOD, origin_set=False), None),
        (NavState.TAKEOFF, BLIND, "No valid altitude estimate"),
        (NavState.LAND, GOOD, "Mode not suitable for arming"),
        (NavState.MISSION, GOOD, "No valid mission available"),
        (NavState.POSCTL, GOOD, "No manual control input"),
        (NavState.OFFBOARD, GOOD, None),
        (NavState.OFFBOARD, BLIND, None),
        (NavState.OFFBOARD, replace(BLIND, attitude_valid=False), "No valid attitude estimate"),
        (NavState.OFFBOARD, replace(GOOD, setpoint_age_s=None), "No offboard signal"),
        (NavState.OFFBOARD, replace(GOOD, setpoint_age_s=0.51), "No offboard signal"),
        (NavState.OFFBOARD, replace(GOOD, setpoint_kind=OffboardKind.POSITION), None),
        (NavState.OFFBOARD, replace(BLIND, setpoint_kind=OffboardKind.POSITION), "No offboard signal"),
    ],
)
def test_arming_rules(state: NavState, health: Health, reason: str | None) -> None:
    it = commander()
    assert set_mode(it, state, health) is Result.ACCEPTED, "disarmed, every mode may be wished for"
    result = ask(it, Command.COMPONENT_ARM_DISARM, 1.0, health=health)
    assert it.armed is (reason is None)
    if reason is None:
        assert result is Result.ACCEPTED
        assert [notice.text for notice in it.notices] == ["Armed by external command"]
    else:
        assert result is Result.TEMPORARILY_REJECTED
        assert it.arming_problem(health) == reason
        assert [notice.text for notice in it.notices] == ["Arming denied: Resolve system health failures first"]


@pytest.mark.parametrize(
    ("health", "magic", "result", "armed"),
    [
        (FLYING, 0.0, Result.TEMPORARILY_REJECTED, True),
        (FLYING, float(FORCE_MAGIC), Result.ACCEPTED, False),
        (replace(FLYING, maybe_landed=True), 0.0, Result.ACCEPTED, False),
        (GOOD, math.nan, Result.ACCEPTED, False),
    ],
)
def test_disarming_in_the_air_needs_force(health: Health, magic: float, result: Result, armed: bool) -> None:
    it = flying(NavState.OFFBOARD)
    assert ask(it, Command.COMPONENT_ARM_DISARM, 0.0, magic, health=health) is result
    assert it.armed is armed


@pytest.mark.parametrize(
    ("state", "health", "result"),
    [
        (NavState.LAND, FLYING, Result.ACCEPTED),
        (NavState.LAND, replace(FLYING, position_valid=False), Result.TEMPORARILY_REJECTED),
        (NavState.LOITER, replace(FLYING, origin_set=False), Result.TEMPORARILY_REJECTED),
        (NavState.OFFBOARD, FLYING, Result.ACCEPTED),
        (NavState.OFFBOARD, replace(FLYING, setpoint_age_s=0.6), Result.TEMPORARILY_REJECTED),
        (NavState.OFFBOARD, replace(FLYING, position_valid=False), Result.ACCEPTED),
        (NavState.POSCTL, FLYING, Result.TEMPORARILY_REJECTED),
        (NavState.RTL, replace(FLYING, home_set=False), Result.TEMPORARILY_REJECTED),
    ],
)
def test_in_flight_a_mode_that_cannot_run_is_refused(state: NavState, health: Health, result: Result) -> None:
    it = flying(NavState.TAKEOFF)
    assert set_mode(it, state, health) is result
    it.update(0.2, health)
    if result is Result.ACCEPTED:
        assert it.nav_state is state
    else:
        assert it.user_intention is NavState.TAKEOFF


@pytest.mark.parametrize(
    ("action", "health", "state"),
    [
        (4, FLYING, NavState.LAND),
        (4, replace(FLYING, position_valid=False), NavState.DESCEND),
        (3, FLYING, NavState.RTL),
        (3, replace(FLYING, origin_set=False), NavState.LAND),
        (5, FLYING, NavState.LOITER),
        (0, FLYING, NavState.RTL),
        (6, FLYING, NavState.TERMINATION),
        (4, replace(FLYING, position_valid=False, attitude_valid=False), NavState.TERMINATION),
    ],
)
def test_offboard_loss_leads_to_com_obl_rc_act(action: int, health: Health, state: NavState) -> None:
    it = flying(NavState.OFFBOARD, COM_OBL_RC_ACT=action)
    it.update(1.0, replace(health, attitude_valid=True, setpoint_age_s=LOSS_S + OFFBOARD_LOSS_EXTRA_S - 0.001))
    assert it.nav_state is NavState.OFFBOARD, "not yet"
    it.update(1.1, replace(health, setpoint_age_s=LOSS_S + OFFBOARD_LOSS_EXTRA_S + 0.001))
    assert it.nav_state is state
    assert it.failsafe is True
    assert it.notices[-1].text.startswith("Failsafe activated")


def test_after_landing_px4_disarms_and_is_back_in_offboard() -> None:
    it = flying(NavState.OFFBOARD)
    set_mode(it, NavState.LAND, FLYING)
    it.update(1.0, FLYING)
    it.update(2.0, GOOD)
    it.update(3.9, GOOD)
    assert it.armed, "COM_DISARM_LAND has not passed"
    it.update(4.0, GOOD)
    assert not it.armed
    assert it.nav_state is NavState.OFFBOARD
    assert it.notices[-1].text == "Disarmed by landing"


def test_a_kill_disarms_after_com_kill_disarm_and_forbids_arming() -> None:
    it = flying(NavState.OFFBOARD, COM_KILL_DISARM=5)
    killed = replace(FLYING, killed=True)
    it.update(1.0, killed)
    it.update(5.9, killed)
    assert it.armed
    it.update(5.95, FLYING)
    it.update(6.1, killed)
    it.update(11.0, killed)
    assert it.armed, "the time counts from the last kill"
    it.update(11.2, killed)
    assert not it.armed
    assert it.arming_problem(replace(GOOD, killed=True)) == "Kill switch engaged"


@pytest.mark.parametrize(
    ("kind", "state"), [(OffboardKind.ATTITUDE, NavState.OFFBOARD), (OffboardKind.POSITION, NavState.DESCEND)]
)
def test_when_position_is_lost_offboard_with_attitudes_has_no_failsafe(kind: OffboardKind, state: NavState) -> None:
    it = flying(NavState.OFFBOARD)
    it.update(10.0, replace(FLYING, position_valid=False, setpoint_kind=kind))
    assert it.nav_state is state
    assert it.failsafe is (kind is not OffboardKind.ATTITUDE)
