"""`companion arm jog` without `--to`: moves a joint with keys. No I/O."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Final

from companion.commissioning.arm.motion import SPEED_MAX_DEG_S, Motion, Moved
from companion.model.types import ArmState, Joints

STEP_DEG: Final = 2.0
"""Motion per key press; a held key repeats before the motion ends."""
KEY_TIMEOUT_S: Final = 0.5
"""Time without a key after which the joint stops."""
IDLE_S: Final = 60.0
"""Time without a key after which the arm goes limp."""
FORWARD_KEYS: Final = frozenset({"\x1b[C", "\x1b[A", "+", "="})
BACKWARD_KEYS: Final = frozenset({"\x1b[D", "\x1b[B", "-"})
END_KEYS: Final = frozenset({"q", "Q", "\x1b", "\x04"})


def keys_in(data: str) -> list[str]:
    """Split a terminal's input into keys; an arrow is three characters."""
    return re.findall(r"\x1b\[.|.", data, re.DOTALL)


class ByKeys:
    """Leader that moves the selected joint while an arrow key (or + or -) is pressed; the digits select the joint.

    Args:
        pressed: returns the terminal's input since the last call.
    """

    def __init__(self, pressed: Callable[[], str]) -> None:
        self._pressed = pressed
        self._joint = 0
        self._refusal = ""
        self._moves_until_s = 0.0
        self._ends_s = math.inf
        self._moving = False

    def begin(self, state: ArmState) -> list[Joints]:
        """Return the current pose of the arm."""
        self._ends_s = state.stamp_s + IDLE_S
        return [state.angle_rad]

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """Follow the keys. Return True at an end key or after `IDLE_S` without a key."""
        for key in keys_in(self._pressed()):
            self._ends_s = state.stamp_s + IDLE_S
            if key in END_KEYS:
                return True
            if key in "1234567"[: len(state.angle_rad)]:
                self._joint = int(key) - 1
                self._halt(motion)
            elif key in FORWARD_KEYS or key in BACKWARD_KEYS:
                self._go(motion, 1.0 if key in FORWARD_KEYS else -1.0, state)
            else:
                self._halt(motion)
        if self._moving and state.stamp_s > self._moves_until_s:
            self._halt(motion)
        return state.stamp_s > self._ends_s

    def status(self) -> str:
        """Return the joint that the keys move, or why it must not move further."""
        return self._refusal or f"keys move joint {self._joint + 1}"

    def _go(self, motion: Motion, way: float, state: ArmState) -> None:
        goal_rad = motion.reference_rad[self._joint] + way * math.radians(STEP_DEG)
        there = list(state.angle_rad)
        there[self._joint] = goal_rad
        self._refusal = motion.refusal((tuple(there),))
        if self._refusal:
            self._halt(motion)
            return
        motion.go(self._joint, goal_rad, math.radians(SPEED_MAX_DEG_S))
        self._moving, self._moves_until_s = True, state.stamp_s + KEY_TIMEOUT_S

    def _halt(self, motion: Motion) -> None:
        self._moving = False
        motion.halt()
