"""The guide: what a hand does is understood, what is done otherwise than asked is reported, and the numbers are those of the arm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.commissioning.arm.poses import steps_of
from companion.commissioning.arm.zero import HELD_S, ZeroGuide, ZeroView
from companion.config.arm import Arm
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.io.dynamixel.scale import RAD_PER_COUNT
from companion.model.servos import COUNTS_PER_TURN
from companion.model.types import Joints
from tests.commissioning.arm_rig import SHIPPED

STEP_S = 0.02
FOLDED: Joints = (165.0, 140.0)


@cache
def arm_with(limits: tuple[Joints, Joints] = ((60.0, 175.0), (-10.0, 150.0))) -> Arm:
    angles = [f"vehicle.arm.joints[{i}].angle_deg={list(limits[i])}" for i in (0, 1)]
    folded = f"vehicle.safety.fold_arm_deg={[sum(limit) / 2 for limit in limits]}"
    return load_vehicle(SHIPPED, [*angles, folded, "vehicle.arm.poses={}"]).arm


class Bench:
    """An arm with its own truth, and a hand."""

    def __init__(self, arm: Arm, signs: Sequence[int], zeros: Sequence[int], plugs: Sequence[int] = (0, 1)) -> None:
        self.guide = ZeroGuide(arm)
        self.signs, self.zeros, self.plugs = signs, zeros, plugs
        self.t_s = 0.0
        self.at: list[float] = (
            list(FOLDED) if len(plugs) == 2 else [angle - 20.0 for angle in self.guide.steps[0].pose_deg]
        )

    def counts(self) -> tuple[int, ...]:
        """`plugs[servo]` is the joint that the vehicle file's servo really sits in."""
        angles = zip(self.zeros, self.signs, self.at, strict=True)
        joint = [zero + sign * round(math.radians(at) / RAD_PER_COUNT) for zero, sign, at in angles]
        return tuple(joint[plug] for plug in self.plugs)

    def look(self, accept: bool = False) -> ZeroView:
        self.t_s += STEP_S
        return self.guide.update(self.t_s, self.counts(), accept)

    def move(self, to: Joints, steps: int = 40) -> ZeroView:
        begin = list(self.at)
        for i in range(1, steps + 1):
            self.at = [a + i / steps * (b - a) for a, b in zip(begin, to, strict=True)]
            view = self.look()
        return view

    def hold(self) -> ZeroView:
        for _ in range(round(HELD_S / STEP_S) + 2):
            view = self.look()
            if view.result is not None or view.failed or not any(view.moved_deg):
                break
        return view

    def through(self) -> ZeroView:
        for step in self.guide.steps:
            self.move(step.pose_deg)
            view = self.hold()
        return view


@settings(max_examples=20)
@given(
    st.tuples(st.sampled_from((-1, 1)), st.sampled_from((-1, 1))),
    st.tuples(st.integers(0, 4095), st.integers(0, 4095)),
    st.booleans(),
    st.sampled_from(
        (((60.0, 175.0), (-10.0, 150.0)), ((-20.0, 175.0), (-150.0, 150.0)), ((70.0, 130.0), (-140.0, 40.0)))
    ),
)
def test_every_sign_zero_and_plug_is_reported(
    signs: Joints, zeros: Joints, swapped: bool, limits: tuple[Joints, Joints]
) -> None:
    arm = arm_with(limits)
    bench = Bench(arm, [int(s) for s in signs], [int(z) for z in zeros], (1, 0) if swapped else (0, 1))
    result = bench.through().result
    assert result is not None and result.swapped == swapped
    for index, found in enumerate(result.joints):
        assert found.sign == signs[index]
        off = (found.zero_count - zeros[index] + COUNTS_PER_TURN / 2) % COUNTS_PER_TURN - COUNTS_PER_TURN / 2
        assert abs(off) <= 2
        assert found.servo_id == arm.joints[1 - index if swapped else index].servo_id
        assert 0 <= found.zero_count < COUNTS_PER_TURN


def test_a_hand_s_two_degrees_are_left_alone_and_ten_are_not() -> None:
    arm = arm_with()
    for off_counts, expected in ((0, set()), (15, set()), (-15, set()), (120, {("arm", "joints", 0, "zero_count")})):
        result = Bench(arm, (1, -1), (1024 + off_counts, 3072)).through().result
        assert result is not None and set(result.changes(arm)) == expected


def test_a_pose_counts_only_after_the_arm_was_moved_or_with_a_confirmation() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    bench.at = list(bench.guide.steps[0].pose_deg)
    assert bench.hold().number == 1
    for _ in range(round(HELD_S / STEP_S) + 2):
        view = bench.look(accept=True)
    assert view.number == 2


def test_both_joints_at_once_are_reported_and_put_right() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    bench.move(bench.guide.steps[0].pose_deg)
    assert bench.hold().number == 2
    view = bench.move((130.0, 90.0))
    assert "two joints have moved" in view.notice and bench.hold().number == 2
    bench.move((90.0, 90.0))
    assert bench.hold().number == 3


def test_half_a_turn_is_reported() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    bench.move(bench.guide.steps[0].pose_deg)
    bench.hold()
    assert bench.move((90.0, 40.0)).notice.startswith("requested 90 deg, but the joint has turned by")
    assert bench.hold().number == 2


def test_the_same_joint_twice_is_reported() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    for pose in ((90.0, 0.0), (90.0, 90.0), (90.0, 45.0)):
        bench.move(pose)
        view = bench.hold()
    assert view.result is None and "turned in two steps" in view.failed


def test_poses_that_disagree_are_reported() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    for pose in ((90.0, 0.0), (90.0, 105.0), (135.0, 105.0)):
        bench.move(pose)
        view = bench.hold()
    assert view.result is None and "joint 2: the poses disagree by 15" in view.failed


def test_an_arm_that_sways_is_not_held() -> None:
    bench = Bench(arm_with(), (1, -1), (1024, 3072))
    for i in range(400):
        bench.at = [90.0 + 3.0 * math.sin(0.3 * i), 0.0]
        assert bench.look().number == 1


@pytest.mark.parametrize("limits", [((100.0, 175.0), (-10.0, 150.0)), ((85.0, 100.0), (-10.0, 150.0))])
def test_joint_limits_that_leave_no_pose_are_one_line(limits: tuple[Joints, Joints]) -> None:
    with pytest.raises(ConfigError) as caught:
        steps_of(arm_with(limits))
    assert len(caught.value.lines) == 1 and caught.value.lines[0].startswith("arm.joints[")
