"""Touchdown detection: two of three independent sources must agree that the vehicle is on the ground. Pure; time is an argument.

* **Height**: PX4's estimate is near standing height and does not sink, although the reference is below it.
* **Thrust**: the command is much less than hover thrust, and motion capture sees no descent: the floor carries the vehicle.
* **PX4**: its land detector (EXTENDED_SYS_STATE) reports a landing.

In attitude control the land detector waits for almost zero thrust, which no control law commands by itself. When one of the other
sources is the only one, thrust is therefore reduced gradually (`relief`) as long as the vehicle does not sink.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

from companion.model.types import MocapPose, VehicleState

HEIGHT_MARGIN_M = 0.12
"""Margin over standing height below which the vehicle may be on the ground."""
STILL_M_S: Final = 0.08
REFERENCE_BELOW_M: Final = 0.05
HEIGHT_HOLD_S = 0.35
THRUST_SHARE: Final = 0.75
"""Fraction of hover thrust at which a vehicle in the air falls 0.2 m within 0.4 s."""
THRUST_HOLD_S: Final = 0.2
NEVER_ABOVE_M = 0.5
"""Margin over standing height. If motion capture is above it, thrust and PX4 are not evidence: the tether may carry the vehicle."""
ALONE_S: Final = 0.4
"""Time for which a single source may report touchdown before thrust is reduced."""
RELIEF_S: Final = 1.0
"""Time in which thrust is reduced from full to zero."""
RELIEF_SINK_MAX_M_S: Final = 0.15
"""A vehicle that sinks faster than this while thrust is reduced is still flying."""
SINK_WINDOW_S: Final = 0.15
MOCAP_FRESH_S: Final = 0.3


@dataclass(frozen=True, slots=True)
class HeightEvidence:
    """Evidence from PX4's estimate: the vehicle has been low and still for `HEIGHT_HOLD_S`."""

    low_m: float
    """Height below which the vehicle may be on the ground, from `low_below_m`."""
    since_s: float | None = None
    """Time on the flight clock since which the vehicle has been low and still; None if it is not."""

    def update(self, t_s: float, height_m: float, vertical_m_s: float, reference_height_m: float) -> HeightEvidence:
        """Return the evidence after one more tick."""
        pressed = reference_height_m < height_m - REFERENCE_BELOW_M
        if not (height_m < self.low_m and abs(vertical_m_s) < STILL_M_S and pressed):
            return replace(self, since_s=None)
        return replace(self, since_s=t_s) if self.since_s is None else self

    def stands(self, t_s: float) -> bool:
        """Return whether this evidence shows that the vehicle is on the ground."""
        return self.since_s is not None and t_s - self.since_s >= HEIGHT_HOLD_S


def low_below_m(clearance_m: float) -> float:
    """Return the height below which a vehicle may be on the ground; `clearance_m` is the height of the body's origin when it is."""
    return clearance_m + HEIGHT_MARGIN_M


@dataclass(frozen=True, slots=True)
class Sinking:
    """Measures the descent speed from motion capture alone, over `SINK_WINDOW_S`."""

    seen: tuple[tuple[float, float], ...] = ()
    """Stamp and height of the poses, s and m."""

    def update(self, t_s: float, pose: MocapPose | None) -> Sinking:
        """Return the updated height history; it is empty if the pose is stale."""
        if pose is None or not pose.tracking_valid or t_s - pose.stamp_s >= MOCAP_FRESH_S:
            return Sinking()
        seen = self.seen
        if not seen or pose.stamp_s > seen[-1][0]:
            seen = (*seen, (pose.stamp_s, pose.position_world_m[2]))
        first = 0
        while len(seen) - first > 2 and seen[first + 1][0] <= seen[-1][0] - SINK_WINDOW_S:
            first += 1
        return Sinking(seen[first:])

    @property
    def speed_m_s(self) -> float | None:
        """Return the descent speed, positive downward, or None if the poses do not span enough time."""
        if not self.seen:
            return None
        first_s, first_m = self.seen[0]
        last_s, last_m = self.seen[-1]
        return (first_m - last_m) / (last_s - first_s) if last_s - first_s >= 0.5 * SINK_WINDOW_S else None


@dataclass(frozen=True, slots=True)
class Touchdown:
    """Evidence of touchdown from three sources, of which two must agree, in a landing that the companion flies itself."""

    ceiling_m: float
    """Height from motion capture above which thrust and PX4 are not evidence."""
    height: HeightEvidence
    sinking: Sinking = field(default_factory=Sinking)
    thrust_since_s: float | None = None
    alone_since_s: float | None = None
    last_s: float | None = None
    relief: float = 1.0
    """Fraction of its thrust that the controller may command."""
    certain: bool = False

    @classmethod
    def begin(cls, clearance_m: float) -> Touchdown:
        """Return the evidence before a landing; `clearance_m` is the height of the body's origin when the vehicle is on the ground."""
        return cls(clearance_m + NEVER_ABOVE_M, HeightEvidence(low_below_m(clearance_m)))

    def update(
        self,
        t_s: float,
        vehicle: VehicleState,
        pose: MocapPose | None,
        reference_height_m: float,
        thrust_share: float,
        landed: bool,
    ) -> Touchdown:
        """Return the evidence after one tick of a landing.

        Args:
            t_s: flight clock.
            vehicle: PX4's state.
            pose: motion-capture pose, None if it is not trusted.
            reference_height_m: height of the body's origin in the reference.
            thrust_share: the last thrust command divided by hover thrust.
            landed: whether PX4's land detector reports a landing.
        """
        dt_s = 0.0 if self.last_s is None else t_s - self.last_s
        height = self.height.update(t_s, vehicle.position_world_m[2], vehicle.velocity_world_m_s[2], reference_height_m)
        sinking = self.sinking.update(t_s, pose)
        sink_m_s = sinking.speed_m_s
        thrust_since_s = self.thrust_since_s
        if sink_m_s is None or sink_m_s > STILL_M_S or thrust_share > THRUST_SHARE:
            thrust_since_s = None
        elif thrust_since_s is None:
            thrust_since_s = t_s
        carried = thrust_since_s is not None and t_s - thrust_since_s >= THRUST_HOLD_S
        low = height.stands(t_s)
        below = pose is not None and pose.position_world_m[2] < self.ceiling_m
        after = replace(self, height=height, sinking=sinking, thrust_since_s=thrust_since_s, last_s=t_s)
        if low + carried + landed >= 2 and (low or below):
            return replace(after, certain=True)
        return after._relieved(t_s, dt_s, sink_m_s, (low or carried) and below)

    def _relieved(self, t_s: float, dt_s: float, sink_m_s: float | None, seems_to_stand: bool) -> Touchdown:
        """Reduce thrust while only one source shows that the vehicle is on the ground; restore it at once when the vehicle sinks."""
        if not seems_to_stand or sink_m_s is None or sink_m_s > RELIEF_SINK_MAX_M_S:
            return replace(self, relief=1.0, alone_since_s=None)
        since_s = t_s if self.alone_since_s is None else self.alone_since_s
        relief = max(0.0, self.relief - dt_s / RELIEF_S) if t_s - since_s > ALONE_S else self.relief
        return replace(self, relief=relief, alone_since_s=since_s)
