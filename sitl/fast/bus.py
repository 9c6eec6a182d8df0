"""The servo bus of the fast closed loop: without a pty, it models the outcome of the companion's bus set-up, reads and writes."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from companion.config.vehicle import Joint, Vehicle
from companion.io.dynamixel.registers import WATCHDOG_ERROR, JointScale, joint_scale
from companion.model.types import ArmState, Joints
from sitl.faults.injector import COOL_C, Faults
from sitl.servo import registers as reg
from sitl.servo.bus import ServoLine
from sitl.servo.drive import MODE_CURRENT, ServoDrive
from sitl.servo.model import ServoModel
from sitl.servo.protocol import Instruction, packet, status

_HEALTHY = (0, 0)
_COOL = (COOL_C, COOL_C)
_LIMIT = reg.CURRENT_LIMIT
_READ_LIMIT = bytes((Instruction.READ, *_LIMIT.address.to_bytes(2, "little"), *_LIMIT.size.to_bytes(2, "little")))


def scales_of(vehicle: Vehicle, servos: Sequence[ServoModel]) -> tuple[JointScale, JointScale] | None:
    """Return the scale of each joint, or None if the companion's set-up of the bus fails.

    Args:
        vehicle: vehicle file with the assumed ids, baud rate and torques.
        servos: all servos that are connected to the bus.

    Returns:
        None unless exactly one servo answers at each joint's id and baud rate in the vehicle file and its current limit suffices
        for `torque_max_nm`.
    """
    line, arm = ServoLine(servos), vehicle.arm
    first, second = (_current_limit_counts(line, joint, vehicle.arm_device.baud) for joint in arm.joints)
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


class FastBus:
    """The companion's cycle of reads and writes on the bus of two servos.

    Args:
        drives: motors of the servos; they are set to current mode.
        scales: scale of each joint; None if the bus set-up failed, in which case the arm never answers.
        watchdog_s: timeout of the servos' bus watchdog.
        faults: faults of the world; None if it has none.
    """

    def __init__(
        self,
        drives: Sequence[ServoDrive],
        scales: tuple[JointScale, JointScale] | None,
        watchdog_s: float,
        faults: Faults | None,
    ) -> None:
        self._drives, self._scales, self._watchdog_s, self._faults = drives, scales, watchdog_s, faults
        self._goal_s = 0.0
        self._arm: ArmState | None = None
        for drive in drives:
            drive.mode, drive.torque_on = MODE_CURRENT, True
            drive.set_goal_current(0, at_once=True)
            drive.start_watchdog(watchdog_s)

    def read(self, t_s: float) -> ArmState | None:
        """Return the joint state of this tick. If the read fails, return the last state with one more read failure; None if the bus
        set-up failed.
        """
        if self._arm is None or self._faults is None or not self._read_fails(self._faults):
            self._arm = self._state(t_s)
        else:
            self._arm = replace(self._arm, read_failures=self._arm.read_failures + 1)
        return self._arm

    def keep_alive(self, t_s: float) -> None:
        """Do what the bus thread does while the flight process stalls: feed the watchdogs and set stale currents to zero."""
        for drive in self._drives:
            drive.heard_instruction()
            if t_s - self._goal_s > self._watchdog_s:
                drive.set_goal_current(0)

    def write(self, t_s: float, torque_nm: Joints | None) -> None:
        """Write the currents for these joint torques. If `torque_nm` is None, only set stale currents to zero."""
        faults = self._faults
        if torque_nm is not None and self._scales is not None:
            self._goal_s = t_s
            (drive1, drive2), (scale1, scale2) = self._drives, self._scales
            counts = (scale1.current_counts(torque_nm[0]), scale2.current_counts(torque_nm[1]))
            if faults is None:
                drive1.set_goal_current(counts[0])
                drive2.set_goal_current(counts[1])
            elif not faults.packet_lost():
                self._set(faults, counts)
        elif faults is not None and t_s - self._goal_s > self._watchdog_s and not faults.packet_lost():
            # As the bus thread does with a stale goal; a servo that is lost has its own watchdog.
            self._set(faults, (0, 0))

    def _set(self, faults: Faults, counts: tuple[int, int]) -> None:
        lost = faults.active.get("servo_loss")
        for number, (drive, goal) in enumerate(zip(self._drives, counts, strict=True), start=1):
            if lost is None or lost.servo != number:
                drive.set_goal_current(goal)

    def _read_fails(self, faults: Faults) -> bool:
        """Return whether this read fails. Servos that are not lost still receive the instruction, unless noise corrupted it."""
        lost = faults.active.get("servo_loss")
        damaged = faults.packet_lost()
        if lost is None:
            return damaged
        if not damaged:
            self._drives[2 - lost.servo].heard_instruction()
        return True

    def _state(self, t_s: float) -> ArmState | None:
        if self._scales is None:
            return None
        (drive1, drive2), (scale1, scale2) = self._drives, self._scales
        current1, speed1, position1 = drive1.present()
        current2, speed2, position2 = drive2.present()
        errors, temperatures_c = _HEALTHY, _COOL
        if self._faults is not None:
            (e1, e2), (c1, c2) = self._faults.errors, self._faults.temperatures_c
            errors, temperatures_c = (e1, e2), (c1, c2)
        if drive1.watchdog_tripped or drive2.watchdog_tripped:
            # As in the driver, a tripped watchdog is reported in one state and then restarted with zero current.
            tripped = (drive1.watchdog_tripped * WATCHDOG_ERROR, drive2.watchdog_tripped * WATCHDOG_ERROR)
            errors = (errors[0] | tripped[0], errors[1] | tripped[1])
            drive1.start_watchdog(self._watchdog_s)
            drive2.start_watchdog(self._watchdog_s)
        drive1.heard_instruction()
        drive2.heard_instruction()
        return ArmState(
            stamp_s=t_s,
            angle_rad=(scale1.angle_rad(position1), scale2.angle_rad(position2)),
            velocity_rad_s=(scale1.velocity_rad_s(speed1), scale2.velocity_rad_s(speed2)),
            torque_nm=(scale1.torque_nm(current1), scale2.torque_nm(current2)),
            hardware_error=errors,
            temperature_c=temperatures_c,
            read_failures=0,
        )
