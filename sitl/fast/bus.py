"""The servo bus of the fast closed loop: without a pty, it models the outcome of the companion's bus set-up, reads and writes."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from companion.config.arm import Joint
from companion.config.vehicle import Vehicle
from companion.flight.ticker import JOINT_LEAD_MAX_S
from companion.io.dynamixel.scale import JointScale, joint_scale
from companion.model.constants import TICK_PERIOD_S
from companion.model.servos import WATCHDOG_ERROR
from companion.model.types import ArmState, Joints
from sitl.faults.injector import COOL_C, Faults
from sitl.force_torque import TIME_EPSILON_S
from sitl.servo import registers as reg
from sitl.servo.bus import ServoLine
from sitl.servo.drive import MODE_CURRENT, ServoDrive
from sitl.servo.model import ServoModel
from sitl.servo.protocol import Instruction, packet, status

_LIMIT = reg.CURRENT_LIMIT
_READ_LIMIT = bytes((Instruction.READ, *_LIMIT.address.to_bytes(2, "little"), *_LIMIT.size.to_bytes(2, "little")))


def scales_of(vehicle: Vehicle, servos: Sequence[ServoModel]) -> tuple[JointScale, ...] | None:
    """Return the scale of each joint, or None if the companion's set-up of the bus fails.

    Args:
        vehicle: vehicle file with the assumed ids, baud rate and torques.

    Returns:
        None unless exactly one servo of the right model answers at each joint's id and baud rate in the vehicle file and its current
        limit suffices for `torque_max_nm`.
    """
    line, arm = ServoLine(servos), vehicle.arm
    scales: list[JointScale] = []
    for joint, nm_a in zip(arm.joints, arm.torque_constants_nm_a, strict=True):
        limit_counts = _current_limit_counts(line, joint, vehicle.arm_device.baud)
        if limit_counts is None:
            return None
        try:
            scales.append(joint_scale(joint, nm_a, limit_counts))
        except ValueError:  # the current limit is too low
            return None
    return tuple(scales)


def _current_limit_counts(line: ServoLine, joint: Joint, baud_bps: int) -> int | None:
    own = [servo for servo in line.servos if servo.servo_id == joint.servo_id]
    answer = line.feed(packet(joint.servo_id, _READ_LIMIT), baud_bps)
    if len(own) != 1 or own[0].model != joint.kind.number:
        return None
    data = own[0].read(_LIMIT.address, _LIMIT.size)
    return _LIMIT.decode(data) if answer == status(joint.servo_id, 0, data) else None


class FastBus:
    """The companion's cycle of reads and writes on the servo bus.

    Args:
        drives: motors of the servos; they are set to current mode.
        scales: scale of each joint; None if the bus set-up failed, in which case the arm never answers. It does not answer either if
            there are no joints.
    """

    def __init__(
        self,
        drives: Sequence[ServoDrive],
        scales: tuple[JointScale, ...] | None,
        watchdog_s: float,
        faults: Faults | None,
    ) -> None:
        self._drives, self._scales, self._watchdog_s, self._faults = drives, scales, watchdog_s, faults
        self._healthy, self._cool = (0,) * len(drives), (COOL_C,) * len(drives)
        self._goal_s = 0.0
        self._arm: ArmState | None = None
        self._read: ArmState | None = None
        """Joint state whose answer is on its way; None if no read is in progress."""
        self._next_read_s = 0.0
        self._waiting_counts: Sequence[int] | None = None
        """Currents that wait for the end of the read."""
        for drive in drives:
            drive.mode, drive.torque_on = MODE_CURRENT, True
            drive.set_goal_current(0, at_once=True)
            drive.start_watchdog(watchdog_s)

    def read(self, t_s: float) -> ArmState | None:
        """Return the joint state of this tick, or the last one with one more read failure; None if the bus set-up failed."""
        if self._read is not None or (self._arm is not None and self._delay_s):
            self._next_read_s = t_s + TICK_PERIOD_S - JOINT_LEAD_MAX_S
        elif self._arm is None or self._faults is None or not self._read_fails(self._faults):
            self._arm = self._state(t_s)
        else:
            self._arm = self._one_more_failure()
        return self._arm

    def _one_more_failure(self) -> ArmState:
        assert self._arm is not None
        return replace(self._arm, read_failures=self._arm.read_failures + 1)

    @property
    def _delay_s(self) -> float:
        return 0.0 if self._faults is None else self._faults.size("bus_delay")

    def step(self, t_s: float) -> None:
        """Do what the bus thread does while answers are delayed: begin a read before the tick, take its answer, and send currents when
        no read is in progress. Call it in every step of a world with faults.
        """
        arm, faults = self._read, self._faults
        if arm is None and self._arm is not None and self._delay_s and t_s >= self._next_read_s:
            arm = self._read = self._state(t_s)
        if arm is not None and faults is not None and t_s >= arm.stamp_s + self._delay_s - TIME_EPSILON_S:
            failed = self._read_fails(faults)
            new = replace(arm, stamp_s=t_s, asked_s=arm.stamp_s)
            self._arm = self._one_more_failure() if failed else new
            self._read, waiting = None, self._waiting_counts
            if waiting is not None:
                self._waiting_counts = None
                self._set(faults, waiting)

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
            counts = [scale.current_counts(nm) for scale, nm in zip(self._scales, torque_nm, strict=True)]
            if faults is None or not faults.packet_lost():
                if self._read is None:
                    self._set(faults, counts)
                else:
                    self._waiting_counts = counts
        elif t_s - self._goal_s > self._watchdog_s and (faults is None or not faults.packet_lost()):
            # As the bus thread does with a stale goal; a servo that is lost has its own watchdog.
            self._set(faults, [0] * len(self._drives))

    def _set(self, faults: Faults | None, counts: Sequence[int]) -> None:
        lost = None if faults is None else faults.active.get("servo_loss")
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
            for number, drive in enumerate(self._drives, start=1):
                if number != lost.servo:
                    drive.heard_instruction()
        return True

    def _state(self, t_s: float) -> ArmState | None:
        drives, scales = self._drives, self._scales
        if not scales:
            return None
        present = [drive.present() for drive in drives]
        errors, temperatures_c = self._healthy, self._cool
        if self._faults is not None:
            errors, temperatures_c = tuple(self._faults.errors), tuple(self._faults.temperatures_c)
        if any(drive.watchdog_tripped for drive in drives):
            # As in the driver, a tripped watchdog is reported in one state and then restarted with zero current.
            errors = tuple(
                error | drive.watchdog_tripped * WATCHDOG_ERROR for error, drive in zip(errors, drives, strict=True)
            )
            for drive in drives:
                drive.start_watchdog(self._watchdog_s)
        for drive in drives:
            drive.heard_instruction()
        read = list(zip(scales, present, strict=True))
        return ArmState(
            stamp_s=t_s,
            angle_rad=tuple([scale.angle_rad(position) for scale, (_, _, position) in read]),
            velocity_rad_s=tuple([scale.velocity_rad_s(speed) for scale, (_, speed, _) in read]),
            torque_nm=tuple([scale.torque_nm(current) for scale, (current, _, _) in read]),
            hardware_error=errors,
            temperature_c=temperatures_c,
            read_failures=0,
        )
