"""The servos as the world's settings want them, over wires as in the fast closed loop."""

from __future__ import annotations

from collections.abc import Sequence

from companion.config.vehicle import ArmDevice, Joint, Vehicle
from companion.sitl_config.world import Servo, World
from sitl.servo import registers as reg
from sitl.servo.model import ServoModel


def servos_of(vehicle: Vehicle, config: World) -> list[ServoModel]:
    """Return the servo of each joint, whether or not it is plugged in."""
    joints, device = vehicle.arm.joints, vehicle.devices.arm
    return [servo_of(joint, device, config.servo(index)) for index, joint in enumerate(joints)]


def plugged_in(servos: Sequence[ServoModel], config: World) -> list[ServoModel]:
    """Return the servos whose plug is in the bus."""
    return [servo for index, servo in enumerate(servos) if config.servo(index).connected]


def servo_of(joint: Joint, device: ArmDevice, knobs: Servo) -> ServoModel:
    """The servo that is built into a joint.

    Args:
        joint: its id, unless the knobs say another.
        device: the bus's baud rate, unless the knobs say another.
        knobs: what is true of it.
    """
    servo = ServoModel(
        joint.servo_id if knobs.id is None else knobs.id,
        baud_bps=device.baud if knobs.baud is None else knobs.baud,
        firmware=knobs.firmware,
    )
    low, high = knobs.position_limit_counts
    for register, value in (
        (reg.RETURN_DELAY, knobs.return_delay_us // 2),
        (reg.DRIVE_MODE, knobs.drive_mode),
        (reg.OPERATING_MODE, knobs.operating_mode),
        (reg.SECONDARY_ID, knobs.shadow_id),
        (reg.CURRENT_LIMIT, knobs.current_limit_counts),
        (reg.MIN_POSITION_LIMIT, low),
        (reg.MAX_POSITION_LIMIT, high),
    ):
        servo.write(register.address, register.encode(value))
    return servo
