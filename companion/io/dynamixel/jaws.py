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
from companion.model.servos import COUNTS_PER_TURN, SERVOS
from companion.model.team import ClampCommand


class JawsServo:
    """Sets the servo up, commands it, and knows its state. Not thread-safe, but for `command`.

    A command is sent without a request for an answer, which would delay the joints, and again after each read of the bus until the
    read shows that the servo has taken it.
    """

    def __init__(self, jaws: Jaws, servos: ServoAccess) -> None:
        self.servo_id = jaws.servo_id
        self.kind = SERVOS[jaws.servo]
        self.command: ClampCommand | None = None
        """What the clamp is to do; None before the first command, and the torque stays as it is."""
        self.block: JawsBlock | None = None
        """State in the newest read; None if the servo has not answered to it."""
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
        addresses = dxl.pointers(dxl.JAWS_BLOCK)
        settings = (
            (dxl.RETURN_DELAY, 0),
            (dxl.OPERATING_MODE, dxl.MODE_CURRENT_POSITION),
            (dxl.BUS_WATCHDOG, 0),
            (
                Register(dxl.INDIRECT_ADDRESS_1, len(addresses), "indirect addresses"),
                int.from_bytes(addresses, "little"),
            ),
        )
        differ = [(register, wanted) for register, wanted in settings if read(own, register) != wanted]
        if differ:
            write(own, dxl.TORQUE_ENABLE, 0)
            for register, wanted in differ:
                write(own, register, wanted)
        write(own, dxl.GOAL_CURRENT, self._goal_current)
        middle = sum(self._counts.values()) / len(self._counts)
        self._turn_counts = COUNTS_PER_TURN * round((middle - read(own, dxl.PRESENT_POSITION)) / COUNTS_PER_TURN)

    @property
    def angle_rad(self) -> float | None:
        """Return the angle of the shaft in the newest read, rad; None if the servo has not answered to it."""
        return None if self.block is None else (self.block.position_count + self._turn_counts) * RAD_PER_COUNT

    @property
    def pending(self) -> bool:
        """Return whether the newest read does not show the command."""
        if self.command is None:
            return False
        return self.block is None or not self.block.torque_on or self.block.goal_count != self._goal(self.command)

    def send(self) -> None:
        """Send the command, torque first, which sets the goal to the present position; never waits.

        Raises:
            OSError: the port is gone.
        """
        if self.command is not None:
            if self.block is None or not self.block.torque_on:
                self._write(dxl.TORQUE_ENABLE, 1)
            self._write(dxl.GOAL_POSITION, self._goal(self.command))

    def _goal(self, command: ClampCommand) -> int:
        return self._counts[command] - self._turn_counts

    def _write(self, register: Register, value: int) -> None:
        data = [self.servo_id, *value.to_bytes(register.size, "little", signed=register.signed)]
        with self._servos.exchange(f"writing {register}"):
            self._servos.protocol.syncWriteTxOnly(self._servos.port, register.address, register.size, data, len(data))
