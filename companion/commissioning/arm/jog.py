"""`companion arm jog`: what keys, or an option, mean for the motion of one joint. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from companion.commissioning.arm.motion import SPEED_MAX_DEG_S, Motion, Moved
from companion.model.types import ArmState, Vec2

STEP_DEG: Final = 2.0
"""A key moves the joint so far; held down, it repeats before that is over."""
KEY_TIMEOUT_S: Final = 0.5
"""No key for so long: the joint stays where it is."""
IDLE_S: Final = 60.0
"""No key for so long: the arm is let go of."""
FORWARD_KEYS: Final = frozenset({"\x1b[C", "\x1b[A", "+", "="})
BACKWARD_KEYS: Final = frozenset({"\x1b[D", "\x1b[B", "-"})
END_KEYS: Final = frozenset({"q", "Q", "\x1b", "\x04"})
JOINT_KEYS: Final = {"1": 0, "2": 1}


def keys_in(data: str) -> list[str]:
    """What a terminal sends, key by key: arrows are three characters."""
    keys: list[str] = []
    at = 0
    while at < len(data):
        size = 3 if data[at : at + 2] == "\x1b[" and len(data) >= at + 3 else 1
        keys.append(data[at : at + size])
        at += size
    return keys


class ToAngle:
    """Leads one joint to an angle.

    Args:
        joint: 0 or 1.
        goal_deg: within the walls, margin kept.
    """

    def __init__(self, joint: int, goal_deg: float) -> None:
        self._joint = joint
        self._goal_rad = math.radians(goal_deg)
        self._gone = False
        self.moved: Moved | None = None

    def begin(self, state: ArmState) -> Sequence[Vec2]:
        """Here and there."""
        first, second = state.angle_rad
        there = (self._goal_rad, second) if self._joint == 0 else (first, self._goal_rad)
        return (state.angle_rad, there)

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """True: it is there."""
        self.moved = moved
        if not self._gone:
            self._gone = True
            motion.go(self._joint, self._goal_rad, math.radians(SPEED_MAX_DEG_S))
            return False
        return moved is not None and moved.reached


class ByKeys:
    """Leads whichever joint somebody moves by keys, as long as they are pressed."""

    def __init__(self) -> None:
        self.joint = 0
        self.told = ""
        self.state: ArmState | None = None
        self.moved: Moved | None = None
        self._pressed: list[str] = []
        self._moves_until_s = 0.0
        self._ends_s = math.inf
        self._moving = False

    def press(self, keys: Sequence[str]) -> None:
        """Somebody pressed these."""
        self._pressed += keys

    def begin(self, state: ArmState) -> Sequence[Vec2]:
        """Nowhere yet."""
        self._ends_s = state.stamp_s + IDLE_S
        return (state.angle_rad,)

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """True: somebody ends it, or nobody is there any more."""
        self.state, self.moved = state, moved
        pressed, self._pressed = self._pressed, []
        for key in pressed:
            self._ends_s = state.stamp_s + IDLE_S
            if key in END_KEYS:
                return True
            if key in JOINT_KEYS:
                self.joint = JOINT_KEYS[key]
                self._halt(motion)
            elif key in FORWARD_KEYS or key in BACKWARD_KEYS:
                self._go(motion, 1.0 if key in FORWARD_KEYS else -1.0, state)
            else:
                self._halt(motion)
        if self._moving and state.stamp_s > self._moves_until_s:
            self._halt(motion)
        return state.stamp_s > self._ends_s

    def _go(self, motion: Motion, way: float, state: ArmState) -> None:
        goal_rad = motion.reference_rad[self.joint] + way * math.radians(STEP_DEG)
        there = (goal_rad, state.angle_rad[1]) if self.joint == 0 else (state.angle_rad[0], goal_rad)
        self.told = motion.refusal((there,))
        if self.told:
            self._halt(motion)
            return
        motion.go(self.joint, goal_rad, math.radians(SPEED_MAX_DEG_S))
        self._moving, self._moves_until_s = True, state.stamp_s + KEY_TIMEOUT_S

    def _halt(self, motion: Motion) -> None:
        self._moving = False
        motion.halt()
