"""PX4 is armed though this companion has not asked for it: does it fly, and who flies it? Pure.

So it is when the companion, its guardian and its launcher died in the air or the computer restarted, and also when people arm by radio
before the companion does. Nothing is ever lifted then.
"""

from __future__ import annotations

from companion.mission.sequencer import on_ground, people_fly
from companion.mission.touchdown import MOCAP_FRESH_S
from companion.types import Inputs

STANDS_WITHIN_M = 0.25
"""Of standing height, by motion capture: further up PX4's word that it stands is not taken."""


def found_armed(i: Inputs, clearance_m: float) -> tuple[bool, str]:
    """Whether the vehicle is to be treated as flying, and in words what was found and what is done about it.

    One that stands with rotors that turn is disarmed, but not against people: in a mode that only they choose it counts as flying.

    Args:
        i: with PX4 armed.
        clearance_m: height of the body's origin when the vehicle stands.
    """
    pose, vehicle = i.mocap, i.vehicle
    height_m = None
    if pose is not None and pose.tracking_valid and i.t_s - pose.stamp_s < MOCAP_FRESH_S:
        height_m = pose.position_world_m[2]
    stands = on_ground(i.status) and (height_m is None or height_m < clearance_m + STANDS_WITHIN_M)
    if height_m is None and vehicle is not None:
        height_m = vehicle.position_world_m[2]
    where = "at an unknown height" if height_m is None else f"at a height of {height_m:.2f} m"
    mode = i.status.mode.value.upper() if i.status is not None else "?"
    found = f"PX4 is armed and the companion has not armed it: {where}, in {mode}"
    if people_fly(i.status):
        return True, f"{found}, which people choose: motion capture is passed on, nothing else is sent"
    if stands:
        return False, f"{found}, on the ground: it is disarmed, nothing lifts; find out who armed it, then start again"
    return True, f"{found}: PX4 lands, the mission is not flown"
