"""Motor and encoder of one servo, on world time, without I/O or control table.

`sitl.servo.model.ServoModel` adds the control table for the bus; the fast closed loop uses the drive directly.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

COUNTS_PER_TURN = 4096
RAD_PER_COUNT: Final = 2.0 * math.pi / COUNTS_PER_TURN
AMP_PER_COUNT = 2.69e-3
"""Unit of current of the XM430-W210, the default of `ServoDrive.amp_per_count`."""
RAD_S_PER_COUNT: Final = 0.229 * 2.0 * math.pi / 60.0

MODE_CURRENT: Final = 0
MODE_POSITION: Final = 3
MODE_CURRENT_POSITION: Final = 5

# Position loop of modes 3 and 5 at the default P gain: about 23 N m/rad and 1.3 N m s/rad at 1.3 N m/A.
_AMP_PER_RAD = 17.5
_AMP_PER_RAD_S = 1.0
_INT32: Final = 1 << 31
_TIME_EPSILON_S: Final = 1e-9


class ServoDrive:
    """Computes the motor current at every step of the world, and the present values that the servo reports.

    Args:
        shaft_angle_rad: shaft angle before the first `update`.
    """

    def __init__(self, shaft_angle_rad: float = 0.0) -> None:
        self.amp_per_count = AMP_PER_COUNT
        """Unit of current of the servo's model."""
        self.torque_on = False
        """Whether torque is enabled (register 64)."""
        self.mode = MODE_POSITION
        """Operating mode (register 11)."""
        self.direction = 1
        """1, or -1 in reverse mode (register 10)."""
        self.current_limit_counts = 1193
        """Current limit (register 38)."""
        self.homing_counts = 0
        """Homing offset (register 20)."""
        self.goal_position_counts = 0
        """Goal position (register 116)."""
        self.position_gain = 1.0
        """Position P gain (register 84) divided by its default."""
        self.watchdog_tripped = False
        """Whether the watchdog has switched the motor off; `start_watchdog` clears it."""
        self.goal_delay_s = 0.0
        """Delay from setting a goal current to its effect."""
        self.current_loop_s = 0.0
        """Time constant of the current loop; 0 if the current reaches its goal at once."""
        self._current = 0.0
        """Present current in counts, unrounded; used only if `current_loop_s` is not 0."""
        self.now_s = 0.0
        self.angle_rad = shaft_angle_rad
        self.velocity_rad_s = 0.0
        self.slip_counts = 0
        """Fault: offset of the encoder caused by a slipped horn."""
        self.turn_counts = 0
        """Whole turns that the encoder has lost; see `forget_turns`."""
        self._goal_current_counts = 0
        self._pending_goals: deque[tuple[float, int]] = deque()
        self._watchdog_s = math.inf
        self._heard_s = 0.0
        self._silent_until_s = math.inf
        """Time at which the watchdog trips unless an instruction arrives."""
        self._updated = False
        self._current_counts = 0
        self.forget_turns()

    def start_over(self) -> None:
        """Forget the course of the shaft, pending goals and a tripped watchdog: world time starts over. Settings stay."""
        self.now_s = self._current = self._heard_s = 0.0
        self.slip_counts = 0
        self._updated = False
        if self.mode == MODE_CURRENT:
            self.set_goal_current(0, at_once=True)
        self.start_watchdog(self._watchdog_s)

    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Process the shaft's state and return the motor current.

        Args:
            t_s: world time; must not decrease.
            shaft_angle_rad: continuous shaft angle in the servo's own convention (counts = angle / 2 pi * 4096).
            shaft_velocity_rad_s: shaft velocity, same convention.

        Returns:
            Motor current in A, positive towards positive angle; 0 while the motor is off.
        """
        since_s = t_s - self.now_s
        self.now_s = t_s
        self.angle_rad = shaft_angle_rad
        self.velocity_rad_s = shaft_velocity_rad_s
        if not self._updated:
            self._updated = True
            self.heard_instruction()
            self.forget_turns()
        if t_s > self._silent_until_s and self.torque_on:
            self.watchdog_tripped = True
            self.set_goal_current(0, at_once=True)
        if self._pending_goals:
            self._receive(t_s)
        if not self.torque_on or self.watchdog_tripped:
            counts = 0
        elif self.mode == MODE_CURRENT:
            limit, goal = self.current_limit_counts, self._goal_current_counts
            counts = limit if goal > limit else -limit if goal < -limit else goal
        else:
            counts = self._position_loop_counts()
        if self.current_loop_s > 0.0:
            self._current -= math.expm1(-since_s / self.current_loop_s) * (counts - self._current)
            self._current_counts = round(self._current)
            return self._current * self.amp_per_count * self.direction
        self._current_counts = counts
        return counts * self.amp_per_count * self.direction

    def set_goal_current(self, counts: int, *, at_once: bool = False) -> None:
        """Set the goal current (register 102), in the servo's own direction; it takes effect `goal_delay_s` later.

        Args:
            at_once: whether the goal takes effect at once and pending goals are dropped.
        """
        if at_once or self.goal_delay_s == 0.0:
            self._pending_goals.clear()
            self._goal_current_counts = counts
        else:
            self._pending_goals.append((math.inf, counts))

    def heard_instruction(self) -> None:
        """Restart the watchdog's timer, because a valid instruction packet was on the bus."""
        self._heard_s = self.now_s
        self._silent_until_s = self.now_s + self._watchdog_s

    def start_watchdog(self, period_s: float | None) -> None:
        """Set the bus watchdog (register 98) and clear its trip: if no instruction arrives for `period_s`, the motor is switched off
        and the goal current becomes 0. None disables it. The time is counted from the last instruction, not from this call.
        """
        self.watchdog_tripped = False
        self._watchdog_s = math.inf if period_s is None else period_s
        self._silent_until_s = self._heard_s + self._watchdog_s

    def present(self) -> tuple[int, int, int]:
        """Return the current, velocity and position in counts at the last `update` (registers 126, 128 and 132)."""
        direction = self.direction
        position = (
            direction * round(self.angle_rad / RAD_PER_COUNT) - self.turn_counts + self.homing_counts + self.slip_counts
        )
        velocity = direction * round(self.velocity_rad_s / RAD_S_PER_COUNT)
        if not -_INT32 <= position < _INT32:
            position = (position + _INT32) % (2 * _INT32) - _INT32
        if not -_INT32 <= velocity < _INT32:
            velocity = max(-_INT32, min(_INT32 - 1, velocity))
        return self._current_counts, velocity, position

    def forget_turns(self) -> None:
        """Reduce the position to one turn, because the encoder is absolute only within one turn."""
        counts = self.direction * round(self.angle_rad / RAD_PER_COUNT)
        self.turn_counts = counts - counts % COUNTS_PER_TURN
        self.show_no_current()

    def show_no_current(self) -> None:
        """Report a present current of 0 until the next `update`."""
        self._current_counts = 0

    def _receive(self, t_s: float) -> None:
        """Apply pending goals that are due; the delay of goals set since the previous step begins now."""
        goals = self._pending_goals
        for i, (due_s, counts) in enumerate(goals):
            if due_s == math.inf:
                goals[i] = (t_s + self.goal_delay_s, counts)
        while goals and goals[0][0] <= t_s + _TIME_EPSILON_S:
            self._goal_current_counts = goals.popleft()[1]

    def _position_loop_counts(self) -> int:
        limit = self.current_limit_counts
        if self.mode == MODE_CURRENT_POSITION:
            limit = min(limit, abs(self._goal_current_counts))
        goal_rad = (self.goal_position_counts + self.turn_counts - self.homing_counts) * RAD_PER_COUNT
        error_rad = goal_rad - self.direction * self.angle_rad
        damping_a = _AMP_PER_RAD_S * self.direction * self.velocity_rad_s
        current_a = self.position_gain * _AMP_PER_RAD * error_rad - damping_a
        return max(-limit, min(limit, round(current_a / self.amp_per_count)))
