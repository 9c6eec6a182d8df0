"""The poses in which the user holds the arm to determine zeros, directions and swapped plugs. Pure functions.

Angles are defined as in the paper: joint 1 from body +x, positive turning down; joint 2 turns the lower link the other way, so that
it points along `alpha_1 - alpha_2`. Only level and plumb directions can be held exactly by hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.config.arm import Arm, Joint
from companion.config.document import ConfigError
from companion.model.types import Joints

SWING_DEG, SWING_MIN_DEG = 45.0, 25.0
"""Swing of a joint whose limits exclude a turn to an exact direction."""
_STRAIGHT_DEG = (0.0, 90.0)
_DIRECTIONS = {
    0: "straight forward (towards the nose), level",
    90: "straight down, plumb",
    180: "straight back, level",
    -90: "straight up, plumb",
}


@dataclass(frozen=True, slots=True)
class Step:
    """One instruction to the user."""

    name: str
    instruction: str
    joint: int | None
    """Index of the joint that moves; None if all may."""
    by_deg: float
    """Angle by which the joint moves."""
    exact: bool
    """Whether the step ends in a direction that can be held exactly; if not, only the direction of the motion is used."""
    pose_deg: Joints
    """All joints at the end; approximate if not exact."""

    @property
    def hand_rad(self) -> Joints:
        """Return the angles of all joints at the end of the step."""
        return tuple(map(math.radians, self.pose_deg))


def steps_of(arm: Arm) -> tuple[Step, ...]:
    """Return the steps for an arm, within its limits: straight, then each joint alone, from the last one to the shoulder.

    For the planar arm of two joints the steps name the directions of its links; for any other arm, only the vehicle file defines them.

    Raises:
        ConfigError: the joint limits of a planar arm allow no straight pose, or a joint has too small a range.
    """
    planar = len(arm.joints) == 2
    pose = _start_deg(arm, planar)
    where = f"hold the arm with its joints at {_angles(pose)} deg, as the vehicle file defines them"
    if planar:
        where = f"hold the whole arm {_direction(pose[0])}, both links in one line"
    name = "straight" if planar else "start"
    steps = [Step(name=name, instruction=where, joint=None, by_deg=0.0, exact=True, pose_deg=tuple(pose))]
    for index in reversed(range(len(arm.joints))):
        from_deg = pose[0]
        by_deg, exact = _turn(arm.joints[index], pose[index], index)
        pose[index] += by_deg
        if planar:
            name, text_of = (("shoulder", _shoulder_text), ("elbow", _elbow_text))[index]
            text = text_of(from_deg, by_deg, exact)
        else:
            name, way = f"joint {index + 1}", "positive" if by_deg > 0.0 else "negative"
            how = f"by {by_deg:+.0f} deg" if exact else f"in its {way} direction by about {abs(by_deg):.0f} deg"
            text = f"turn {name} alone {how}, as the vehicle file defines its direction"
        steps.append(Step(name=name, instruction=text, joint=index, by_deg=by_deg, exact=exact, pose_deg=tuple(pose)))
    return tuple(steps)


def _start_deg(arm: Arm, planar: bool) -> list[float]:
    """Return the first pose: straight, or for an arm that is not planar and cannot be, as near to zero as it goes."""
    others = [0.0] * (len(arm.joints) - 1)
    for first in _STRAIGHT_DEG:
        if all(map(_within, arm.joints, (first, *others))):
            return [first, *others]
    if planar:
        raise ConfigError(
            "arm.joints[].angle_deg: the limits allow neither straight forward (0, 0) nor straight down (90, 0), and one of "
            "the two is needed to find the zeros; widen the limits to the arm's real range"
        )
    return [max(low, min(high, 0.0)) for low, high in (joint.angle_deg for joint in arm.joints)]


def _angles(angles_deg: Sequence[float]) -> str:
    return f"({', '.join(f'{angle:.0f}' for angle in angles_deg)})"


def _within(joint: Joint, angle_deg: float) -> bool:
    low, high = joint.angle_deg
    return low <= angle_deg <= high


def _turn(joint: Joint, from_deg: float, index: int) -> tuple[float, bool]:
    for by_deg in (90.0, -90.0):
        if _within(joint, from_deg + by_deg):
            return by_deg, True
    low, high = joint.angle_deg
    by_deg = min(SWING_DEG, high - from_deg) if high - from_deg >= from_deg - low else -min(SWING_DEG, from_deg - low)
    if abs(by_deg) < SWING_MIN_DEG:
        raise ConfigError(
            f"arm.joints[{index}].angle_deg: from {from_deg:g} deg, the limits allow a turn of only {abs(by_deg):.0f} deg; at "
             f"least {SWING_MIN_DEG:g} deg is needed to determine which way the servo counts"
        )  # fmt: skip
    return by_deg, False


def _direction(angle_deg: float) -> str:
    return _DIRECTIONS[round((angle_deg + 90.0) % 360.0 - 90.0)]


def _elbow_text(alpha1_deg: float, by_deg: float, exact: bool) -> str:
    # The lower link points along alpha_1 - alpha_2: a positive turn of joint 2 turns the link back.
    still = "leave the upper link as it is"
    if exact:
        return f"{still} and bend the elbow until the lower link points {_direction(alpha1_deg - by_deg)}"
    return (
        f"{still} and bend the elbow: swing the lower link {_way(alpha1_deg, -by_deg)} by about {abs(by_deg):.0f} deg"
    )


def _shoulder_text(alpha1_deg: float, by_deg: float, exact: bool) -> str:
    still = "leave the elbow as it is and turn the shoulder"
    if exact:
        return f"{still} until the upper link points {_direction(alpha1_deg + by_deg)}"
    return f"{still}: swing the upper link {_way(alpha1_deg, by_deg)} by about {abs(by_deg):.0f} deg"


def _way(from_deg: float, by_deg: float) -> str:
    """Return the direction in which a link that points forward or down moves when its angle (positive down from forward) changes."""
    middle_deg = from_deg + math.copysign(SWING_DEG, by_deg)
    forward, down = math.cos(math.radians(middle_deg)), math.sin(math.radians(middle_deg))
    if from_deg == 0.0:
        return "down" if down > 0.0 else "up"
    return "forward (towards the nose)" if forward > 0.0 else "back (towards the tail)"
