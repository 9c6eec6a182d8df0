"""The arm's tools with another number of joints than two, and with other servos than the shipped ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
from msgspec.structs import replace

from companion.commissioning.arm.motion import Motion
from companion.commissioning.arm.scan import judge
from companion.commissioning.arm.servo import SETTINGS, FoundServo, Scan, assign, settings
from companion.commissioning.arm.setup import plan
from companion.commissioning.arm.sweep import REACH_DEG, Sweeper, hanging_deg, legs_of
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.io.dynamixel import registers as dxl
from companion.model.check_row import Level
from companion.model.exit_codes import EXIT_OK
from companion.model.servos import COUNTS_PER_TURN
from companion.model.types import IDENTITY_QUAT, ArmState
from companion.preflight import arm as preflight
from sitl.servo.model import ServoModel
from tests.commissioning.arm_rig import FILES, SHIPPED, bench
from tests.commissioning.test_arm_zero import Bench
from tests.machines import vehicle_with_joints
from tests.preflight import records

MIXED = (
    "vehicle.arm.joints[0].servo=XM540-W270",
    "vehicle.arm.joints[0].velocity_max_deg_s=180",
    "vehicle.arm.joints[0].torque_max_nm=10",
    "vehicle.arm.torque_per_amp_nm_a=null",
)


def state(t_s: float, angle_rad: Sequence[float]) -> ArmState:
    still = (0.0,) * len(angle_rad)
    return ArmState(
        stamp_s=t_s,
        angle_rad=tuple(angle_rad),
        velocity_rad_s=still,
        torque_nm=still,
        hardware_error=(0,) * len(angle_rad),
        temperature_c=(30.0,) * len(angle_rad),
        read_failures=0,
    )


@pytest.mark.parametrize("count", [1, 3, 4])
def test_zeros_signs_and_plugs_of_any_number_of_joints_are_found(count: int) -> None:
    arm = vehicle_with_joints(count).arm
    signs, zeros = [1, -1, -1, 1][:count], [100, 4000, 2048, 1][:count]
    result = Bench(arm, signs, zeros, [count - 1, *range(count - 1)]).through().result
    assert result is not None and result.swapped == (count > 1)
    for joint, found in enumerate(result.joints):
        assert (found.servo_id, found.sign) == (arm.joints[(joint + 1) % count].servo_id, signs[joint])
        assert abs((found.zero_count - zeros[joint] + 2048) % COUNTS_PER_TURN - 2048) <= 1


@pytest.mark.parametrize("count", [1, 3, 4, "of a URDF"])
def test_in_the_hanging_pose_gravity_turns_no_joint(count: int | str) -> None:
    vehicle = vehicle_with_joints(count) if isinstance(count, int) else load_vehicle("tarot650_4r")
    pose_rad = tuple(map(math.radians, hanging_deg(vehicle)))
    torque_nm = manipulator_of(vehicle).gravity_torque_nm(pose_rad, IDENTITY_QUAT)
    assert torque_nm == pytest.approx((0.0,) * len(pose_rad), abs=1e-5)


@pytest.mark.parametrize("count", [1, 3, 4])
def test_sweeps_move_one_joint_at_a_time_and_sample_every_joint(count: int) -> None:
    """An arm that follows its reference exactly."""
    vehicle = vehicle_with_joints(count)
    sweeper = Sweeper(legs_of(vehicle), vehicle.arm.torque_constants_nm_a)
    t_s, angle = 0.0, tuple(map(math.radians, hanging_deg(vehicle)))
    motion, moved = Motion(vehicle, state(t_s, angle)), None
    sweeper.begin(state(t_s, angle))
    while not sweeper.update(motion, moved, state(t_s, angle)):
        assert t_s < 200.0
        t_s += 0.02
        moved = motion.step(state(t_s, angle), 0.02)
        assert moved.stop == ""
        assert sum(a != b for a, b in zip(angle, moved.reference_rad, strict=True)) <= 1
        angle = moved.reference_rad
    assert {sample.joint for sample in sweeper.samples} == set(range(count))
    assert math.degrees(angle[-1]) == pytest.approx(hanging_deg(vehicle)[-1])
    assert len(sweeper.legs) == 7 * count and REACH_DEG[1][1] > 0.0


def found(servo_id: int, servo: ServoModel) -> FoundServo:
    registers = {r.name: int.from_bytes(servo.read(r.address, r.size), "little", signed=r.signed) for r in SETTINGS}
    return FoundServo(
        servo_id=servo_id, baud=3_000_000, model=servo.model, firmware=servo.firmware, registers=registers
    )


def mixed() -> tuple[Vehicle, list[ServoModel]]:
    vehicle = load_vehicle(SHIPPED, MIXED)
    return vehicle, [ServoModel(joint.servo_id, kind=joint.kind.name) for joint in vehicle.arm.joints]


def test_servos_of_two_models_are_assigned_and_set_up_by_their_own_limits() -> None:
    vehicle, servos = mixed()
    servos[0].write(38, (1000).to_bytes(2, "little"))
    scan = Scan((3_000_000,), tuple(found(servo.servo_id, servo) for servo in servos), (), None)
    assert assign(scan.servos, vehicle.arm).others == ()
    assert judge(scan, vehicle).rows[2].read == "XM540-W270, XM430-W210"
    limit = next(
        s for s in settings(scan.servos[0], 0, vehicle.arm, vehicle.arm_device) if s.register is dxl.CURRENT_LIMIT
    )
    needed = math.floor(10.0 / (10.6 / 4.4 * 2.69e-3))
    assert limit.wanted == math.ceil(1.1 * needed) <= 2047
    assert plan(scan, vehicle.arm, vehicle.arm_device).refusal == ""


def test_the_preflight_judges_each_servo_by_its_own_model() -> None:
    small = (
        "vehicle.arm.joints[1].servo=XL330-M288",
        "vehicle.arm.joints[1].torque_max_nm=0.4",
        "vehicle.safety.servo_max_c=65",
    )
    vehicle = load_vehicle(SHIPPED, [*small, "vehicle.safety.servo_warn_c=60", "vehicle.arm.torque_per_amp_nm_a=null"])
    reports = (
        *records.servos()[:1],
        *records.servos(model=1200, firmware=52, voltage_v=5.0, current_limit_counts=1750)[1:],
    )
    rows = {row.id: row for row in preflight.rows(replace(records.sound(), servos=reports), vehicle)}
    assert rows["arm.model"].level is Level.WARN and "current is that of the supply" in rows["arm.model"].fix
    assert (rows["arm.firmware"].ok, rows["arm.firmware"].wanted) == (False, "38 or newer and 53 or newer")
    assert (rows["arm.voltage"].ok, rows["arm.voltage"].wanted) == (True, "10 to 14.8 V and 3.7 to 6 V")
    assert rows["arm.current_limit"].read == "1193 (4.19 N m) and 1750 (0.62 N m)"


def test_two_models_in_each_others_place_are_refused_by_name() -> None:
    vehicle, (strong, weak) = mixed()
    scan = Scan((3_000_000,), (found(weak.servo_id, strong), found(strong.servo_id, weak)), (), None)
    refusal = plan(scan, vehicle.arm, vehicle.arm_device).refusal
    assert "expected a readable XM430-W210, found XM540-W270 (model 1120)" in refusal


def test_a_servo_of_another_model_is_found_on_the_bus(tmp_path: Path) -> None:
    with bench(tmp_path, "[{model: XM540-W270}, {}]") as one:
        code, document = one.json("scan", "--baud", FILES)
    row = next(row for row in document["rows"] if row["id"] == "arm.scan.model")
    assert code != EXIT_OK and (row["read"], row["wanted"]) == ("id 1: XM540-W270 (model 1120)", "XM430-W210")
