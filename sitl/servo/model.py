"""An emulated Dynamixel servo without I/O: a control table for the bus and a motor for the world.

The motor is a `ServoDrive`. Writes are copied to it, and its present values are copied into the table before each read. The watchdog
runs on the world time of `update`.
"""

from __future__ import annotations

import struct

from companion.model.servos import ServoName
from sitl.servo import registers as reg
from sitl.servo.drive import (
    AMP_PER_COUNT,
    MODE_CURRENT,
    MODE_CURRENT_POSITION,
    MODE_POSITION,
    RAD_PER_COUNT,
    RAD_S_PER_COUNT,
    ServoDrive,
)
from sitl.servo.kinds import KINDS
from sitl.servo.protocol import ALERT, StatusError
from sitl.servo.registers import Register

__all__ = ["AMP_PER_COUNT", "RAD_PER_COUNT", "RAD_S_PER_COUNT", "ServoModel", "ServoRefusal"]

WATCHDOG_UNIT_S = 0.020
WATCHDOG_TRIPPED = 0xFF

ERROR_VOLTAGE = 0x01
ERROR_OVERHEATING = 0x04
ERROR_OVERLOAD = 0x20

MODES = (MODE_CURRENT, MODE_POSITION, MODE_CURRENT_POSITION)

_PRESENT = struct.Struct("<hii")


class ServoRefusal(Exception):
    """The servo refuses an instruction; `error` is the error number of its status packet."""

    def __init__(self, error: StatusError) -> None:
        super().__init__(error.name)
        self.error = error


class ServoModel:
    """A servo with factory settings except for id and baud rate.

    Args:
        servo_id: servo id (register 7).
        baud_bps: baud rate (register 8); the servo receives only packets sent at this rate.
        firmware: firmware version (register 6); None for that of the model as delivered.
        model: model number (register 0); None for that of the model.
        shaft_angle_rad: shaft angle before the first `update`.

    Raises:
        ValueError: the servo does not support this baud rate or id.
    """

    def __init__(
        self,
        servo_id: int,
        *,
        baud_bps: int = 3_000_000,
        kind: ServoName = "XM430-W210",
        firmware: int | None = None,
        model: int | None = None,
        shaft_angle_rad: float = 0.0,
    ) -> None:
        if baud_bps not in reg.BAUDS:
            raise ValueError(f"the servo does not support the baud rate {baud_bps}; supported: {reg.BAUDS}")
        if not reg.ID.low <= servo_id <= reg.ID.high:
            raise ValueError(f"servo id {servo_id} is not in 0..252")
        self._memory = bytearray(reg.TABLE_SIZE)
        for register in reg.REGISTERS:
            self._set(register, register.initial)
        own = self._kind = KINDS[kind]
        low_v, high_v, supply_v = own.volts
        for register, value in (
            (reg.MODEL_NUMBER, own.number if model is None else model),
            (reg.FIRMWARE, own.firmware if firmware is None else firmware),
            (reg.CURRENT_LIMIT, own.current_counts),
            (reg.TEMPERATURE_LIMIT, own.temperature_c),
            (reg.MIN_VOLTAGE_LIMIT, round(10.0 * low_v)),
            (reg.MAX_VOLTAGE_LIMIT, round(10.0 * high_v)),
            (reg.PRESENT_VOLTAGE, round(10.0 * supply_v)),
            (reg.SHUTDOWN, own.shutdown),
        ):
            self._set(register, value)
        self._set(reg.ID, servo_id)
        self._set(reg.BAUD, reg.BAUDS.index(baud_bps))
        self.drive = ServoDrive(shaft_angle_rad)
        self.drive.amp_per_count = own.amp_per_count
        self.lights = 0
        """Number of times that the LED has been switched on."""
        self._shutdown = False
        self.silent = False
        """Whether the data wire is broken."""
        self._power_on()

    # --- side of the world -------------------------------------------------------------------------------------------

    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Process the shaft's state and return the motor current.

        Args:
            t_s: world time; must not decrease.
            shaft_angle_rad: continuous shaft angle in the servo's own convention (counts = angle / 2 pi * 4096).
            shaft_velocity_rad_s: shaft velocity, same convention.

        Returns:
            Motor current in A, positive towards positive angle; 0 while the motor is off.
        """
        drive, memory = self.drive, self._memory
        current_a = drive.update(t_s, shaft_angle_rad, shaft_velocity_rad_s)
        if drive.watchdog_tripped and memory[98] != WATCHDOG_TRIPPED:
            memory[98] = WATCHDOG_TRIPPED
            for goal in (reg.GOAL_CURRENT, reg.GOAL_VELOCITY):
                self._set(goal, 0)
        return current_a

    @property
    def goal_delay_s(self) -> float:
        """Delay from writing a goal current to its effect."""
        return self.drive.goal_delay_s

    @goal_delay_s.setter
    def goal_delay_s(self, delay_s: float) -> None:
        self.drive.goal_delay_s = delay_s

    def fail_silent(self, silent: bool) -> None:
        """Break or restore the data wire: a servo without it neither receives nor answers, and runs on until its watchdog trips."""
        self.silent = silent

    def trip_overload(self) -> None:
        """Raise the overload error, as the servo does after holding too large a load."""
        self._raise_error(ERROR_OVERLOAD)

    def set_temperature_c(self, temperature_c: float) -> None:
        """Set the motor temperature; a value above the limit in register 31 raises the overheating error."""
        self._set(reg.PRESENT_TEMPERATURE, max(0, min(255, round(temperature_c))))
        self._check_environment()

    def set_voltage_v(self, voltage_v: float) -> None:
        """Set the supply voltage; a value outside the limits in registers 34 (min) and 32 (max) raises the input voltage error."""
        self._set(reg.PRESENT_VOLTAGE, max(0, round(voltage_v * 10.0)))
        self._check_environment()

    # --- side of the bus ---------------------------------------------------------------------------------------------

    @property
    def servo_id(self) -> int:
        """Servo id (register 7)."""
        return self._memory[7]

    @property
    def secondary_id(self) -> int:
        """Secondary id (register 12); a value above 252 disables it."""
        return self._memory[12]

    @property
    def baud_bps(self) -> int:
        """Baud rate (register 8)."""
        return reg.BAUDS[self._memory[8]]

    @property
    def model(self) -> int:
        """Model number (register 0)."""
        return self._get(reg.MODEL_NUMBER)

    @property
    def firmware(self) -> int:
        """Firmware version (register 6)."""
        return self._memory[6]

    @property
    def return_delay_s(self) -> float:
        """Return delay time (register 9, unit 2 us)."""
        return self._memory[9] * 2e-6

    @property
    def lit(self) -> bool:
        """Whether the LED is on (register 65)."""
        return bool(self._memory[65])

    @property
    def status_return_level(self) -> int:
        """Status return level (register 68): with 0 the servo answers only pings, with 1 also reads, with 2 every instruction."""
        return self._memory[68]

    @property
    def alert(self) -> int:
        """Alert bit (0x80) of every status packet's error byte if register 70 reports an error, else 0."""
        return ALERT if self._memory[70] else 0

    def read(self, address: int, length: int) -> bytes:
        """Return bytes of the control table.

        Raises:
            ServoRefusal: DATA_LENGTH for zero bytes, ACCESS for undefined addresses.
        """
        if length == 0:
            raise ServoRefusal(StatusError.DATA_LENGTH)
        self._show_present()
        return bytes(self._memory[self._resolve(a, StatusError.ACCESS)] for a in range(address, address + length))

    def write(self, address: int, data: bytes) -> None:
        """Write whole registers. If any of them is refused, none is written.

        Raises:
            ServoRefusal: a write is refused; the exception has the error number of the status packet.
        """
        for register, value in self._checked(address, data):
            self._apply(register, value)

    def reboot(self) -> None:
        """Restart: reset RAM, keep EEPROM, and clear errors unless their cause persists."""
        memory = self._memory
        environment = {r: self._get(r) for r in (reg.PRESENT_TEMPERATURE, reg.PRESENT_VOLTAGE)}
        for register in reg.REGISTERS:
            if not register.eeprom:
                self._set(register, register.initial)
        for register, value in environment.items():
            self._set(register, value)
        for _, data, count in reg.INDIRECT_BLOCKS:
            memory[data : data + count] = bytes(count)
        self._shutdown = False
        self._power_on()

    # --- registers ---------------------------------------------------------------------------------------------------

    def _get(self, register: Register) -> int:
        return register.decode(self._memory[register.address : register.address + register.size])

    def _set(self, register: Register, value: int) -> None:
        self._memory[register.address : register.address + register.size] = register.encode(value)

    def _resolve(self, address: int, refusal: StatusError) -> int:
        """Return the address behind an indirect data byte, or the address itself."""
        pointer = reg.INDIRECT_POINTER.get(address)
        if pointer is not None:
            address = self._memory[pointer] | self._memory[pointer + 1] << 8
            if address in reg.INDIRECT_POINTER:
                return address  # an indirect address, which by default points at itself: plain memory
        if address not in reg.REGISTER_AT:
            raise ServoRefusal(refusal)
        return address

    def _checked(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        if not data:
            raise ServoRefusal(StatusError.DATA_LENGTH)
        targets = [self._resolve(address + i, StatusError.ACCESS) for i in range(len(data))]
        writes: list[tuple[Register, int]] = []
        i = 0
        while i < len(data):
            target = targets[i]
            register = reg.REGISTER_AT.get(target) or Register(
                address=target, size=1, name="indirect data", writable=True, initial=0, low=0, high=255
            )
            end = i + register.size
            if targets[i:end] != list(range(register.address, register.address + register.size)):
                raise ServoRefusal(StatusError.DATA_LENGTH)
            value = register.decode(data[i:end])
            self._check(register, value)
            writes.append((register, value))
            i = end
        return writes

    def _check(self, register: Register, value: int) -> None:
        memory = self._memory
        if not register.writable or (register.eeprom and memory[64]):
            raise ServoRefusal(StatusError.ACCESS)
        if memory[98] == WATCHDOG_TRIPPED and (register in reg.GOALS or (register is reg.BUS_WATCHDOG and value != 0)):
            raise ServoRefusal(StatusError.DATA_RANGE)
        in_range = register.low <= value <= register.high
        if register in (reg.CURRENT_LIMIT, reg.GOAL_CURRENT):
            in_range = abs(value) <= self._kind.current_counts
        if not in_range:
            raise ServoRefusal(StatusError.DATA_RANGE)
        if register is reg.OPERATING_MODE and value not in MODES:
            raise ServoRefusal(StatusError.DATA_RANGE)
        if register is reg.TORQUE_ENABLE and value == 1 and self._shutdown:
            raise ServoRefusal(StatusError.RESULT_FAIL)
        limit = {
            reg.GOAL_CURRENT: reg.CURRENT_LIMIT,
            reg.GOAL_PWM: reg.PWM_LIMIT,
            reg.GOAL_VELOCITY: reg.VELOCITY_LIMIT,
        }.get(register)
        if limit is not None and abs(value) > self._get(limit):
            raise ServoRefusal(StatusError.DATA_LIMIT)
        if (
            register is reg.GOAL_POSITION
            and memory[11] == MODE_POSITION
            and not self._get(reg.MIN_POSITION_LIMIT) <= value <= self._get(reg.MAX_POSITION_LIMIT)
        ):
            raise ServoRefusal(StatusError.DATA_LIMIT)

    def _apply(self, register: Register, value: int) -> None:
        if register is reg.LED and value > self._get(reg.LED):
            self.lights += 1
        self._set(register, value)
        drive, memory = self.drive, self._memory
        if register is reg.TORQUE_ENABLE and value == 1:
            if memory[11] == MODE_POSITION:
                drive.forget_turns()
            if memory[11] != MODE_CURRENT:
                self._set(reg.GOAL_POSITION, drive.present()[2])
        elif register is reg.OPERATING_MODE:
            self._reset_goals()
            if value == MODE_POSITION:
                drive.forget_turns()
        elif register in (reg.HOMING_OFFSET, reg.DRIVE_MODE):
            drive.show_no_current()
        elif register in (reg.TEMPERATURE_LIMIT, reg.MIN_VOLTAGE_LIMIT, reg.MAX_VOLTAGE_LIMIT):
            self._check_environment()
        if register is reg.GOAL_CURRENT:
            drive.set_goal_current(value)
        self._settings_to_drive()

    # --- inside ------------------------------------------------------------------------------------------------------

    def _power_on(self) -> None:
        self._reset_goals()
        self._memory[64] = self._get(reg.STARTUP) & 1
        self._settings_to_drive()
        self.drive.forget_turns()
        self._check_environment()

    def _reset_goals(self) -> None:
        goal = 0 if self._memory[11] == MODE_CURRENT else self._get(reg.CURRENT_LIMIT)
        self._set(reg.GOAL_CURRENT, goal)
        self.drive.set_goal_current(goal, at_once=True)
        self._set(reg.GOAL_PWM, self._get(reg.PWM_LIMIT))
        self._set(reg.GOAL_VELOCITY, 0)

    def _settings_to_drive(self) -> None:
        """Copy the table's settings to the drive, except the goal current, which takes effect after a delay."""
        drive, memory = self.drive, self._memory
        watchdog = memory[98]
        drive.torque_on = bool(memory[64])
        drive.mode = memory[11]
        drive.direction = -1 if memory[10] & 1 else 1
        drive.current_limit_counts = self._get(reg.CURRENT_LIMIT)
        drive.homing_counts = self._get(reg.HOMING_OFFSET)
        drive.goal_position_counts = self._get(reg.GOAL_POSITION)
        drive.position_gain = self._get(reg.POSITION_P_GAIN) / reg.POSITION_P_GAIN.initial
        if watchdog != WATCHDOG_TRIPPED:
            drive.start_watchdog(watchdog * WATCHDOG_UNIT_S if watchdog else None)

    def _show_present(self) -> None:
        memory = self._memory
        # One assignment, so that a read never mixes values of two moments.
        current, velocity, position = self.drive.present()
        memory[126:136] = _PRESENT.pack(current, velocity, position)
        memory[120:122] = (int(self.drive.now_s * 1e3) % 32768).to_bytes(2, "little")
        memory[122] = abs(velocity) > self._get(reg.MOVING_THRESHOLD)

    def _check_environment(self) -> None:
        if self._get(reg.PRESENT_TEMPERATURE) > self._get(reg.TEMPERATURE_LIMIT):
            self._raise_error(ERROR_OVERHEATING)
        voltage = self._get(reg.PRESENT_VOLTAGE)
        if not self._get(reg.MIN_VOLTAGE_LIMIT) <= voltage <= self._get(reg.MAX_VOLTAGE_LIMIT):
            self._raise_error(ERROR_VOLTAGE)

    def _raise_error(self, bit: int) -> None:
        self._memory[70] |= bit
        if self._memory[63] & bit:
            self._shutdown = True
            self._memory[64] = 0
            self.drive.torque_on = False
