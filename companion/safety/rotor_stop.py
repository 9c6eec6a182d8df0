"""Conditions for stopping the rotors, for every disarm request of the flight process and the guardian. Pure.

There are three cases:

* **The vehicle is on the ground.** PX4 is in OFFBOARD or LAND, so no pilot is flying; every fresh height is near standing height;
  and the vehicle has not moved. All of this must hold without a break: for `DISARM_STILL_S` before DISARM, which PX4 itself refuses
  in the air, and for `FORCE_DISARM_S`, measured by motion capture, before FORCE_DISARM, which PX4 does not refuse.
* **The vehicle is flipped.** For `FLIPPED_HOLD_S`, PX4's attitude is beyond `FLIPPED_TILT_RAD`, confirmed by motion capture, or by
  the accelerometer if motion capture does not see the body. PX4's LAND would drive it into the floor, so FORCE_DISARM follows at
  once and at any height, unless a pilot is flying.
* **The vehicle is tipped over.** For `TIPPED_HOLD_S`, in OFFBOARD or LAND, PX4 and motion capture both show a tilt above
  `safety.tilt_abort_deg`, and motion capture shows less than `LOW_WITHIN_M` above standing height. The vehicle lies on its rotors,
  and PX4's LAND continues to drive them. Without a fresh pose this is not evaluated.

A normal flight is never mistaken for a vehicle that is tipped over. The controller's setpoints stay within `airframe.tilt_max_deg`,
PX4's own landing within `MPC_TILTMAX_AIR` (25 deg) and `MPC_TILTMAX_LND` (12 deg). Beyond 40 deg a free vehicle accelerates
sideways by more than 8 m/s^2, and PX4, which is commanded to land after 0.1 s (`tilt`), levels it within 0.5 s unless it hits the
floor first. Only a tether that pulls the vehicle over can hold it at this tilt and this low; when its rotors stop it falls by
`LOW_WITHIN_M` at most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

from companion.model.best_pose import pose_used_s
from companion.model.constants import GRAVITY_M_S2
from companion.model.flight_stage import HEARTBEAT_FRESH_S, flown_by_pilot
from companion.model.frames import tilt_rad
from companion.model.types import FlightMode, Inputs, MocapPose, Vec3
from companion.safety.touchdown import MOCAP_FRESH_S, STILL_M_S, Sinking

LOW_WITHIN_M = 0.25
"""Margin over standing height: above it the vehicle does not count as being on the ground."""
STILL_WITHIN_M: Final = 0.05
"""A vehicle that has moved further than this since it came to rest is not at rest."""
DISARM_STILL_S: Final = 0.35
FORCE_DISARM_S: Final = 4.0
"""Time at rest after which the vehicle is disarmed although PX4's land detector reports no landing."""
ESTIMATE_TRUSTED_S = 4.2
"""Time after the last motion-capture pose for which PX4's dead-reckoned height counts; later it is too wrong."""
STATE_FRESH_S = 0.3
FLIPPED_TILT_RAD = math.radians(70.0)
FLIPPED_HOLD_S: Final = 0.3
FLIPPED_POSE_S: Final = 0.03
"""Age above which a pose neither confirms nor contradicts a flip: it stands for newer ones that were rejected (`MocapTracker`)."""
TIPPED_HOLD_S: Final = 0.5
_UPRIGHT_MIN_M_S2 = GRAVITY_M_S2 * math.cos(FLIPPED_TILT_RAD)
"""Specific force along body z; a vehicle that rests or hovers with less tilt measures more."""
Places = dict[str, Vec3]
"""Position in the world frame by source, "mocap" or "PX4"."""
OWN_MODES = frozenset({FlightMode.OFFBOARD, FlightMode.LAND})
"""PX4's modes in which the companion or its guardian flies; the rotors are stopped in no other."""


def fresh_pose(i: Inputs) -> MocapPose | None:
    """Return the motion-capture pose, or None if it is older than `MOCAP_FRESH_S` or the body is not in view."""
    pose = i.mocap
    return pose if pose is not None and pose.tracking_valid and i.t_s - pose.stamp_s < MOCAP_FRESH_S else None


def hears_px4(i: Inputs) -> bool:
    """Return whether a heartbeat from PX4 has arrived within `HEARTBEAT_FRESH_S`."""
    return i.status is not None and i.t_s - i.status.heartbeat_stamp_s < HEARTBEAT_FRESH_S


def is_ours(i: Inputs) -> bool:
    """Return whether PX4 sends heartbeats, is armed, and is in a mode of `OWN_MODES`."""
    return hears_px4(i) and i.status is not None and i.status.armed and i.status.mode in OWN_MODES


def seems_flipped(i: Inputs) -> bool:
    """Return whether two sources report in this tick that the vehicle is tilted by more than `FLIPPED_TILT_RAD`.

    PX4's attitude must report it and motion capture confirm it; without a fresh pose the accelerometer does. It confirms the tilt of a
    vehicle that lies on its side or back or falls freely, but not of one whose rotors still push against gravity.
    """
    if not _tilted_by_px4(i, FLIPPED_TILT_RAD):
        return False
    pose = fresh_pose(i)
    if pose is not None and i.t_s - pose.stamp_s < FLIPPED_POSE_S:
        return tilt_rad(pose.attitude_wxyz) > FLIPPED_TILT_RAD
    vehicle = i.vehicle
    fresh = vehicle is not None and i.t_s - vehicle.imu_stamp_s < STATE_FRESH_S
    return fresh and vehicle is not None and vehicle.specific_force_body_m_s2[2] < _UPRIGHT_MIN_M_S2


def _tilted_by_px4(i: Inputs, limit_rad: float) -> bool:
    """Return whether PX4's attitude is fresh and tilted by more than `limit_rad`."""
    vehicle = i.vehicle
    if vehicle is None or i.t_s - vehicle.attitude_stamp_s >= STATE_FRESH_S:
        return False
    return tilt_rad(vehicle.attitude_wxyz) > limit_rad


@dataclass(frozen=True, slots=True)
class RotorStop:
    """Evidence, updated in every tick, on whether the rotors may be stopped."""

    low_m: float
    """Below this height the vehicle may be on the ground."""
    tilt_max_rad: float
    """`safety.tilt_abort_deg`; a vehicle that lies on the floor beyond it is tipped over."""
    pose_s: float = -math.inf
    """Time on the flight clock at which PX4 last used a pose; -inf if unknown."""
    sinking: Sinking = field(default_factory=Sinking)
    rest: tuple[float, Places] | None = None
    """Time since which the vehicle has been at rest, and its position from each source; None if it is not at rest."""
    flipped_since_s: float | None = None
    tipped_since_s: float | None = None
    may_disarm: bool = False
    may_force: bool = False
    """Whether FORCE_DISARM of a vehicle on the ground may be requested now."""
    flipped: bool = False
    tipped: bool = False

    @classmethod
    def begin(
        cls, clearance_m: float, tilt_max_rad: float, pose_s: float = -math.inf, *, flipped: bool = False
    ) -> RotorStop:
        """Return the evidence before the first tick.

        Args:
            clearance_m: height of the body's origin when the vehicle is on the ground.
            tilt_max_rad: `safety.tilt_abort_deg`, in rad.
            pose_s: time on the flight clock of the newest pose that PX4 received; -inf if unknown.
            flipped: the vehicle is known to have been flipped for long enough.
        """
        return cls(clearance_m + LOW_WITHIN_M, tilt_max_rad, pose_s, flipped_since_s=-math.inf if flipped else None)

    def update(self, i: Inputs) -> RotorStop:
        """Return the evidence after one more tick. Call it in every tick of the stage, because the conditions must hold
        without interruption.
        """
        pose, t_s = fresh_pose(i), i.t_s
        sinking = self.sinking.update(t_s, pose)
        used_s = pose_used_s(i)
        pose_s = self.pose_s if used_s is None else max(self.pose_s, used_s)
        rest = self._rest(i, _low_and_still(i, pose, sinking.speed_m_s, self.low_m, pose_s))
        rest_s = t_s - rest[0] if rest is not None else -math.inf
        flipped_since_s = _since(self.flipped_since_s, t_s, seems_flipped(i) and not flown_by_pilot(i.status))
        tipped_since_s = _since(self.tipped_since_s, t_s, self._lies_tilted(i, pose))
        return replace(
            self,
            pose_s=pose_s,
            sinking=sinking,
            rest=rest,
            flipped_since_s=flipped_since_s,
            tipped_since_s=tipped_since_s,
            may_disarm=rest_s >= DISARM_STILL_S,
            may_force=rest_s >= FORCE_DISARM_S and rest is not None and "mocap" in rest[1],
            flipped=flipped_since_s is not None and t_s - flipped_since_s >= FLIPPED_HOLD_S,
            tipped=tipped_since_s is not None and t_s - tipped_since_s >= TIPPED_HOLD_S,
        )

    @property
    def overturned(self) -> bool:
        """Return whether the vehicle is flipped or tipped over, so that FORCE_DISARM may be requested now."""
        return self.flipped or self.tipped

    def _rest(self, i: Inputs, places: Places) -> tuple[float, Places] | None:
        if not places or not is_ours(i):
            return None
        rest = self.rest
        if rest is None or rest[1].keys() != places.keys() or _moved_m(rest[1], places) > STILL_WITHIN_M:
            return (i.t_s, places)
        return rest

    def _lies_tilted(self, i: Inputs, pose: MocapPose | None) -> bool:
        """Return whether PX4 is in one of `OWN_MODES`, motion capture shows the vehicle low, and both show it tilted too far."""
        if pose is None or pose.position_world_m[2] >= self.low_m or not is_ours(i):
            return False
        return tilt_rad(pose.attitude_wxyz) > self.tilt_max_rad and _tilted_by_px4(i, self.tilt_max_rad)


def _since(before_s: float | None, t_s: float, holds: bool) -> float | None:
    """Return the time since which a condition has held, or None if it does not hold."""
    return (t_s if before_s is None else before_s) if holds else None


def _low_and_still(i: Inputs, pose: MocapPose | None, sink_m_s: float | None, low_m: float, pose_s: float) -> Places:
    """Return the position from each trusted source; empty unless all are near the floor and the best source measures no motion."""
    places: Places = {}
    vehicle = i.vehicle
    if vehicle is not None and i.t_s - vehicle.position_stamp_s < STATE_FRESH_S:
        places["PX4"] = vehicle.position_world_m
        speed_m_s: float | None = vehicle.velocity_world_m_s[2]
    else:
        speed_m_s = None
    if pose is not None:
        places["mocap"] = pose.position_world_m
        speed_m_s = sink_m_s
    elif i.t_s - pose_s > ESTIMATE_TRUSTED_S:
        return {}
    still = speed_m_s is not None and abs(speed_m_s) < STILL_M_S
    return places if still and all(place[2] < low_m for place in places.values()) else {}


def _moved_m(before: Places, now: Places) -> float:
    """Return the largest displacement of any source; both arguments have the same sources."""
    return max(math.dist(before[source], now[source]) for source in now)
