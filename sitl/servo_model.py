"""One emulated XM430-W210-T: its control table on the side of the bus, its motor on the side of the world. No I/O.

Time is the world's: the watchdog runs on the `t_s` of `update`.
"""

from __future__ import annotations

import math
import struct

from sitl import servo_registers as reg
from sitl.servo_protocol import ALERT, StatusError
from sitl.servo_registers import Register

COUNTS_PER_TURN = 4096
RAD_PER_COUNT = 2.0 * math.pi / COUNTS_PER_TURN
AMP_PER_COUNT = 2.69e-3
RAD_S_PER_COUNT = 0.229 * 2.0 * math.pi / 60.0
WATCHDOG_UNIT_S = 0.020
WATCHDOG_TRIPPED = 0xFF

ERROR_VOLTAGE = 0x01
ERROR_OVERHEATING = 0x04
ERROR_OVERLOAD = 0x20

MODE_CURRENT, MODE_POSITION, MODE_CURRENT_POSITION = 0, 3, 5
MODES = (MODE_CURRENT, MODE_POSITION, MODE_CURRENT_POSITION)

# Position loop of modes 3 and 5 at the default P gain: about 23 N m/rad and 1.3 N m s/rad at 1.3 N m/A.
_AMP_PER_RAD = 17.5
_AMP_PER_RAD_S = 1.0
_PRESENT = struct.Struct("<hii")
_INT16 = struct.Struct("<h")
_INT32_FIELD = struct.Struct("<i")
_INT32 = 1 << 31


class ServoRefusal(Exception):
    """An instruction that the servo answers with an error number."""

    def __init__(self, error: StatusError) -> None:
        super().__init__(error.name)
        self.error = error


class ServoModel:
    """A servo with factory settings except for id and baud rate.

    Args:
        servo_id: register 7.
        baud_bps: register 8 as a rate; the servo hears only packets sent at it.
        firmware: register 6.
        model: register 0; another number makes it a servo of another kind to whom asks.
        shaft_angle_rad: where the shaft is before the first `update`.

    Raises:
        ValueError: baud rate or id that the servo does not have.
    """

    def __init__(
        self,
        servo_id: int,
        *,
        baud_bps: int = 3_000_000,
        firmware: int = 48,
        model: int = reg.MODEL,
        shaft_angle_rad: float = 0.0,
    ) -> None:
        if baud_bps not in reg.BAUDS:
            raise ValueError(f"an XM430 has no baud rate {baud_bps}; it has {reg.BAUDS}")
        if not reg.ID.low <= servo_id <= reg.ID.high:
            raise ValueError(f"servo id {servo_id} is not in 0..252")
        self._memory = bytearray(reg.TABLE_SIZE)
        for register in reg.REGISTERS:
            self._set(register, register.initial)
        self._set(reg.MODEL_NUMBER, model)
        self._set(reg.ID, servo_id)
        self._set(reg.BAUD, reg.BAUDS.index(baud_bps))
        self._set(reg.FIRMWARE, firmware)
        self._now_s = 0.0
        self._heard_s = 0.0
        self._angle_rad = shaft_angle_rad
        self._velocity_rad_s = 0.0
        self._turn_counts = 0
        self._shutdown = False
        self._silent = False
        self._registered: tuple[int, bytes] | None = None
        self._updated = False
        self._power_on()

    # --- side of the world -------------------------------------------------------------------------------------------

    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Latch what the encoder sees and return the motor's current.

        Args:
            t_s: the world's time; must not run backwards.
            shaft_angle_rad: continuous shaft angle in the servo's own convention (counts = angle / 2 pi * 4096).
            shaft_velocity_rad_s: shaft velocity, same convention.

        Returns:
            Current in A that flows now, positive towards positive angle; 0 whenever the motor lets go.
        """
        self._now_s = t_s
        self._angle_rad = shaft_angle_rad
        self._velocity_rad_s = shaft_velocity_rad_s
        if not self._updated:
            self._updated = True
            self._heard_s = t_s
            self._forget_turns()
        memory = self._memory
        watchdog = memory[98]
        if (
            watchdog
            and watchdog != WATCHDOG_TRIPPED
            and memory[64]
            and t_s - self._heard_s > watchdog * WATCHDOG_UNIT_S
        ):
            memory[98] = WATCHDOG_TRIPPED
            for goal in (reg.GOAL_CURRENT, reg.GOAL_VELOCITY):
                self._set(goal, 0)
        counts = self._current_counts()
        self._latch(counts)
        return counts * AMP_PER_COUNT * self._direction

    def fail_silent(self, silent: bool) -> None:
        """Break (or mend) the data wire: the servo neither hears nor answers, its motor goes on until its watchdog trips."""
        self._silent = silent

    def trip_overload(self) -> None:
        """Overload error, as after holding more than the motor can."""
        self._raise_error(ERROR_OVERLOAD)

    def set_temperature_c(self, temperature_c: float) -> None:
        """Motor temperature; above register 31 it is an overheating error."""
        self._set(reg.PRESENT_TEMPERATURE, max(0, min(255, round(temperature_c))))
        self._check_environment()

    def set_voltage_v(self, voltage_v: float) -> None:
        """Supply voltage; outside registers 34 to 32 it is an input voltage error."""
        self._set(reg.PRESENT_VOLTAGE, max(0, round(voltage_v * 10.0)))
        self._check_environment()

    # --- side of the bus ---------------------------------------------------------------------------------------------

    @property
    def servo_id(self) -> int:
        """Register 7."""
        return self._memory[7]

    @property
    def secondary_id(self) -> int:
        """Register 12; above 252 it is off."""
        return self._memory[12]

    @property
    def baud_bps(self) -> int:
        """Register 8 as a rate."""
        return reg.BAUDS[self._memory[8]]

    @property
    def model(self) -> int:
        """Register 0."""
        return self._get(reg.MODEL_NUMBER)

    @property
    def firmware(self) -> int:
        """Register 6."""
        return self._memory[6]

    @property
    def return_delay_s(self) -> float:
        """Register 9, 2 us each."""
        return self._memory[9] * 2e-6

    @property
    def status_return_level(self) -> int:
        """Register 68: 0 answers pings, 1 also reads, 2 everything."""
        return self._memory[68]

    @property
    def silent(self) -> bool:
        """The data wire is broken."""
        return self._silent

    @property
    def alert(self) -> int:
        """Bit 7 of every status packet's error byte."""
        return ALERT if self._memory[70] else 0

    def heard_instruction(self) -> None:
        """A valid instruction packet for whomever was on the bus: feeds the watchdog."""
        self._heard_s = self._now_s

    def read(self, address: int, length: int) -> bytes:
        """Bytes of the control table.

        Raises:
            ServoRefusal: DATA_LENGTH for nothing, ACCESS for bytes that are not defined.
        """
        if length == 0:
            raise ServoRefusal(StatusError.DATA_LENGTH)
        return bytes(self._memory[self._resolve(a, StatusError.ACCESS)] for a in range(address, address + length))

    def write(self, address: int, data: bytes) -> None:
        """Write whole registers; all of them or, on a refusal, none.

        Raises:
            ServoRefusal: as the servo's status packet says.
        """
        for register, value in self._checked(address, data):
            self._apply(register, value)

    def register_write(self, address: int, data: bytes) -> None:
        """Keep a write for `action`.

        Raises:
            ServoRefusal: as `write`.
        """
        self._checked(address, data)
        self._registered = (address, data)
        self._set(reg.REGISTERED_INSTRUCTION, 1)

    def action(self) -> None:
        """Carry out the registered write.

        Raises:
            ServoRefusal: INSTRUCTION if there is none, else as `write`.
        """
        if self._registered is None:
            raise ServoRefusal(StatusError.INSTRUCTION)
        address, data = self._registered
        self._registered = None
        self._set(reg.REGISTERED_INSTRUCTION, 0)
        self.write(address, data)

    def reboot(self) -> None:
        """Restart: RAM as new, EEPROM kept, errors cleared unless their cause is still there."""
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
        self._registered = None
        self._power_on()

    def clear_turns(self) -> None:
        """CLEAR 0x01: present position back into one turn.

        Raises:
            ServoRefusal: RESULT_FAIL while the shaft moves.
        """
        if self._memory[122]:
            raise ServoRefusal(StatusError.RESULT_FAIL)
        self._forget_turns()

    # --- registers ---------------------------------------------------------------------------------------------------

    def _get(self, register: Register) -> int:
        return register.decode(self._memory[register.address : register.address + register.size])

    def _set(self, register: Register, value: int) -> None:
        self._memory[register.address : register.address + register.size] = register.encode(value)

    def _resolve(self, address: int, refusal: StatusError) -> int:
        """Address behind a window of indirect data; itself for everything else."""
        pointer = reg.INDIRECT_POINTER.get(address)
        if pointer is not None:
            address = self._memory[pointer] | self._memory[pointer + 1] << 8
            if address in reg.INDIRECT_POINTER:
                return address  # points at a window, by default its own: plain memory
        if address not in reg.REGISTER_AT:
            raise ServoRefusal(refusal)
        return address

    def _checked(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        """The register writes that `data` means, every one of them allowed."""
        if not data:
            raise ServoRefusal(StatusError.DATA_LENGTH)
        targets = [self._resolve(address + i, StatusError.ACCESS) for i in range(len(data))]
        writes: list[tuple[Register, int]] = []
        i = 0
        while i < len(data):
            target = targets[i]
            register = reg.REGISTER_AT.get(target) or Register(target, 1, "indirect data", True, 0, 0, 255)
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
        if not register.low <= value <= register.high:
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
        self._set(register, value)
        if register is reg.TORQUE_ENABLE and value == 1:
            if self._memory[11] == MODE_POSITION:
                self._forget_turns()
            if self._memory[11] != MODE_CURRENT:
                self._set(reg.GOAL_POSITION, self._get(reg.PRESENT_POSITION))
        elif register is reg.OPERATING_MODE:
            self._reset_goals()
            if value == MODE_POSITION:
                self._forget_turns()
        elif register in (reg.HOMING_OFFSET, reg.DRIVE_MODE):
            self._latch(0)
        elif register in (reg.TEMPERATURE_LIMIT, reg.MIN_VOLTAGE_LIMIT, reg.MAX_VOLTAGE_LIMIT):
            self._check_environment()

    # --- inside ------------------------------------------------------------------------------------------------------

    @property
    def _direction(self) -> int:
        return -1 if self._memory[10] & 1 else 1

    def _power_on(self) -> None:
        self._reset_goals()
        self._forget_turns()
        self._check_environment()

    def _reset_goals(self) -> None:
        in_current_mode = self._memory[11] == MODE_CURRENT
        self._set(reg.GOAL_CURRENT, 0 if in_current_mode else self._get(reg.CURRENT_LIMIT))
        self._set(reg.GOAL_PWM, self._get(reg.PWM_LIMIT))
        self._set(reg.GOAL_VELOCITY, 0)

    def _forget_turns(self) -> None:
        """The encoder is absolute within one turn only; which turn it was is lost here."""
        counts = self._direction * round(self._angle_rad / RAD_PER_COUNT)
        self._turn_counts = counts - counts % COUNTS_PER_TURN
        self._latch(0)

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

    def _current_counts(self) -> int:
        memory = self._memory
        if not memory[64] or memory[98] == WATCHDOG_TRIPPED:
            return 0
        # Read without `_get`: this and `_latch` run at every step of the world.
        limit: int
        goal: int
        (limit,) = _INT16.unpack_from(memory, reg.CURRENT_LIMIT.address)
        (goal,) = _INT16.unpack_from(memory, reg.GOAL_CURRENT.address)
        if memory[11] == MODE_CURRENT:
            return max(-limit, min(limit, goal))
        if memory[11] == MODE_CURRENT_POSITION:
            limit = min(limit, abs(goal))
        offset = self._turn_counts - self._get(reg.HOMING_OFFSET)
        goal_rad = (self._get(reg.GOAL_POSITION) + offset) * RAD_PER_COUNT
        gain = self._get(reg.POSITION_P_GAIN) / reg.POSITION_P_GAIN.initial
        error_rad = goal_rad - self._direction * self._angle_rad
        current_a = gain * _AMP_PER_RAD * error_rad - _AMP_PER_RAD_S * self._direction * self._velocity_rad_s
        return max(-limit, min(limit, round(current_a / AMP_PER_COUNT)))

    def _latch(self, current_counts: int) -> None:
        memory = self._memory
        direction = self._direction
        (homing,) = _INT32_FIELD.unpack_from(memory, reg.HOMING_OFFSET.address)
        position = direction * round(self._angle_rad / RAD_PER_COUNT) - self._turn_counts + homing
        velocity = direction * round(self._velocity_rad_s / RAD_S_PER_COUNT)
        position = (position + _INT32) % (2 * _INT32) - _INT32
        velocity = max(-_INT32, min(_INT32 - 1, velocity))
        # One slice assignment: a reader never sees a position of one instant with a velocity of another.
        memory[126:136] = _PRESENT.pack(current_counts, velocity, position)
        memory[120:122] = (int(self._now_s * 1e3) % 32768).to_bytes(2, "little")
        memory[122] = abs(velocity) > _INT32_FIELD.unpack_from(memory, reg.MOVING_THRESHOLD.address)[0]
