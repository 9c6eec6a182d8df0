"""Builds the servos configured in `world.servos`, for real-time simulation and for the fast closed loop."""

from __future__ import annotations

from collections.abc import Sequence

from companion.config.arm import Joint
from companion.config.devices import ArmDevice
from companion.config.vehicle import Vehicle
from companion.sitl_config.world import Servo, World
from sitl.servo import registers as reg
from sitl.servo.drive import MODE_CURRENT_POSITION
from sitl.servo.kinds import KINDS
from sitl.servo.model import ServoModel


def servos_of(vehicle: Vehicle, config: World) -> list[ServoModel]:
    """Return the servo of each joint, whether or not it is plugged in."""
    joints, mechanics = vehicle.arm.joints, config.servo_mechanics
    servos = [servo_of(joint, vehicle.arm_device, config.servo(index)) for index, joint in enumerate(joints)]
    for servo in servos:
        servo.drive.current_loop_s = mechanics.current_loop_s if mechanics.on else 0.0
    return servos


def jaws_servo_of(vehicle: Vehicle) -> ServoModel | None:
    """Return the servo of the clamp; None without a clamp."""
    jaws = vehicle.jaws
    if jaws is None:
        return None
    servo = ServoModel(jaws.servo_id, baud_bps=vehicle.arm_device.baud, kind=jaws.servo)
    servo.write(reg.OPERATING_MODE.address, reg.OPERATING_MODE.encode(MODE_CURRENT_POSITION))
    return servo


def plugged_in(servos: Sequence[ServoModel], config: World) -> list[ServoModel]:
    """Return the servos that are connected to the bus."""
    return [servo for index, servo in enumerate(servos) if config.servo(index).connected]


def torque_constants_nm_a(vehicle: Vehicle) -> tuple[float, ...]:
    """Return the torque constant of each joint's servo in N m/A: that of the vehicle file, or of the servo's model."""
    arm = vehicle.arm
    return tuple(joint.torque_per_amp_nm_a or arm.torque_per_amp_nm_a or _nm_per_amp(joint) for joint in arm.joints)


def _nm_per_amp(joint: Joint) -> float:
    return KINDS[joint.servo].nm_per_amp if joint.servo is not None else joint.kind.torque_per_amp_nm_a


def servo_of(joint: Joint, device: ArmDevice, settings: Servo) -> ServoModel:
    """Return the servo of a joint.

    Args:
        joint: joint of the vehicle file; gives the servo's model, and its id unless `settings` does.
        device: arm device of the vehicle file; gives the baud rate unless `settings` does.
    """
    servo = ServoModel(
        joint.servo_id if settings.id is None else settings.id,
        baud_bps=device.baud if settings.baud is None else settings.baud,
        kind=joint.kind.name if settings.model is None else settings.model,
        firmware=settings.firmware,
    )
    low, high = settings.position_limit_counts
    for register, value in (
        (reg.RETURN_DELAY, settings.return_delay_us // 2),
        (reg.DRIVE_MODE, settings.drive_mode),
        (reg.OPERATING_MODE, settings.operating_mode),
        (reg.SECONDARY_ID, settings.shadow_id),
        (reg.MIN_POSITION_LIMIT, low),
        (reg.MAX_POSITION_LIMIT, high),
    ):
        servo.write(register.address, register.encode(value))
    if settings.current_limit_counts is not None:
        servo.write(reg.CURRENT_LIMIT.address, reg.CURRENT_LIMIT.encode(settings.current_limit_counts))
    return servo
