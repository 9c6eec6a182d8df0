"""Motion capture against the IMU: what the observer finds, and what it must not take for a drag."""

from __future__ import annotations

import itertools
import math

import pytest

from companion.model.types import Vec3
from companion.safety.inertial_check import IMU_LATE_MAX_S, SETTLE_S, InertialCheck, RemoteClock

IMU_S = 0.005
GAP_MAX_S = 0.12


def check() -> InertialCheck:
    """An observer with the vehicle file's defaults."""
    return InertialCheck(0.015, 0.05, GAP_MAX_S)


def swaying_m(t_s: float) -> float:
    """Flight to and fro by 0.5 m, accelerated by up to 2 m/s2."""
    return 0.5 * math.cos(2.0 * t_s)


def found_s(
    *,
    speed_m_s: float = 0.0,
    growing_m_s2: float = 0.0,
    bias_m_s2: float = 0.0,
    step_m: float = 0.0,
    every: int = 2,
    start_s: float = 6.0,
    flight_s: float = 16.0,
    late: bool = False,
    axis: int = 0,
) -> float | None:
    """Seconds from the start of a disturbance to the alarm of a flight that sways; None if there was no alarm.

    Args:
        speed_m_s: speed of the drag.
        growing_m_s2: acceleration of the drag.
        bias_m_s2: error of the horizontal acceleration, from the first sample on.
        step_m: lasting shift.
        every: IMU samples for each pose.
        start_s: time at which the drag or shift starts.
        flight_s: length of the flight.
        late: every second the loop stands still for 0.1 s: the samples and the newest pose of that time come together.
        axis: direction of the sway, the bias and the drag.
    """

    def along(size: float) -> Vec3:
        return (size if axis == 0 else 0.0, size if axis == 1 else 0.0, size if axis == 2 else 0.0)

    observer = check()
    delta_m_s, before_s = 0.0, -IMU_S
    for k in itertools.count():
        t_s = k * IMU_S
        if t_s > flight_s:
            return None
        # The mean acceleration over the sample's interval, as an IMU measures it.
        mean = (swaying_m(t_s) - 2.0 * swaying_m(t_s - IMU_S) + swaying_m(t_s - 2.0 * IMU_S)) / IMU_S**2
        delta_m_s += (mean + bias_m_s2) * IMU_S
        if late and 0 < k % 200 < 20:
            continue
        observer.imu(t_s, t_s - before_s, along(delta_m_s))
        delta_m_s, before_s = 0.0, t_s
        if k % every:
            continue
        since_s = max(0.0, t_s - start_s)
        shift_m = speed_m_s * since_s + 0.5 * growing_m_s2 * since_s**2 + (step_m if since_s > 0.0 else 0.0)
        if observer.pose(t_s, along(swaying_m(t_s) + shift_m), 0.0):
            return t_s - start_s
    return None


@pytest.mark.parametrize(("every", "axis"), [(1, 0), (2, 0), (4, 0), (2, 1), (2, 2)])
def test_a_drag_that_starts_at_0_3_m_s_is_found_within_0_2_s(every: int, axis: int) -> None:
    after_s = found_s(speed_m_s=0.3, every=every, axis=axis)
    assert after_s is not None and 0.0 < after_s < 0.2


def test_a_drag_is_found_by_a_loop_that_stands_still_for_a_tenth_of_a_second_every_second() -> None:
    """No sample is missing, so the observer goes on: on an overloaded computer it would otherwise never settle."""
    assert found_s(late=True) is None
    after_s = found_s(speed_m_s=0.3, late=True)
    assert after_s is not None and 0.0 < after_s < 0.3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_true_motion_with_a_constant_bias_of_0_2_m_s2_raises_nothing(axis: int) -> None:
    assert found_s(bias_m_s2=0.2, axis=axis) is None


def test_a_drag_that_begins_slowly_is_not_found() -> None:
    """The limit of the method, as docs/internals/safety-case.md names it: the observer follows, whatever speed is reached."""
    assert found_s(growing_m_s2=0.4) is None
    assert found_s(growing_m_s2=0.7) is not None


def test_a_lasting_shift_of_one_centimetre_is_accepted_and_one_of_five_is_not() -> None:
    assert found_s(step_m=0.01) is None
    after_s = found_s(step_m=0.05)
    assert after_s is not None and after_s < 0.1


def test_nothing_is_judged_until_the_observer_has_settled() -> None:
    assert found_s(speed_m_s=1.0, start_s=0.0, flight_s=SETTLE_S - 0.1) is None


@pytest.mark.parametrize("imu_gap", [True, False])
def test_after_a_gap_the_observer_starts_again(imu_gap: bool) -> None:
    """Whatever happened in the gap was not measured: 1 m further afterwards is no drag."""
    observer = check()
    gap_s = GAP_MAX_S + 0.01
    before_s = -IMU_S
    alarms = []
    for k in range(2000):
        late_s, there_m = (gap_s, 1.0) if k >= 1000 else (0.0, 0.0)
        t_s = k * IMU_S + late_s
        imu_s = t_s if imu_gap else k * IMU_S
        observer.imu(imu_s, imu_s - before_s, (0.0, 0.0, 0.0))
        before_s = imu_s
        alarms.append(observer.pose(t_s, (there_m, 0.0, 1.0), 0.0))
    assert not any(alarms)
    assert observer.innovation_m < 1e-6


def test_a_lost_imu_does_not_report_dragged_poses() -> None:
    """The link to PX4 is lost at 1 m/s; motion capture goes on."""
    observer = check()
    for k in range(1400):
        t_s = k * IMU_S
        imu_s = min(t_s, 6.0)
        if imu_s == t_s:
            observer.imu(imu_s, IMU_S, (0.0, 0.0, 0.0))
        assert not observer.pose(t_s, (t_s, 0.0, 1.0), max(-IMU_LATE_MAX_S, imu_s - t_s))


def test_an_old_pose_of_a_moving_vehicle_is_held_against_where_it_was_then() -> None:
    """Motive delays the poses by 50 ms more in the middle of the flight and says so; the vehicle flies at 1 m/s."""
    observer = check()
    for k in range(2400):
        t_s = k * IMU_S
        age_s = 0.05 if k >= 1200 else 0.0
        observer.imu(t_s, IMU_S, (0.0, 0.0, 0.0))
        assert not observer.pose(t_s, (t_s - age_s, 0.0, 1.0), age_s)


def test_a_late_message_moves_no_clock() -> None:
    """Messages take 2 ms, every fifth one up to 80 ms more, and the device's clock is 50 ppm slow."""
    clock = RemoteClock()
    for k in range(10_000):
        remote_s = k * IMU_S
        arrived_s = 1000.0 + remote_s * (1.0 + 50e-6) + 0.002 + (0.02 * (k % 5) if k % 5 == 4 else 0.0)
        assert clock.local_s(remote_s, arrived_s) == pytest.approx(1000.002 + remote_s * (1.0 + 50e-6), abs=1e-4)


@pytest.mark.parametrize("jump_s", [-300.0, 300.0])
def test_the_clock_of_a_device_that_restarts_is_learned_anew(jump_s: float) -> None:
    clock = RemoteClock()
    assert clock.local_s(500.0, 7.0) == pytest.approx(7.0)
    assert clock.local_s(500.0 + jump_s, 8.0) == pytest.approx(8.0)
