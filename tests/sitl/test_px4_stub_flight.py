"""The PX4 stub flies a small rigid body, faster than real time and without sockets: own modes, OFFBOARD, losses."""

from __future__ import annotations

import copy
import math
from functools import cache

import pytest

from companion.config.safety import Safety
from companion.px4.versions import Release
from companion.safety.stop import StopModel
from sitl.autopilot.commander import Command, Result
from sitl.autopilot.land_detector import LandDetector
from sitl.autopilot.modes import NavState
from sitl.autopilot.origin import Origin
from sitl.autopilot.params import Params
from sitl.autopilot.setpoints import PositionTarget
from sitl.autopilot.types import AttitudeTarget
from tests.sitl.px4_rig import Rig

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


def stream(rig: Rig, duration_s: float, target: AttitudeTarget | PositionTarget) -> None:
    """A setpoint every 20 ms of world time."""
    until_s = rig.t_s + duration_s
    due_s = rig.t_s
    while rig.t_s < until_s:
        if rig.t_s >= due_s:
            rig.stub.on_setpoint(rig.t_s, target)
            due_s += 0.02
        rig.step()


def test_offboard_follows_position_and_velocity_setpoints() -> None:
    rig = hovering()
    stream(rig, 0.1, PositionTarget((0.8, -0.4, -1.3), yaw_rad=0.5))
    assert rig.mode(6) is Result.ACCEPTED
    stream(rig, 8.0, PositionTarget((0.8, -0.4, -1.3), yaw_rad=0.5))
    assert rig.plant.position_ned_m == pytest.approx((0.8, -0.4, -1.3), abs=0.1)
    assert rig.stub.heading_rad == pytest.approx(0.5, abs=0.05)
    stream(rig, 3.0, PositionTarget(velocity_ned_m_s=(0.3, 0.0, 0.0), yaw_rad=0.5))
    assert rig.plant.velocity_ned_m_s == pytest.approx((0.3, 0.0, 0.0), abs=0.08)


def drift_m(release: Release, tilt_deg: float, **params: float) -> tuple[float, float]:
    """How far LAND goes that begins in a fast and accelerated motion, and the speed at its beginning."""
    rig = hovering(**params)
    rig.params.release = release
    along = PositionTarget(velocity_ned_m_s=(0.6, 0.0, 0.0), yaw_rad=0.0)
    stream(rig, 0.1, along)
    assert rig.mode(6) is Result.ACCEPTED
    stream(rig, 3.0, along)
    half = math.radians(tilt_deg) / 2.0
    stream(rig, 0.2, AttitudeTarget((math.cos(half), 0.0, -math.sin(half), 0.0), rig.params.real("MPC_THR_HOVER")))
    assert rig.mode(4, 6) is Result.ACCEPTED
    begin_m, speed_m_s = rig.plant.position_ned_m, math.hypot(*rig.plant.velocity_ned_m_s[:2])
    farthest_m = 0.0
    for _ in range(1200):
        rig.step()
        farthest_m = max(farthest_m, math.dist(begin_m[:2], rig.plant.position_ned_m[:2]))
    return farthest_m, speed_m_s


@pytest.mark.parametrize("release", [(1, 16), (1, 18)])
@pytest.mark.parametrize("tilt_deg", [0.0, 10.0, 20.0])
def test_land_stops_as_modelled_whatever_the_acceleration_at_its_beginning(release: Release, tilt_deg: float) -> None:
    """With the required parameters."""
    far_m, speed_m_s = drift_m(release, tilt_deg)
    assert speed_m_s > 0.5
    assert far_m <= StopModel(Safety(react_time_s=0.0)).distance_m(speed_m_s)


def test_land_of_1_18_ends_the_acceleration_of_its_beginning_at_mpc_jerk_auto_only() -> None:
    assert drift_m((1, 18), 20.0, MPC_JERK_AUTO=6.0)[0] > drift_m((1, 16), 20.0, MPC_JERK_AUTO=6.0)[0] + 0.5


def test_a_landing_that_ends_before_the_estimate_expires_disarms() -> None:
    """Without a height PX4 wants 8 s of idle thrust to believe that it has landed; the rotors stay idle meanwhile."""
    rig = hovering(EKF2_BARO_CTRL=0, EKF2_NOAID_TOUT=5_000_000)
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


def test_with_a_barometer_that_is_a_metre_off_it_finds_the_floor_after_the_position_has_expired() -> None:
    rig = hovering(EKF2_BARO_CTRL=1)
    rig.baro_error_m = 1.0
    rig.run(20.0)
    assert rig.height_m == pytest.approx(1.0, abs=0.15), "poses hold the height"
    rig.vision = False
    rig.run(1.6)
    assert rig.stub.estimate is not None and rig.stub.estimate.height_valid and not rig.stub.estimate.position_valid
    assert rig.stub.nav_state is NavState.DESCEND
    run_until(rig, lambda: rig.stub.landed, 6.0)
    run_until(rig, lambda: not rig.stub.armed, 2.5)
    assert rig.height_m == 0.0


@pytest.mark.parametrize(("highest_m", "touches"), [(0.7, False), (1.4, True)], ids=["low-flight", "high-flight"])
def test_thrust_counts_as_low_below_30_percent_and_below_60_once_the_hover_thrust_is_estimated(
    highest_m: float, touches: bool
) -> None:
    """PX4 1.18 estimates the hover thrust only after it was a metre above the ground."""
    detector = LandDetector(Params({"MPC_THR_MIN": 0.1, "MPC_THR_HOVER": 0.5}))
    estimate = ready().stub.estimate
    assert estimate is not None
    for k in range(1000):
        height_m = highest_m if 100 < k < 400 else 0.0
        up = estimate._replace(position_ned_m=(0.0, 0.0, -height_m), velocity_ned_m_s=(0.0, 0.0, 0.0))
        detector.update(0.01 * k, k > 50, up, 0.5 if k < 400 else 0.28, True, 0.7)
    assert detector.ground_contact == touches
