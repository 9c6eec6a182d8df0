"""The clamp of the fast closed loop: its servo without the bus."""

from __future__ import annotations

import math

from companion.config.arm import Jaws
from companion.config.vehicle import Vehicle
from companion.model.team import ClampCommand, ClampState
from sitl.servo.drive import MODE_CURRENT_POSITION, RAD_PER_COUNT, ServoDrive
from sitl.servo.from_config import jaws_servo_of
from sitl.servo.model import ERROR_OVERLOAD


class FastClamp:
    """The companion's reads and writes of the clamp's servo.

    Args:
        drive: the servo's motor; it is set to current-based position control.
    """

    def __init__(self, jaws: Jaws, drive: ServoDrive) -> None:
        self._jaws, self.drive = jaws, drive
        self._command: ClampCommand | None = None
        self._error: int | None = None
        drive.mode, drive.torque_on = MODE_CURRENT_POSITION, False
        drive.set_goal_current(round(jaws.current_a / drive.amp_per_count), at_once=True)

    @classmethod
    def of(cls, vehicle: Vehicle) -> FastClamp | None:
        """Return the clamp of a vehicle; None without one."""
        servo = jaws_servo_of(vehicle)
        return None if servo is None or vehicle.jaws is None else cls(vehicle.jaws, servo.drive)

    def read(self, t_s: float) -> ClampState:
        """Return the state at this time."""
        return ClampState(t_s, self.drive.present()[2] * RAD_PER_COUNT, self._error)

    def trip_overload(self) -> None:
        """Raise the overload error, which switches the torque off."""
        self._error, self.drive.torque_on = ERROR_OVERLOAD, False

    def write(self, command: ClampCommand | None) -> None:
        """Carry out a command that is new."""
        if command is None or command is self._command:
            return
        self._command = command
        angle_deg = self._jaws.open_deg if command is ClampCommand.OPEN else self._jaws.empty_deg
        self.drive.goal_position_counts = round(math.radians(angle_deg) / RAD_PER_COUNT)
        self.drive.torque_on = self._error is None
