"""Decides whether a vehicle that was armed without a request from this companion is flying, and who has control. Pure.

This happens after companion, guardian and launcher have died in flight or the computer has restarted, and when a pilot arms by radio
before the companion does. The vehicle never takes off in this case.
"""

from __future__ import annotations

from companion.model.flight_stage import flown_by_pilot, is_killed, on_ground
from companion.model.types import Inputs
from companion.safety.rotor_stop import LOW_WITHIN_M, OWN_MODES, fresh_pose


def found_armed(i: Inputs, clearance_m: float) -> tuple[bool, str]:
    """Return whether the vehicle is treated as flying, and a message with the observation and the action.

    A vehicle on the ground with turning rotors is disarmed. It counts as flying if a pilot selected its mode, if the mode is
    neither OFFBOARD nor LAND, or if motion capture does not measure its height.

    Args:
        i: inputs with PX4 armed.
        clearance_m: height of the body's origin when the vehicle is on the ground.
    """
    pose, vehicle = fresh_pose(i), i.vehicle
    height_m = pose.position_world_m[2] if pose is not None else None
    low = height_m is not None and height_m < clearance_m + LOW_WITHIN_M
    stands = low and on_ground(i.status) and i.status is not None and i.status.mode in OWN_MODES
    if height_m is None and vehicle is not None:
        height_m = vehicle.position_world_m[2]
    height = "unknown height" if height_m is None else f"height {height_m:.2f} m"
    mode = i.status.mode.value.upper() if i.status is not None else "?"
    found = f"({height}, mode {mode}), but not by the companion"
    if is_killed(i.status):
        return (
            True,
            f"PX4 is armed {found}; its rotors are stopped by the kill switch, so only motion capture is sent to PX4",
        )
    if flown_by_pilot(i.status):
        return True, f"PX4 is armed {found}; a pilot has chosen the mode, so only motion capture is sent to PX4"
    if stands:
        return (
            False,
            f"PX4 is armed on the ground {found}; the companion disarms it; find out who armed it, then restart",
        )
    return True, f"PX4 is armed {found}; PX4 lands; the mission is not flown"
