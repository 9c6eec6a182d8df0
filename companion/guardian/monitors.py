"""Detects a stalled flight process, and implausible poses. Pure; time is an argument."""

from __future__ import annotations

import math

from companion.model.types import Vec3

AWAKE_STEP_MAX_S = 0.02
"""Maximum silence that one pass of the guardian's loop (10 ms) may add: time in which the guardian itself was not running proves
nothing.
"""
JUMP_M = 0.5
SPEED_MAX_M_S = 4.0


class StallWatch:
    """Measures the flight process's silence, counting only time in which the guardian itself was running.

    Args:
        timeout_s: silence after which the flight process counts as stalled.
    """

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._last_s: float | None = None
        self.silent_s = 0.0

    def update(self, now_s: float, heard: bool) -> bool:
        """Update after one pass of the loop; return whether the flight process hangs."""
        step_s = 0.0 if self._last_s is None else min(now_s - self._last_s, AWAKE_STEP_MAX_S)
        self._last_s = now_s
        self.silent_s = 0.0 if heard else self.silent_s + step_s
        return self.silent_s > self._timeout_s


class PoseFilter:
    """Rejects poses that the vehicle cannot have reached: another body, or a mirrored solution.

    The allowed distance grows with the time since the last accepted pose, so no position is rejected permanently.
    """

    def __init__(self, stamp_s: float, position_world_m: Vec3) -> None:
        """Start from the last pose that the flight process accepted; `stamp_s` is -inf if there was none."""
        self._stamp_s = stamp_s
        self._position_world_m = position_world_m

    def check(self, stamp_s: float, position_world_m: Vec3) -> bool:
        """Whether a tracked pose is plausible; an accepted pose becomes the reference for the next check."""
        allowed_m = JUMP_M + SPEED_MAX_M_S * (stamp_s - self._stamp_s)
        if not math.dist(position_world_m, self._position_world_m) <= allowed_m:
            return False
        self._stamp_s, self._position_world_m = stamp_s, position_world_m
        return True
