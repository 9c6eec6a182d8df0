"""The servo's motor and encoder: the same behind the control table and alone, goal delay, watchdog."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.servo.drive import AMP_PER_COUNT, MODE_CURRENT, ServoDrive
from sitl.servo.model import ServoModel

STEP_S = 0.002
goals = st.one_of(st.none(), st.integers(-1193, 1193))
motion = st.lists(st.tuples(goals, st.floats(-20.0, 20.0), st.floats(-10.0, 10.0)), min_size=1, max_size=30)


def in_current_mode(goal_delay_s: float = 0.0) -> ServoDrive:
    drive = ServoDrive()
    drive.mode, drive.torque_on, drive.goal_delay_s = MODE_CURRENT, True, goal_delay_s
    return drive


@given(motion, st.sampled_from([0.0, 0.005]), st.sampled_from([None, 0.02, 0.1]))
def test_alone_and_behind_the_control_table_it_is_the_same_servo(
    course: list[tuple[int | None, float, float]], delay_s: float, watchdog_s: float | None
) -> None:
    """The fast loop's servo against the wire's: same currents, same readings to the bit."""
    servo = ServoModel(1)
    servo.goal_delay_s = delay_s
    servo.write(11, b"\x00")
    servo.write(64, b"\x01")
    servo.write(98, bytes([round((watchdog_s or 0.0) / 0.02)]))
    drive = in_current_mode(delay_s)
    drive.start_watchdog(watchdog_s)
    for step, (goal, angle, velocity) in enumerate(course):
        t_s = step * STEP_S * 10
        assert drive.update(t_s, angle, velocity) == servo.update(t_s, angle, velocity)
        assert drive.present() == struct.unpack("<hii", servo.read(126, 10))
        assert drive.watchdog_tripped == (servo.read(98, 1) == b"\xff")
        if goal is not None and not drive.watchdog_tripped:
            for one in (drive, servo.drive):
                one.heard_instruction()
            servo.write(102, struct.pack("<h", goal))
            drive.set_goal_current(goal)


@pytest.mark.parametrize(("delay_s", "steps"), [(0.0, 0), (0.004, 2), (0.005, 3)])
def test_a_goal_takes_effect_after_its_delay(delay_s: float, steps: int) -> None:
    drive = in_current_mode(delay_s)
    drive.update(0.0, 0.0, 0.0)
    drive.set_goal_current(100)
    currents = [drive.update((1 + k) * STEP_S, 0.0, 0.0) for k in range(8)]
    assert currents == [0.0] * steps + [100 * AMP_PER_COUNT] * (8 - steps)


def test_torque_off_and_a_changed_mode_do_not_wait_for_the_delay() -> None:
    servo = ServoModel(1)
    servo.goal_delay_s = 0.01
    servo.write(11, b"\x00")
    servo.write(64, b"\x01")
    servo.write(102, struct.pack("<h", 300))
    for k in range(7):
        current_a = servo.update(k * STEP_S, 0.0, 0.0)
    assert current_a == pytest.approx(300 * AMP_PER_COUNT)
    servo.write(102, struct.pack("<h", 200))  # on its way
    servo.write(64, b"\x00")
    assert servo.update(0.014, 0.0, 0.0) == 0.0
    servo.write(11, b"\x03")
    servo.write(11, b"\x00")
    servo.write(64, b"\x01")
    assert [servo.update(0.016 + k * STEP_S, 0.0, 0.0) for k in range(10)] == [0.0] * 10


def test_a_tripped_watchdog_forgets_what_was_on_its_way() -> None:
    drive = in_current_mode(0.010)
    drive.start_watchdog(0.02)
    drive.update(0.0, 0.0, 0.0)
    drive.set_goal_current(50)
    assert drive.update(0.020, 0.0, 0.0) == 0.0
    assert drive.update(0.030, 0.0, 0.0) == 0.0
    assert drive.watchdog_tripped
    drive.start_watchdog(0.02)
    drive.heard_instruction()
    assert drive.update(0.040, 0.0, 0.0) == 0.0, "the goal of before came back"
