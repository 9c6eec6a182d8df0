"""The slow sweeps by which friction and torque constant are told: which way the joints go, and which samples count. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from companion.commissioning.arm.motion import Motion, Moved, walls_deg
from companion.config.document import ConfigError
from companion.config.vehicle import Arm
from companion.model.types import ArmState, Vec2

HANGING_DEG: Final = (90.0, 0.0)
SPEEDS_DEG_S: Final = (9.0, 18.0)
REACH_DEG: Final = ((-30.0, 30.0), (-5.0, 70.0))
"""Each joint's sweep about hanging, within its walls."""
REACH_MIN_DEG: Final = 20.0
SETTLED_S: Final = 0.4
"""At constant speed for so long before a sample counts."""


@dataclass(frozen=True, slots=True)
class Leg:
    """One straight motion."""

    joint: int
    goal_deg: float
    speed_deg_s: float
    counts: bool
    """Its samples are for the fit; else it only leads somewhere."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One joint at constant speed."""

    leg: int
    joint: int
    direction: int
    t_s: float
    angle_rad: Vec2
    velocity_rad_s: float
    current_a: float
    """In the direction of the joint angle."""


def legs_of(arm: Arm) -> tuple[Leg, ...]:
    """To hanging, both sweeps there and back at each speed, and to hanging again: there it may go limp.

    Raises:
        ConfigError: the walls leave a joint too little room.
    """
    lows_highs = [walls_deg(arm, joint) for joint in (0, 1)]
    home = [max(low, min(high, deg)) for (low, high), deg in zip(lows_highs, HANGING_DEG, strict=True)]
    legs = [Leg(0, home[0], SPEEDS_DEG_S[-1], False), Leg(1, home[1], SPEEDS_DEG_S[-1], False)]
    for joint in (0, 1):
        (low, high), (down, up) = lows_highs[joint], REACH_DEG[joint]
        begin, end = max(low, home[joint] + down), min(high, home[joint] + up)
        if end - begin < REACH_MIN_DEG:
            room = f"about hanging and between its walls joint {joint + 1} has {max(0.0, end - begin):.0f} deg"
            why = f"at least {REACH_MIN_DEG:g} are needed to tell gravity from friction"
            raise ConfigError([f"arm.joints[{joint}].angle_deg: {room}, {why}"])
        legs.append(Leg(joint, begin, SPEEDS_DEG_S[-1], False))
        for speed in SPEEDS_DEG_S:
            legs += [Leg(joint, end, speed, True), Leg(joint, begin, speed, True)]
        legs.append(Leg(joint, home[joint], SPEEDS_DEG_S[-1], False))
    return tuple(legs)


def duration_s(legs: tuple[Leg, ...], start_deg: Vec2) -> float:
    """About how long they take."""
    at = list(start_deg)
    total = 0.0
    for leg in legs:
        total += abs(leg.goal_deg - at[leg.joint]) / leg.speed_deg_s + 0.5
        at[leg.joint] = leg.goal_deg
    return total


class Sweeper:
    """Leads a `Motion` along its legs and keeps what counts.

    Args:
        legs: of `legs_of`.
        torque_per_amp_nm_a: by which the arm edge has turned currents into the torques of its states.
    """

    def __init__(self, legs: tuple[Leg, ...], torque_per_amp_nm_a: float) -> None:
        self.legs = legs
        self._nm_a = torque_per_amp_nm_a
        self.samples: list[Sample] = []
        self.leg = -1
        """The one under way."""
        self._steady_since_s: float | None = None

    @property
    def done(self) -> bool:
        """All legs are behind."""
        return self.leg >= len(self.legs)

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> None:
        """After each control step: note the sample, begin the next leg when the last one has ended.

        Args:
            motion: what is led.
            moved: the last step's; None: none yet.
            state: by which it was computed.
        """
        if self.done:
            return
        if moved is not None and self.leg >= 0:
            self._note(moved, state)
        if self.leg < 0 or (moved is not None and moved.reached):
            self.leg += 1
            self._steady_since_s = None
            if not self.done:
                leg = self.legs[self.leg]
                motion.go(leg.joint, math.radians(leg.goal_deg), math.radians(leg.speed_deg_s))

    def _note(self, moved: Moved, state: ArmState) -> None:
        leg = self.legs[self.leg]
        rate = moved.reference_rate_rad_s[leg.joint]
        if not leg.counts or abs(abs(rate) - math.radians(leg.speed_deg_s)) > 1e-9:
            self._steady_since_s = None
            return
        if self._steady_since_s is None:
            self._steady_since_s = state.stamp_s
        if state.stamp_s - self._steady_since_s < SETTLED_S:
            return
        if self.samples and self.samples[-1].t_s == state.stamp_s:
            return
        self.samples.append(
            Sample(
                self.leg,
                leg.joint,
                1 if rate > 0.0 else -1,
                state.stamp_s,
                state.angle_rad,
                state.velocity_rad_s[leg.joint],
                state.torque_nm[leg.joint] / self._nm_a,
            )
        )
