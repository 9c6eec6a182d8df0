"""Finds zeros, directions and swapped plugs of the arm's servos from hand-held poses. No I/O."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from companion.commissioning.arm.poses import SWING_MIN_DEG, Step, steps_of
from companion.config.arm import Arm
from companion.config.base import Location
from companion.config.document import Data
from companion.model.servos import COUNTS_PER_TURN

HELD_S: Final = 2.0
"""Time at rest after which a pose is accepted."""
STILL_DEG: Final = 1.5
"""Largest motion of a joint at rest."""
BEGUN_DEG: Final = 5.0
"""Motion that begins a step."""
NEAR_SHARE: Final = 0.35
"""Largest accepted error of an exact turn, as a fraction of the turn."""
ALONE_SHARE: Final = 0.35
"""Largest accepted motion of another joint, as a fraction of the turn."""
HAND_DEG: Final = 2.0
"""Accuracy of a link held level or plumb; a zero in the vehicle file is kept if its error is smaller."""
DISAGREE_DEG: Final = 8.0
"""Largest difference between the zeros of two poses; a larger one means that a pose was not held, or that the arm slips on a servo."""
_DEG_PER_COUNT: Final = 360.0 / COUNTS_PER_TURN

Counts = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ZeroJoint:
    """Servo, direction and zero of one joint."""

    servo_id: int
    sign: int
    zero_count: int
    """Present position (register 132) at joint angle 0, within one turn."""
    spread_deg: float | None
    """Difference between the zeros of two poses; None if only one pose determines the zero."""


@dataclass(frozen=True, slots=True)
class ZeroResult:
    """Servos, directions and zeros of all joints, shoulder first."""

    joints: tuple[ZeroJoint, ...]
    swapped: bool
    """Whether the vehicle file assigns a servo to another joint."""

    def changes(self, arm: Arm) -> dict[Location, Data]:
        """Return the values to change in the vehicle file; empty if it is correct within `HAND_DEG`."""
        wanted: dict[Location, Data] = {}
        for index, (found, joint) in enumerate(zip(self.joints, arm.joints, strict=True)):
            at: Location = ("arm", "joints", index)
            if found.servo_id != joint.servo_id:
                wanted[(*at, "servo_id")] = found.servo_id
            if found.sign != joint.sign:
                wanted[(*at, "sign")] = found.sign
            if abs(self.error_deg(arm, index)) > HAND_DEG:
                wanted[(*at, "zero_count")] = found.zero_count
        return wanted

    def error_deg(self, arm: Arm, index: int) -> float:
        """Return the error of the vehicle file's zero within one turn of the servo, -180 to 180."""
        counts = arm.joints[index].zero_count - self.joints[index].zero_count
        return ((counts + COUNTS_PER_TURN / 2) % COUNTS_PER_TURN - COUNTS_PER_TURN / 2) * _DEG_PER_COUNT


@dataclass(frozen=True, slots=True)
class ZeroView:
    """State of the guided measurement, for display."""

    step: Step | None
    """The step under way; None at the end."""
    number: int
    moved_deg: tuple[float, ...]
    """Motion since the step began, as each servo counts, in the order of the vehicle file's servos."""
    held: float
    """Fraction of `HELD_S` for which the arm has been held, 0 to 1."""
    notice: str
    """Deviation from the requested pose; empty if there is none."""
    result: ZeroResult | None = None
    failed: str = ""
    """Why the poses contradict each other, which ends the test."""


class ZeroGuide:
    """Watches the arm, decides when a pose is held, and computes the result at the end.

    Args:
        arm: arm from the vehicle file; its joint limits determine the poses.

    Raises:
        ConfigError: no suitable poses lie within the joint limits.
    """

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.steps = steps_of(arm)
        self._held: list[Counts] = []
        self._began: Counts | None = None
        self._window: deque[tuple[float, Counts]] = deque()
        self._begun = False

    def update(self, t_s: float, counts: Counts, accept: bool = False) -> ZeroView:
        """Process one reading.

        Args:
            t_s: time on any clock.
            counts: present positions (register 132), in the order of the vehicle file's servos.
            accept: whether the user confirms that the arm is held, even if it has not moved.
        """
        index = len(self._held)
        step = self.steps[index]
        if self._began is None:
            self._began = counts
        moved = tuple((now - began) * _DEG_PER_COUNT for began, now in zip(self._began, counts, strict=True))
        self._begun = self._begun or max(map(abs, moved)) > BEGUN_DEG
        window = self._window
        window.append((t_s, counts))
        while len(window) > 1 and window[1][0] <= t_s - HELD_S:
            window.popleft()
        still_s = self._still_s(t_s)
        notice = self._notice(step, moved)
        ready = (self._begun or accept) and not notice
        share = min(1.0, still_s / HELD_S) if ready else 0.0
        if share < 1.0:
            return ZeroView(step=step, number=index + 1, moved_deg=moved, held=share, notice=notice)
        self._held.append(_mean([one for _, one in window]))
        self._began, self._begun = self._held[-1], False
        window.clear()
        if len(self._held) < len(self.steps):
            return ZeroView(
                step=self.steps[index + 1], number=index + 2, moved_deg=(0.0,) * len(counts), held=0.0, notice=""
            )
        return self._conclude(moved)

    def _still_s(self, t_s: float) -> float:
        newest = self._window[-1][1]
        low, high = list(newest), list(newest)
        since_s = t_s
        for at_s, counts in reversed(self._window):
            low, high = list(map(min, low, counts)), list(map(max, high, counts))
            if max(most - least for least, most in zip(low, high, strict=True)) * _DEG_PER_COUNT > STILL_DEG:
                break
            since_s = at_s
        return t_s - since_s

    def _notice(self, step: Step, moved: tuple[float, ...]) -> str:
        if step.joint is None or not self._begun:
            return ""
        *others, most = sorted(map(abs, moved))
        if others and others[-1] > ALONE_SHARE * max(most, SWING_MIN_DEG):
            return "two joints have moved; turn only the requested one and move the other one back"
        if step.exact and abs(most - abs(step.by_deg)) > NEAR_SHARE * abs(step.by_deg):
            return f"requested {abs(step.by_deg):.0f} deg, but the joint has turned by {most:.0f} deg"
        if most < SWING_MIN_DEG:
            return f"turn the joint further, by at least {SWING_MIN_DEG:.0f} deg; it has turned by {most:.0f} deg"
        return ""

    def _conclude(self, moved: tuple[float, ...]) -> ZeroView:
        view = ZeroView(step=None, number=len(self.steps), moved_deg=moved, held=1.0, notice="")
        # The step with index 1 turns the last joint, the last step the shoulder.
        movers = [_mover(before, after) for before, after in zip(self._held, self._held[1:], strict=False)][::-1]
        twice = next((servo for servo in movers if movers.count(servo) > 1), None)
        if twice is not None:
            servo_id = self._arm.joints[twice].servo_id
            text = f"servo {servo_id} turned in two steps, and another one in none: turn the joints one after the other, as requested"
            return replace(view, held=0.0, failed=text)
        joints = tuple(
            self._joint(joint, servo, [held[servo] for held in self._held]) for joint, servo in enumerate(movers)
        )
        for joint, found in enumerate(joints):
            if found.spread_deg is not None and found.spread_deg > DISAGREE_DEG:
                text = f"joint {joint + 1}: the poses disagree by {found.spread_deg:.1f} deg"
                text += "; hold the arm more precisely, and check for a slipping horn"
                return replace(view, held=0.0, failed=text)
        return replace(view, result=ZeroResult(joints, movers != list(range(len(movers)))))

    def _joint(self, joint: int, servo: int, counts: Sequence[int]) -> ZeroJoint:
        # In the steps after its own, a joint is only roughly held.
        at = len(self.steps) - 1 - joint
        turns = self.steps[at]
        sign = 1 if (counts[at] - counts[at - 1]) * turns.by_deg > 0.0 else -1
        last = at + turns.exact
        shown = list(zip(counts, self.steps, strict=True))[:last]
        zeros = [count - sign * step.pose_deg[joint] / _DEG_PER_COUNT for count, step in shown]
        zero = round(sum(zeros) / len(zeros)) % COUNTS_PER_TURN
        spread = (max(zeros) - min(zeros)) * _DEG_PER_COUNT if len(zeros) > 1 else None
        return ZeroJoint(self._arm.joints[servo].servo_id, sign, zero, spread)


def _mover(before: Counts, after: Counts) -> int:
    return max(reversed(range(len(before))), key=lambda servo: abs(after[servo] - before[servo]))


def _mean(counts: Sequence[Counts]) -> Counts:
    return tuple(round(math.fsum(own) / len(own)) for own in zip(*counts, strict=True))
