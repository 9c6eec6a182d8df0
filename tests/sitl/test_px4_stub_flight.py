"""The PX4 stub flies a small rigid body, faster than real time and without sockets: own modes, OFFBOARD, losses."""

from __future__ import annotations

import copy
import math
from functools import cache

import pytest

from sitl.autopilot.commander import Command, Result
from sitl.autopilot.modes import NavState
from sitl.autopilot.origin import Origin
from sitl.autopilot.setpoints import PositionTarget, RateTarget
from sitl.autopilot.types import AttitudeTarget
from tests.sitl.px4_rig import PERIOD_S, Rig

HOVER = 0.5
LEVEL = (1.0, 0.0, 0.0, 0.0)


def ready(**overrides: float) -> Rig:
    rig = Rig(overrides)
    rig.run(0.5)
    return rig


def hovering(**overrides: float) -> Rig:
    """In Hold at 1 m."""
    return copy.deepcopy(_hovering(tuple(overrides.items())))


@cache
def _hovering(overrides: tuple[tuple[str, float], ...]) -> Rig:
    rig = ready(**dict(overrides))
    rig.stub.set_origin(Origin(47.397742, 8.545594, 488.0))
    rig.run(0.1)
    assert rig.command(Command.NAV_TAKEOFF) is Result.ACCEPTED
    assert rig.arm() is Result.ACCEPTED
    run_until(rig, lambda: rig.stub.nav_state is NavState.LOITER, 20.0)
    assert rig.height_m == pytest.approx(1.0, abs=0.15)
    rig.texts()
    return rig


def run_until(rig: Rig, condition: object, limit_s: float) -> float:
    """Run until the condition holds; returns how long that took."""
    assert callable(condition)
    start_s = rig.t_s
    while not condition():
        assert rig.t_s - start_s < limit_s, "did not happen in time (world time)"
        rig.step()
    return rig.t_s - start_s


def stream(rig: Rig, duration_s: float, target: AttitudeTarget | RateTarget | PositionTarget) -> None:
    """A setpoint every 20 ms of world time."""
    until_s = rig.t_s + duration_s
    due_s = rig.t_s
    while rig.t_s < until_s:
        if rig.t_s >= due_s:
            rig.stub.on_setpoint(rig.t_s, target)
            due_s += 0.02
        rig.step()


def test_take_off_hold_land_and_automatic_disarm() -> None:
    rig = hovering()
    rig.run(3.0)
    assert rig.stub.nav_state is NavState.LOITER
    x, y, z = rig.plant.position_ned_m
    assert math.hypot(x, y) < 0.05
    assert z == pytest.approx(-1.0, abs=0.1)
    rig.command(Command.NAV_LAND)
    fastest = 0.0
    start_s = rig.t_s
    while rig.stub.armed:
        rig.step()
        fastest = max(fastest, rig.plant.velocity_ned_m_s[2])
        assert rig.t_s - start_s < 20.0
    assert 0.6 < fastest < 0.85, "MPC_LAND_SPEED is 0.7"
    assert rig.stub.rotors == (0.0, 0.0, 0.0, 0.0)
    assert rig.height_m == pytest.approx(0.0, abs=1e-6)
    assert rig.texts() == ["Landing detected", "Disarmed by landing"]


def test_setpoints_act_after_the_configured_delay() -> None:
    rig = Rig(setpoint_delay_s=0.02)
    rig.run(0.5)
    stream(rig, 0.2, AttitudeTarget(LEVEL, 0.05))
    rig.mode(6)
    rig.arm()
    stream(rig, 0.1, AttitudeTarget(LEVEL, 0.05))
    rig.run(0.04)
    rig.stub.on_setpoint(rig.t_s, AttitudeTarget(LEVEL, 0.3))
    took_s = run_until(rig, lambda: rig.stub.target.thrust == 0.3, 1.0)
    assert took_s == pytest.approx(0.02, abs=PERIOD_S)


def test_offboard_follows_position_and_velocity_setpoints() -> None:
    rig = hovering()
    stream(rig, 0.1, PositionTarget((0.8, -0.4, -1.3), yaw_rad=0.5))
    assert rig.mode(6) is Result.ACCEPTED
    stream(rig, 8.0, PositionTarget((0.8, -0.4, -1.3), yaw_rad=0.5))
    assert rig.plant.position_ned_m == pytest.approx((0.8, -0.4, -1.3), abs=0.1)
    assert rig.stub.heading_rad == pytest.approx(0.5, abs=0.05)
    stream(rig, 3.0, PositionTarget(velocity_ned_m_s=(0.3, 0.0, 0.0), yaw_rad=0.5))
    assert rig.plant.velocity_ned_m_s == pytest.approx((0.3, 0.0, 0.0), abs=0.08)


def test_a_landing_that_ends_before_the_estimate_expires_disarms() -> None:
    """Without position PX4 wants 8 s of idle thrust to believe that it has landed; the rotors stay idle meanwhile."""
    rig = hovering()
    rig.vision = False
    rig.run(0.15)
    rig.command(Command.NAV_LAND)
    assert run_until(rig, lambda: rig.stub.landed, 4.4) > 1.5
    rig.run(3.0)
    assert rig.stub.armed
    assert rig.stub.nav_state is NavState.DESCEND
    assert not rig.stub.landed, "the position is invalid by now"
    assert rig.stub.target.thrust == 0.0
    run_until(rig, lambda: not rig.stub.armed, 12.0)
    assert rig.height_m == 0.0
