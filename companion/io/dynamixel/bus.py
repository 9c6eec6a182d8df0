"""Blocking communication with the arm's servos: check and set up, one read and one write per cycle, release.

Everything here runs in the bus thread, but for `write_currents`, which the event loop calls while the thread does not use the bus
(`companion.io.arm.thread`). The dynamixel-sdk implements the protocol; `companion.io.dynamixel.packets` spares it the usual cycle.
"""

from __future__ import annotations

import contextlib
import termios
from collections.abc import Callable

import serial
from dynamixel_sdk import COMM_SUCCESS

from companion.config.arm import Arm, Jaws, Joint
from companion.config.devices import ArmDevice
from companion.io.dynamixel import packets
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.access import ATTEMPTS, ERROR_NUMBER, ServoAccess
from companion.io.dynamixel.jaws import JawsServo
from companion.io.dynamixel.port import servo_port, usb_latency_ms
from companion.io.dynamixel.registers import Block, Register
from companion.io.dynamixel.scale import RAD_PER_COUNT, JointScale, joint_scale, turn_offset_counts
from companion.io.protocols import DeviceError
from companion.io.reopening import Reopening
from companion.model.observations import ServoReport
from companion.model.servos import COUNTS_PER_TURN, ServoKind, hardware_error_text, model_text
from companion.model.team import ClampCommand
from companion.runtime.clock import monotonic

_FLIGHT_REPLY_TIMEOUT_MS = 8.0
"""Reply timeout in flight, the longest delay caused by an absent servo."""
_USB_LATENCY_MAX_MS = 4
_LOOKS_FOR_JAWS = 2
_TRIES = 3
"""Attempts at a write that must not be lost, in flight and at its end: a disturbance often damages several packets in a row."""
_ANSWER_BYTES = packets.STATUS_BYTES + dxl.BLOCK_SIZE

Counts = tuple[int, ...]
"""One value in register units for each servo, from the shoulder outwards."""


class ArmBus:
    """The arm's servos on one port, which may be of several models. Not thread-safe.

    Args:
        aborted: called between the steps of `open`; True aborts it.
        jaws: the clamp's servo on the same bus; None without a clamp.
    """

    def __init__(
        self, device: ArmDevice, arm: Arm, aborted: Callable[[], bool] = lambda: False, jaws: Jaws | None = None
    ) -> None:
        self._device = device
        self._joints = arm.joints
        self._torque_constants_nm_a = arm.torque_constants_nm_a
        self._limp = (0,) * len(arm.joints)
        self._aborted = aborted
        self._ids = [joint.servo_id for joint in arm.joints]
        self._port = servo_port(device.port)
        names = {joint.servo_id: f"servo {joint.servo_id} (joint {n})" for n, joint in enumerate(arm.joints, 1)}
        if jaws is not None:
            names[jaws.servo_id] = f"servo {jaws.servo_id} (clamp)"
        self._servos = ServoAccess(self._port, f"arm bus {device.port}", names, self._check_time)
        self.jaws = None if jaws is None else JawsServo(jaws, self._servos)
        """The clamp's servo; None without a clamp."""
        self._read_ids = self._ids if jaws is None else [*self._ids, jaws.servo_id]
        self._request = packets.sync_read(dxl.INDIRECT_DATA_1, dxl.BLOCK_SIZE, self._read_ids)
        self._deadline_s = 0.0
        self._watchdog = device.watchdog_ms // dxl.WATCHDOG_UNIT_MS
        self._reopening: Reopening[serial.Serial] | None = None
        """Attempts to open the port again after it has hung up; None while it is open."""
        self._touched = False
        self.reports: tuple[ServoReport, ...] = ()
        """Identity and settings of all servos, read back at the end of `open`."""

    def open(self, timeout_s: float) -> tuple[JointScale, ...]:
        """Open the port, check all servos, set them up and switch torque on with goal current 0.

        Raises:
            DeviceError: a servo or the port does not meet the requirements; the text is one line.
        """
        self._deadline_s = monotonic() + timeout_s
        self._open_port()
        for joint in self._joints:
            self._check_identity(joint.servo_id, joint.kind)
        jaws = self.jaws
        if jaws is not None:
            self._check_identity(jaws.servo_id, jaws.kind)
            jaws.set_up()
        self._touched = True
        scales = tuple(
            self._set_up(joint, nm_a) for joint, nm_a in zip(self._joints, self._torque_constants_nm_a, strict=True)
        )
        answers = (self.read() for _ in range(ATTEMPTS))
        whole = (found for found in answers if found is not None and (jaws is None or jaws.block is not None))
        blocks = next(whole, None)
        if blocks is None:
            raise self._error(
                f"servos {' and '.join(map(str, self._read_ids))}",
                "answered individually but not to a sync read; check for a loose cable",
            )
        scales = tuple(
            self._within_limits(joint, scale, block)
            for joint, scale, block in zip(self._joints, scales, blocks, strict=True)
        )
        for joint in self._joints:
            self._verify_ready(joint)
        self.reports = tuple(self._report(joint) for joint in self._joints)
        for joint in self._joints:
            self._servos.write(joint.servo_id, dxl.TORQUE_ENABLE, 1)
        self._port.reply_timeout_ms = _FLIGHT_REPLY_TIMEOUT_MS
        self._port.late_reply_ms = 0.0
        return scales

    def read(self) -> tuple[Block, ...] | None:
        """Perform one sync read. Return None unless every servo answered in time and still has the settings of `open`.

        A port that is gone is opened again, as soon as it is there. Nothing else is done then: a servo that lost its power meanwhile
        has its torque off and keeps it off, and is not read, because it has lost the settings of `open`.

        Raises:
            OSError: the port is gone, at the first read that finds it so.
        """
        if not self._is_open():
            return None
        try:
            blocks = self._read_all()
            if self.jaws is not None and self.jaws.pending:
                self.jaws.send()
            return blocks
        except BlockingIOError:  # it is there, but sends nothing
            raise
        except (OSError, termios.error):
            self._port.closePort()
            self._reopening = Reopening("arm reopening", lambda: self._port.open_serial(self._device.baud))
            raise

    def _is_open(self) -> bool:
        """Return whether the port is open, once it has been opened again."""
        if self._reopening is not None:
            opened = self._reopening.take()
            if opened is None:
                return False
            self._reopening = None
            self._port.use(opened)
        return True

    def _read_all(self) -> tuple[Block, ...] | None:
        port = self._port
        port.is_using = False  # an exception in an earlier transaction leaves it set
        port.clearPort()
        if port.writePort(self._request) != len(self._request):
            return None
        port.setPacketTimeout(len(self._ids) * _ANSWER_BYTES)
        blocks: list[Block] = []
        for servo_id in self._ids:
            answer = packets.status_data(port.peek(_ANSWER_BYTES), servo_id, dxl.BLOCK_SIZE)
            if answer is not None:
                data, error = answer
                port.skip(_ANSWER_BYTES)
            else:  # late, in parts, damaged or mixed with noise
                received, result, error = self._servos.protocol.readRx(port, servo_id, dxl.BLOCK_SIZE)
                if result != COMM_SUCCESS or len(received) != dxl.BLOCK_SIZE:
                    return None
                data = bytes(received)
            if error & ERROR_NUMBER:
                return None
            block = Block.from_bytes(data)
            # All zero after a restart by itself (a loose supply): its indirect addresses are lost, the block is invalid.
            if block.bus_watchdog not in (self._watchdog, dxl.WATCHDOG_TRIPPED) and not block.is_unwatched:
                return None
            blocks.append(block)
        if self.jaws is not None:
            self._read_jaws(self.jaws)
        return tuple(blocks)

    def _read_jaws(self, jaws: JawsServo) -> None:
        """Take the answer of the clamp's servo, which follows those of the joints at once; do not wait for a servo that is silent."""
        answer = None
        for _ in range(_LOOKS_FOR_JAWS):
            answer = answer or packets.status_data(self._port.peek(_ANSWER_BYTES), jaws.servo_id, dxl.BLOCK_SIZE)
        jaws.take(None if answer is None else answer[0])

    def command_jaws(self, command: ClampCommand) -> None:
        """Command the clamp; never waits.

        Raises:
            OSError: the port is gone.
        """
        if self.jaws is not None:
            self.jaws.command = command
            if self._reopening is None:
                self.jaws.send()

    def write_currents(self, counts: Counts) -> None:
        """Perform one sync write of the goal currents, which has no reply; do nothing while the port is being opened again.

        Raises:
            OSError: the port is gone.
        """
        if self._reopening is None:
            self._port.writePort(packets.sync_write_int16(dxl.GOAL_CURRENT.address, self._ids, counts))

    def restart_watchdogs(self) -> None:
        """Clear tripped bus watchdogs and restart them with goal current 0. The next read shows the result.

        Raises:
            OSError: the port is gone.
        """
        for servo_id in self._ids:
            self._servos.try_write(servo_id, dxl.BUS_WATCHDOG, 0)
        self.write_currents(self._limp)
        self._confirmed(dxl.BUS_WATCHDOG, self._watchdog)

    def _confirmed(self, register: Register, value: int) -> list[int]:
        """Write a register of all joints' servos, again if it is not confirmed; return the ids of those that have confirmed it."""
        missing = self._ids
        for _ in range(_TRIES):
            missing = [servo_id for servo_id in missing if not self._servos.try_write(servo_id, register, value)]
        return [servo_id for servo_id in self._ids if servo_id not in missing]

    def close(self) -> None:
        """Set goal current 0, switch off torque and watchdog as far as the bus still works, and close the port. Never raises.

        A servo that has not confirmed that its torque is off keeps its watchdog, which then stops it.
        """
        self._port.reply_timeout_ms = _FLIGHT_REPLY_TIMEOUT_MS
        self._port.late_reply_ms = 0.0
        try:
            if self._touched and self._is_open() and self._port.is_open:
                self.write_currents(self._limp)
                for servo_id in self._confirmed(dxl.TORQUE_ENABLE, 0):
                    self._servos.try_write(servo_id, dxl.BUS_WATCHDOG, 0)
        except Exception:  # a lost port raises any exception of its driver; it must be closed all the same
            pass
        finally:
            if self._reopening is not None:
                self._reopening.close()
            with contextlib.suppress(OSError):
                self._port.closePort()

    # --- opening, step by step ---------------------------------------------------------------------------------------

    def _open_port(self) -> None:
        self._port.baudrate = self._device.baud
        if not self._port.openPort():
            raise self._error("port", f"dynamixel-sdk does not know baud rate {self._device.baud}")
        latency_ms = usb_latency_ms(self._device.port)
        if latency_ms is not None and latency_ms > _USB_LATENCY_MAX_MS:
            raise self._error(
                "USB adapter",
                f"latency timer is {latency_ms} ms, expected at most {_USB_LATENCY_MAX_MS}; write 1 to "
                f"/sys/bus/usb-serial/devices/{self._device.servo_port.rsplit('/', 1)[-1]}/latency_timer (a udev rule keeps it)",
            )

    def _check_identity(self, servo_id: int, kind: ServoKind) -> None:
        model = self._servos.ping(servo_id)
        if model is None:
            answered = self._servos.ping_all()
            others = (
                f"ids that answer: {', '.join(map(str, sorted(answered)))}" if answered else "no servo answers at all"
            )
            raise self._servos.error(
                servo_id,
                f"does not answer at {self._device.baud} baud; {others}; check its power, cable, id and baud rate",
            )
        if model != kind.number:
            raise self._servos.error(servo_id, f"is {model_text(model)}; the vehicle file says {kind.name}")
        # A servo set to answer pings only would look dead; the answer to this write does not matter.
        self._servos.try_write(servo_id, dxl.STATUS_RETURN_LEVEL, 2)
        firmware = self._servos.read(servo_id, dxl.FIRMWARE)
        if firmware < kind.firmware_min:
            raise self._servos.error(
                servo_id,
                f"has firmware {firmware}; the {kind.name} needs {kind.firmware_min} or newer; update it with DYNAMIXEL "
                "Wizard",
            )
        errors = self._servos.read(servo_id, dxl.HARDWARE_ERROR)
        if errors:
            raise self._servos.error(
                servo_id,
                f"reports a hardware error: {hardware_error_text(errors)} ({dxl.HARDWARE_ERROR} = {errors}); "
                "remove the cause, then run companion arm reboot",
            )
        for register, wanted, why in dxl.REQUIRED:
            found = self._servos.read(servo_id, register)
            more = (
                register == dxl.SHUTDOWN and found & wanted == wanted
            )  # the 330 models leave the factory with one more
            if found != wanted and not more:
                text = f"{register} is {found}, expected {wanted}, because {why}; run companion arm setup"
                raise self._servos.error(servo_id, text)

    def _set_up(self, joint: Joint, torque_per_amp_nm_a: float) -> JointScale:
        self._servos.write(joint.servo_id, dxl.TORQUE_ENABLE, 0)
        self._servos.write(joint.servo_id, dxl.BUS_WATCHDOG, 0)
        for register, value in ((dxl.RETURN_DELAY, 0), (dxl.OPERATING_MODE, dxl.MODE_CURRENT)):
            if self._servos.read(joint.servo_id, register) != value:  # EEPROM wears
                self._servos.write(joint.servo_id, register, value)
        try:
            scale = joint_scale(joint, torque_per_amp_nm_a, self._servos.read(joint.servo_id, dxl.CURRENT_LIMIT))
        except ValueError as error:
            raise self._servos.error(joint.servo_id, str(error)) from error
        pointers = dxl.pointers(dxl.BLOCK)
        indirect = Register(dxl.INDIRECT_ADDRESS_1, len(pointers), "indirect addresses")
        self._servos.write_bytes(joint.servo_id, indirect, pointers)
        self._servos.write(joint.servo_id, dxl.GOAL_CURRENT, 0)
        self._servos.write(joint.servo_id, dxl.BUS_WATCHDOG, self._watchdog)
        return scale

    def _within_limits(self, joint: Joint, scale: JointScale, block: Block) -> JointScale:
        zero_count = joint.zero_count + turn_offset_counts(joint, block.position_count)
        scale = JointScale(scale.sign, zero_count, scale.torque_nm_per_count, scale.current_max_counts)
        angle_deg = scale.angle_rad(block.position_count) * 360.0 / (COUNTS_PER_TURN * RAD_PER_COUNT)
        low_deg, high_deg = joint.angle_deg
        if not low_deg <= angle_deg <= high_deg:
            raise self._servos.error(
                joint.servo_id,
                f"is at {angle_deg:.1f} deg ({dxl.PRESENT_POSITION} = {block.position_count}), outside its limits "
                f"{low_deg:g} to {high_deg:g} deg; move the arm by hand or correct zero_count and sign",
            )
        return scale

    def _verify_ready(self, joint: Joint) -> None:
        expected = (
            (dxl.TORQUE_ENABLE, 0),
            (dxl.OPERATING_MODE, dxl.MODE_CURRENT),
            (dxl.RETURN_DELAY, 0),
            (dxl.GOAL_CURRENT, 0),
            (dxl.BUS_WATCHDOG, self._watchdog),
            (dxl.HARDWARE_ERROR, 0),
        )
        for register, value in expected:
            found = self._servos.read(joint.servo_id, register)
            if found != value:
                raise self._servos.error(joint.servo_id, f"{register} reads {found} after set-up, expected {value}")

    def _report(self, joint: Joint) -> ServoReport:
        return ServoReport(
            servo_id=joint.servo_id,
            model=self._servos.read(joint.servo_id, dxl.MODEL),
            firmware=self._servos.read(joint.servo_id, dxl.FIRMWARE),
            operating_mode=self._servos.read(joint.servo_id, dxl.OPERATING_MODE),
            return_delay_us=self._servos.read(joint.servo_id, dxl.RETURN_DELAY) * dxl.RETURN_DELAY_UNIT_US,
            current_limit_counts=self._servos.read(joint.servo_id, dxl.CURRENT_LIMIT),
            watchdog_ms=self._servos.read(joint.servo_id, dxl.BUS_WATCHDOG) * dxl.WATCHDOG_UNIT_MS,
            voltage_v=round(self._servos.read(joint.servo_id, dxl.PRESENT_VOLTAGE) * dxl.VOLTAGE_UNIT_V, 1),
        )

    def _check_time(self) -> None:
        if self._aborted():
            raise self._error("set-up", "given up")
        if monotonic() > self._deadline_s:
            raise self._error("set-up", "not finished in time: the servos answer too slowly; check the cables")

    def _error(self, what: str, text: str) -> DeviceError:
        return DeviceError(f"arm bus {self._device.port}: {what}: {text}")
