"""The clamp's servo on the bus of the arm's servos. It is in current-based position control (operating mode 5) and has no bus watchdog,
so that it holds its angle when the companion falls silent.
"""

from __future__ import annotations

import math

from companion.config.arm import Jaws
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.access import ServoAccess
from companion.io.dynamixel.registers import JawsBlock, Register
from companion.io.dynamixel.scale import RAD_PER_COUNT
from companion.model.servos import COUNTS_PER_TURN, SERVOS, hardware_error_text
from companion.model.team import ClampCommand


class JawsServo:
    """Sets the servo up, commands it, and knows its state. Not thread-safe, but for `command`.

    A command is sent without a request for an answer, which would delay the joints, and again after each read of the bus until the
    read shows that the servo has taken it. A servo that has restarted (a dip of its supply) first gets its settings again; its torque
    stays off until a read shows them, because it would hold with the largest current and at an angle in another turn.
    """

    def __init__(self, jaws: Jaws, servos: ServoAccess) -> None:
        self.servo_id = jaws.servo_id
        self.kind = SERVOS[jaws.servo]
        self.command: ClampCommand | None = None
        """What the clamp is to do; None before the first command, and the torque stays as it is."""
        self.block: JawsBlock | None = None
        """State in the newest read; None if the servo has not answered to it, or has restarted."""
        self._restarted = False
        """Whether the servo has restarted and no read has shown its settings since."""
        self._addresses = dxl.pointers(dxl.JAWS_BLOCK)
        self._goal_current = round(jaws.current_a / self.kind.current_unit_a)
        self._counts = {
            command: round(math.radians(angle_deg) / RAD_PER_COUNT)
            for command, angle_deg in ((ClampCommand.OPEN, jaws.open_deg), (ClampCommand.CLOSE, jaws.empty_deg))
        }
        self._turn_counts = 0
        """Whole turns to add to the servo's position; it loses their number when it is switched off."""
        self._servos = servos

    def set_up(self) -> None:
        """Write the settings that differ, with the torque off. A clamp that has all of them keeps its torque: it may hold a bar in the
        air, with a companion that was started again.

        Raises:
            DeviceError: the servo does not answer, or refuses.
        """
        read, write, own = self._servos.read, self._servos.write, self.servo_id
        settings = (
            (dxl.RETURN_DELAY, 0),
            (dxl.OPERATING_MODE, dxl.MODE_CURRENT_POSITION),
            (dxl.BUS_WATCHDOG, 0),
            (self._indirect, int.from_bytes(self._addresses, "little")),
        )
        differ = [(register, wanted) for register, wanted in settings if read(own, register) != wanted]
        if differ:
            write(own, dxl.TORQUE_ENABLE, 0)
            for register, wanted in differ:
                write(own, register, wanted)
        write(own, dxl.GOAL_CURRENT, self._goal_current)
        self._count_turns(read(own, dxl.PRESENT_POSITION))

    def take(self, data: bytes | None) -> None:
        """Take the servo's data in a read of the bus; None if it has not answered."""
        self.block = None
        if data is None:
            return
        if not any(data):  # it has lost its indirect addresses
            self._restarted = True
            return
        self.block = JawsBlock.from_bytes(data)
        if self._restarted and self.block.goal_current == self._goal_current:
            self._restarted = False
            self._count_turns(self.block.position_count)

    @property
    def angle_rad(self) -> float | None:
        """Return the angle of the shaft in the newest read, rad; None if the servo has not answered to it, or has restarted."""
        return (
            None
            if self.block is None or self._restarted
            else (self.block.position_count + self._turn_counts) * RAD_PER_COUNT
        )

    @property
    def problem(self) -> str:
        """Return the hardware error in the newest read; empty if there is none. The servo gets no torque then."""
        if self.block is None or not self.block.hardware_error:
            return ""
        text = f"reports a hardware error: {hardware_error_text(self.block.hardware_error)}"
        return str(self._servos.error(self.servo_id, text))

    @property
    def pending(self) -> bool:
        """Return whether the newest read does not show the command, or not the settings."""
        if self._restarted:
            return True
        if self.command is None:
            return False
        if self.block is None:
            return True
        if not self.block.torque_on:
            return not self.block.hardware_error
        return self.block.goal_count != self._goal(self.command)

    def send(self) -> None:
        """Send the command, or the settings that a restart has lost; never waits.

        Torque is only sent to a servo that answers and reports no hardware error; it goes first, because it sets the goal to the
        present position.

        Raises:
            OSError: the port is gone.
        """
        if self._restarted:
            self._write(self._indirect, int.from_bytes(self._addresses, "little"))
            self._write(dxl.GOAL_CURRENT, self._goal_current)
        elif self.command is not None:
            if self.block is not None and not self.block.torque_on and not self.block.hardware_error:
                self._write(dxl.TORQUE_ENABLE, 1)
            self._write(dxl.GOAL_POSITION, self._goal(self.command))

    @property
    def _indirect(self) -> Register:
        return Register(dxl.INDIRECT_ADDRESS_1, len(self._addresses), "indirect addresses")

    def _count_turns(self, position_count: int) -> None:
        middle = sum(self._counts.values()) / len(self._counts)
        self._turn_counts = COUNTS_PER_TURN * round((middle - position_count) / COUNTS_PER_TURN)

    def _goal(self, command: ClampCommand) -> int:
        return self._counts[command] - self._turn_counts

    def _write(self, register: Register, value: int) -> None:
        data = [self.servo_id, *value.to_bytes(register.size, "little", signed=register.signed)]
        with self._servos.exchange(f"writing {register}"):
            self._servos.protocol.syncWriteTxOnly(self._servos.port, register.address, register.size, data, len(data))
