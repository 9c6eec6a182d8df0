"""What the trackers need in addition to the inputs: the activity of the core, and the age of an input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.model.outputs import ControlLog, TetherState
from companion.model.team import Grip
from companion.model.types import Vec3

Values = tuple[object, ...]
"""Values for a rule's message, returned by a predicate whose condition holds."""
HOLDS: Final[Values] = ()
"""The condition holds, and the message contains no values."""


@dataclass(slots=True)
class FlightContext:
    """The part of the core's activity on which rules depend. The core keeps one object and updates it in every tick."""

    airborne: bool
    """The rotors may lift: from arming to touchdown."""
    offboard_expected: bool
    """The companion commands the vehicle, so PX4 must be in OFFBOARD."""
    tracking_error_m: float | None
    """Distance from the reference; None while no plan is flown."""
    control: ControlLog | None = None
    """Log record of the control law in the last tick; None while the law is not active."""
    disturbance_world_n: Vec3 | None = None
    """Force on the vehicle other than rotor thrust and weight, from its motion; None on the ground."""
    caught: bool = False
    """A payload is on board."""
    tether: TetherState | None = None
    contact_n: float | None = None
    """Measured force of the surface that the mission touches; None if it touches none."""
    found_armed: str | None = None
    """Event text if PX4 was armed without a request from the companion; `airborne` then shows whether the vehicle is flying."""
    torque_refused: str | None = None
    """Why the gate sent none of the law's joint torques in the last tick; None if they were sent."""
    grip: Grip = Grip.FREE
    """What the vehicle has in its clamp."""
    chases: bool = False
    """The reference chases a ball, or moves aside for one: its accelerations swing the vehicle to and fro."""
    waiting: bool = False
    """Inputs are still missing on the ground: only rules with `while_waiting` are evaluated."""


class Age:
    """Age of an input, counted only while this process was awake.

    When the process itself is delayed, all inputs appear stale although nothing was lost: what arrived during the delay is read a
    moment later. The rules `loop_late` and `loop_stalled` report the delay.
    """

    __slots__ = ("_seen_awake_s", "_stamp_s")

    def __init__(self) -> None:
        self._stamp_s: float | None = None
        self._seen_awake_s = -math.inf

    def update(self, awake_s: float, stamp_s: float | None) -> float:
        """Return the awake time in s since the stamp last changed; infinite before the first stamp.

        Args:
            awake_s: awake time of this process.
            stamp_s: stamp of the newest input; None if there is none in this tick.
        """
        if stamp_s is not None and stamp_s != self._stamp_s:
            self._stamp_s, self._seen_awake_s = stamp_s, awake_s
        return awake_s - self._seen_awake_s
