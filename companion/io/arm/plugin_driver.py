"""Driver of an arm that is a plug-in: runs its class (`companion.io.arm.motors.ArmMotors`) in the bus thread."""

from __future__ import annotations

import logging
import math
import time
from contextlib import suppress
from typing import Any, Final

from companion.config.arm import Arm, Joint
from companion.config.device_plugins import device_class
from companion.config.devices import ArmDevice
from companion.io.arm.motors import METHODS, MotorState, checked
from companion.io.arm.thread import KEEPALIVES_PER_WATCHDOG, ThreadedArm
from companion.io.protocols import DeviceError
from companion.model.constants import TICK_PERIOD_S
from companion.model.observations import ArmStatement
from companion.model.servos import COUNTS_PER_TURN, MOTOR_ERROR
from companion.model.types import ArmState, Joints
from companion.plugins import ARMS, PluginError, find, one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_TRIAL_CYCLES: Final = 20
_TURN_RAD: Final = 2.0 * math.pi


class PluginArm(ThreadedArm[tuple[MotorState, ...], Joints]):
    """The motors of a plug-in behind the `Arm` protocol.

    Joint angles, directions, whole turns and torque limits are those of the vehicle file, applied here.
    """

    def __init__(self, device: ArmDevice, arm: Arm, clock: Clock) -> None:
        super().__init__(f"arm {device.type}", device.watchdog_ms, (0.0,) * len(arm.joints), clock)
        self._device = device
        self._joints = arm.joints
        self._motors: Any = None
        self._zeros_rad = [joint.zero_count * _TURN_RAD / COUNTS_PER_TURN for joint in arm.joints]
        self._statement: ArmStatement | None = None
        self._goal: Joints = self._limp
        self._goal_s = 0.0
        """Time of the last write, on the clock of `time.monotonic`."""
        self._write_problem = ""
        self._errors: tuple[str, ...] = ("",) * len(arm.joints)

    @property
    def statement(self) -> ArmStatement | None:
        """Return what the plug-in states about its arm; None before it is open."""
        return self._statement

    # --- bus thread --------------------------------------------------------------------------------------------------

    def _open_bus(self) -> None:
        try:
            found = device_class(ARMS, self._device.type, METHODS)
            plugin = find(ARMS, self._device.type)
            self._where = str(plugin)
            try:
                self._motors = found(found.options.model_validate(self._device.options), self._device, self._joints)
                self._motors.open()
                states = checked(self._motors.read(), len(self._joints))
                product, watchdog = str(self._motors.product_name), str(self._motors.watchdog).strip()
                watchdog_ms = float(self._motors.watchdog_ms)
            except Exception as error:
                raise plugin.error(f"cannot be opened: {one_line(error)}") from error
            if not watchdog:
                raise plugin.error(
                    "its attribute 'watchdog' does not state what makes the arm limp when the companion dies"
                )
            if not 0.0 < watchdog_ms <= self._device.watchdog_ms:
                raise plugin.error(
                    f"its attribute 'watchdog_ms' is {watchdog_ms:g}, expected above 0 and at most devices.arm.watchdog_ms "
                    f"({self._device.watchdog_ms} ms); set the motors' watchdog, or correct the vehicle file"
                )
            self._zeros_rad = [
                zero_rad + _turns_rad(joint, zero_rad, state.angle_rad)
                for joint, zero_rad, state in zip(self._joints, self._zeros_rad, states, strict=True)
            ]
            self._check_angles(states)
            took_s = min(self._trial_s() for _ in range(_TRIAL_CYCLES))
        except PluginError as error:
            raise DeviceError(str(error)) from error
        if took_s > TICK_PERIOD_S:
            raise DeviceError(
                f"{plugin}: read() and write_torque() take {took_s * 1e3:.1f} ms or more (limit {TICK_PERIOD_S * 1e3:g} ms, one tick)"
            )
        self._statement = ArmStatement(product, f"{watchdog}, after {watchdog_ms:g} ms")

    def _trial_s(self) -> float:
        began_s = time.monotonic()
        self._write_bus(self._limp)
        self._read_bus()
        return time.monotonic() - began_s

    def _check_angles(self, states: tuple[MotorState, ...]) -> None:
        for number, (joint, state) in enumerate(zip(self._joints, states, strict=True)):
            low_deg, high_deg = joint.angle_deg
            angle_deg = math.degrees(joint.sign * (state.angle_rad - self._zeros_rad[number]))
            if not low_deg <= angle_deg <= high_deg:
                raise DeviceError(
                    f"{self._where}: joint {number + 1} is at {angle_deg:.1f} deg, outside its limits {low_deg:g} to {high_deg:g} deg; "
                    "move the arm by hand or correct zero_count and sign"
                )

    def _read_bus(self) -> tuple[MotorState, ...]:
        if self._write_problem:
            problem, self._write_problem = self._write_problem, ""
            raise RuntimeError(problem)
        if time.monotonic() - self._goal_s > self._watchdog_s / KEEPALIVES_PER_WATCHDOG:
            self._write_bus(self._goal)  # many watchdogs are fed by commands alone
        return checked(self._motors.read(), len(self._joints))

    def _to_state(self, answer: tuple[MotorState, ...], asked_s: float) -> ArmState:
        errors = tuple([state.error for state in answer])
        if errors != self._errors:
            self._errors = errors
            _LOG.error("%s: faults of the motors: %s", self._where, errors)
        motors = list(zip(self._joints, self._zeros_rad, answer, strict=True))
        return ArmState(
            stamp_s=self._clock(),
            angle_rad=tuple([joint.sign * (state.angle_rad - zero_rad) for joint, zero_rad, state in motors]),
            velocity_rad_s=tuple([joint.sign * state.velocity_rad_s for joint, _, state in motors]),
            torque_nm=tuple([joint.sign * state.torque_nm for joint, _, state in motors]),
            hardware_error=tuple([MOTOR_ERROR if error else 0 for error in errors]),
            temperature_c=tuple([state.temperature_c or 0.0 for state in answer]),
            read_failures=0,
            written_s=self._written_s,
            asked_s=asked_s,
        )

    def _encode(self, torque_nm: Joints) -> tuple[Joints, Joints]:
        if not all(map(math.isfinite, torque_nm)):
            raise ValueError(f"joint torques {torque_nm} are not finite")
        sent_nm = tuple(
            [
                max(-joint.torque_max_nm, min(joint.torque_max_nm, nm))
                for joint, nm in zip(self._joints, torque_nm, strict=True)
            ]
        )
        return tuple([joint.sign * nm for joint, nm in zip(self._joints, sent_nm, strict=True)]), sent_nm

    def _write_bus(self, goal: Joints) -> None:
        self._goal, self._goal_s = goal, time.monotonic()
        try:
            self._motors.write_torque(goal)
        except Exception as error:  # the next read then counts as failed
            self._write_problem = f"write_torque() raised {one_line(error)}"
            raise RuntimeError(self._write_problem) from error

    def _restart_watchdogs(self) -> None:
        """Do nothing: a plug-in never reports `WATCHDOG_ERROR`."""

    def _close_bus(self) -> None:
        if self._motors is not None:
            for call in (lambda: self._motors.write_torque(self._limp), self._motors.torque_off, self._motors.close):
                with suppress(Exception):
                    call()


def _turns_rad(joint: Joint, zero_rad: float, angle_rad: float) -> float:
    """Return the whole turns to add to the zero so that the joint angle lies within its limits, or 0 if none fits or several may."""
    low_rad, high_rad = map(math.radians, joint.angle_deg)
    joint_rad = joint.sign * (angle_rad - zero_rad)
    turns = math.ceil((low_rad - joint_rad) / _TURN_RAD)
    if high_rad - low_rad >= _TURN_RAD or joint_rad + _TURN_RAD * turns > high_rad:
        return 0.0
    return -joint.sign * turns * _TURN_RAD
