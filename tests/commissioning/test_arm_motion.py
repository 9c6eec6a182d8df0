"""The arm's motion on the ground: bounded in speed, torque and angle, and ended by everything that should end it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from companion.commissioning.arm.jog import KEY_TIMEOUT_S, STEP_DEG, ByKeys, keys_in
from companion.commissioning.arm.motion import SPEED_MAX_DEG_S, TORQUE_SHARE, Motion, Moved, limits_deg
from companion.commissioning.arm.sweep import Sweeper, legs_of
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.types import IDENTITY_QUAT, ArmState, Joints
from tests.commissioning.arm_rig import SHIPPED
from tests.support import tool_of

DT_S = 0.005
INERTIA_KG_M2 = (0.06, 0.02)
FRICTION_NM = 0.05
PATIENCE = 100_000


@pytest.fixture(scope="module")
def vehicle() -> Vehicle:
    return load_vehicle(SHIPPED)


class Bench:
    """Two joints with inertia, gravity and dry friction, led by a `Motion`."""

    def __init__(self, vehicle: Vehicle, at_deg: Joints = (90.0, 10.0)) -> None:
        self.vehicle = vehicle
        self.manipulator = manipulator_of(vehicle)
        self.angle = [math.radians(deg) for deg in at_deg]
        self.rate = [0.0, 0.0]
        self.t_s = 0.0
        self.temperature_c = 40.0
        self.errors = (0, 0)
        self.sign = (1.0, 1.0)
        self.disturbance: Callable[[list[float]], Joints] = lambda _: (0.0, 0.0)
        self.torque: Joints = (0.0, 0.0)
        self.motion = Motion(vehicle, self.state())
        self.fastest_deg_s = 0.0
        self.strongest_nm = [0.0, 0.0]

    def state(self) -> ArmState:
        first, second = self.angle
        return ArmState(
            stamp_s=self.t_s,
            angle_rad=(first, second),
            velocity_rad_s=(self.rate[0], self.rate[1]),
            torque_nm=self.torque,
            hardware_error=self.errors,
            temperature_c=(self.temperature_c, self.temperature_c),
            read_failures=0,
        )

    def step(self) -> Moved:
        self.t_s += DT_S
        moved = self.motion.step(self.state(), DT_S)
        self.torque = moved.torque_nm
        gravity = self.manipulator.gravity_torque_nm((self.angle[0], self.angle[1]), IDENTITY_QUAT)
        beside = self.disturbance(self.angle)
        for j in (0, 1):
            net = self.sign[j] * moved.torque_nm[j] - gravity[j] + beside[j]
            drag = min(FRICTION_NM, abs(net) if self.rate[j] == 0.0 else FRICTION_NM)
            before = self.rate[j]
            self.rate[j] += (net - math.copysign(drag, self.rate[j] or net)) / INERTIA_KG_M2[j] * DT_S
            if before and before * self.rate[j] < 0.0:
                self.rate[j] = 0.0
            self.angle[j] += self.rate[j] * DT_S
            self.strongest_nm[j] = max(self.strongest_nm[j], abs(moved.torque_nm[j]))
        self.fastest_deg_s = max(self.fastest_deg_s, *(abs(math.degrees(rate)) for rate in self.rate))
        return moved

    def until(self, done: Callable[[Moved], bool]) -> Moved:
        for _ in range(PATIENCE):
            moved = self.step()
            if moved.stop or done(moved):
                return moved
        raise AssertionError("it never came to an end")

    @property
    def degrees(self) -> Joints:
        return math.degrees(self.angle[0]), math.degrees(self.angle[1])


class Keys:
    """Keys that a terminal has sent."""

    def __init__(self) -> None:
        self.sent = ""

    def take(self) -> str:
        taken, self.sent = self.sent, ""
        return taken


def test_a_joint_reaches_its_goal_slowly_and_the_other_one_stays(vehicle: Vehicle) -> None:
    bench = Bench(vehicle)
    bench.motion.go(0, math.radians(140.0), math.radians(99.0))
    moved = bench.until(lambda m: m.reached)
    assert moved.stop == "" and bench.degrees == pytest.approx((140.0, 10.0), abs=1.0)
    assert bench.fastest_deg_s + 1.0 > SPEED_MAX_DEG_S and bench.fastest_deg_s < 1.5 * SPEED_MAX_DEG_S
    assert bench.t_s > 50.0 / SPEED_MAX_DEG_S
    assert all(
        most <= TORQUE_SHARE * joint.torque_max_nm
        for most, joint in zip(bench.strongest_nm, vehicle.arm.joints, strict=True)
    )


def test_no_goal_lies_beyond_a_joint_limit(vehicle: Vehicle) -> None:
    for joint, goal_deg in ((0, 400.0), (1, -400.0)):
        bench = Bench(vehicle, (120.0, 60.0))
        bench.motion.go(joint, math.radians(goal_deg), math.radians(20.0))
        assert bench.until(lambda m: m.reached).stop == ""
        low, high = limits_deg(vehicle.arm, joint)
        assert bench.degrees[joint] == pytest.approx(high if goal_deg > 0 else low, abs=1.0)


@pytest.mark.parametrize("torque_max_nm", [None, 0.75])
def test_an_obstacle_stops_the_arm_before_the_torque_is_high(torque_max_nm: float | None) -> None:
    """A small servo that cannot press as hard stops at its torque limit."""
    small = [] if torque_max_nm is None else [f"vehicle.arm.joints[1].torque_max_nm={torque_max_nm}"]
    bench = Bench(load_vehicle(SHIPPED, small))
    obstacle_rad = math.radians(40.0)
    bench.disturbance = lambda angle: (0.0, -200.0 * max(0.0, angle[1] - obstacle_rad))
    bench.motion.go(1, math.radians(80.0), math.radians(20.0))
    moved = bench.until(lambda m: m.reached)
    assert moved.stop.startswith("joint 2: +0.") and "obstacle" in moved.stop and moved.torque_nm == (0.0, 0.0)
    assert torque_max_nm is not None or bench.degrees[1] < 41.0


@pytest.mark.parametrize("joint", [0, 1])
def test_a_wrong_sign_ends_before_it_goes_far(vehicle: Vehicle, joint: int) -> None:
    bench = Bench(vehicle, (90.0, 40.0))
    bench.sign = (-1.0, 1.0) if joint == 0 else (1.0, -1.0)
    begin = bench.degrees
    bench.motion.go(joint, bench.angle[joint] + 0.5, math.radians(20.0))
    assert bench.until(lambda m: m.reached).stop
    assert abs(bench.degrees[joint] - begin[joint]) < 15.0


def test_hot_servos_and_hardware_errors_stop_it(vehicle: Vehicle) -> None:
    for change, words in (
        ({"temperature_c": 66.0}, "66 degC"),
        ({"errors": (0, 0x20)}, "joint 2: hardware error: overload"),
        ({"errors": (0x80, 0)}, "joint 1: the bus watchdog tripped"),
    ):
        bench = Bench(vehicle)
        bench.motion.go(0, math.radians(120.0), math.radians(20.0))
        for name, value in change.items():
            setattr(bench, name, value)
        moved = bench.step()
        assert words in moved.stop and moved.torque_nm == (0.0, 0.0)


def test_a_pose_that_is_too_heavy_is_refused_before_anything_moves(vehicle: Vehicle) -> None:
    heavy = vehicle.model_copy(update={"tool": tool_of(vehicle).model_copy(update={"net_mass_kg": 0.5})})
    motion = Motion(heavy, Bench(heavy).state())
    assert motion.refusal([(math.radians(90.0), 0.0)]) == ""
    assert "joint 1 carries" in motion.refusal([(math.radians(90.0), 0.0), (math.radians(165.0), 0.0)])


def test_a_held_key_moves_a_released_one_stops(vehicle: Vehicle) -> None:
    bench, keys = Bench(vehicle), Keys()
    leader = ByKeys(keys.take)
    leader.begin(bench.state())
    moved: Moved | None = None

    def run(seconds: float, key: str = "", every_s: float = 0.03) -> None:
        nonlocal moved
        for tick in range(round(seconds / DT_S)):
            if key and tick % round(every_s / DT_S) == 0:
                keys.sent += key
            moved = bench.step()
            assert not leader.update(bench.motion, moved, bench.state())

    run(0.1)
    keys.sent += "2"
    run(2.0, "+")
    held_deg = bench.degrees[1]
    assert held_deg - 10.0 > 0.6 * 2.0 * SPEED_MAX_DEG_S
    run(3.0)
    assert bench.degrees[1] - held_deg <= STEP_DEG + 1.0
    assert bench.degrees[0] == pytest.approx(90.0, abs=1.0)
    stays_deg = bench.degrees[1]
    keys.sent += "+x"
    run(1.0)
    assert bench.degrees[1] == pytest.approx(stays_deg, abs=0.3), "any other key stops it"
    keys.sent += "q"
    assert leader.update(bench.motion, moved, bench.state())


def test_a_key_times_out_and_without_keys_it_ends(vehicle: Vehicle) -> None:
    bench, keys = Bench(vehicle), Keys()
    leader = ByKeys(keys.take)
    leader.begin(bench.state())
    keys.sent += "+"
    leader.update(bench.motion, None, bench.state())
    late = replace(bench.state(), stamp_s=KEY_TIMEOUT_S + 0.1)
    leader.update(bench.motion, None, late)
    before = bench.motion.reference_rad
    bench.step()
    assert bench.motion.reference_rad == before
    assert leader.update(bench.motion, None, replace(bench.state(), stamp_s=1000.0)), "without any key it ends"


def test_what_a_terminal_sends_is_taken_apart() -> None:
    assert keys_in("\x1b[C\x1b[Dq1") == ["\x1b[C", "\x1b[D", "q", "1"]
    assert keys_in("\x1b") == ["\x1b"]


def test_the_sweeps_keep_samples_of_both_ways_at_both_speeds_and_end_hanging(vehicle: Vehicle) -> None:
    bench = Bench(vehicle, (165.0, 140.0))
    sweeper = Sweeper(legs_of(vehicle), vehicle.arm.torque_constants_nm_a)

    assert bench.until(lambda moved: sweeper.update(bench.motion, moved, bench.state())).stop == ""
    assert bench.degrees == pytest.approx((90.0, 0.0), abs=1.0)
    seen = {(one.joint, one.direction, sweeper.legs[one.leg].speed_deg_s) for one in sweeper.samples}
    assert len(seen) == 8
    for number, leg in enumerate(sweeper.legs):
        speeds = [one.velocity_rad_s * one.direction for one in sweeper.samples if one.leg == number]
        if leg.counts:
            assert math.degrees(math.fsum(speeds) / len(speeds)) == pytest.approx(leg.speed_deg_s, rel=0.05)


def test_joint_limits_without_room_to_sweep_are_one_line() -> None:
    narrow = load_vehicle(
        SHIPPED, ["vehicle.arm.joints[0].angle_deg=[80, 100]", "vehicle.safety.fold_arm_deg=[90, 140]"]
    )
    with pytest.raises(ConfigError, match=r"arm.joints\[0\].angle_deg"):
        legs_of(narrow)
