"""The servo bus of the fast closed loop: the outcome of the companion's bus set-up, computed without a pty."""

from __future__ import annotations

from collections.abc import Sequence

from companion.config.vehicle import Joint, Vehicle
from companion.io.dynamixel.registers import JointScale, joint_scale
from sitl.servo import registers as reg
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel
from sitl.servo.protocol import Instruction, packet, status

_LIMIT = reg.CURRENT_LIMIT
_READ_LIMIT = bytes((Instruction.READ, *_LIMIT.address.to_bytes(2, "little"), *_LIMIT.size.to_bytes(2, "little")))


def scales_of(vehicle: Vehicle, servos: Sequence[ServoModel]) -> tuple[JointScale, JointScale] | None:
    """Return the scale of each joint, or None where the companion's set-up of the bus fails.

    Args:
        vehicle: vehicle file with the assumed ids, baud rate and torques.
        servos: all servos that are connected to the bus.

    Returns:
        None if a servo is not the only one to answer at the vehicle file's id and baud rate, or if its current limit is below
        what `torque_max_nm` needs.
    """
    line, arm = ServoLine(servos), vehicle.arm
    first, second = (_current_limit_counts(line, joint, vehicle.devices.arm.baud) for joint in arm.joints)
    if first is None or second is None:
        return None
    try:
        return (
            joint_scale(arm.joints[0], arm.torque_per_amp_nm_a, first),
            joint_scale(arm.joints[1], arm.torque_per_amp_nm_a, second),
        )
    except ValueError:  # the current limit is too low
        return None


def _current_limit_counts(line: ServoLine, joint: Joint, baud_bps: int) -> int | None:
    own = [servo for servo in line.servos if servo.servo_id == joint.servo_id]
    answer = line.feed(packet(joint.servo_id, _READ_LIMIT), baud_bps)
    if len(own) != 1:
        return None
    data = own[0].read(_LIMIT.address, _LIMIT.size)
    return _LIMIT.decode(data) if answer == status(joint.servo_id, 0, data) else None
