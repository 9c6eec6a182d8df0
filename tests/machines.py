"""Vehicles with other arms than the shipped one, as overrides (`--set`) of the shipped vehicle file."""

from __future__ import annotations

from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle

ARMS: dict[int, tuple[tuple[float, ...], tuple[float, ...]]] = {
    1: ((165.0,), (100.0,)),
    2: ((165.0, 140.0), (100.0, 60.0)),
    3: ((165.0, 140.0, 0.0), (100.0, 60.0, -20.0)),
    4: ((165.0, 140.0, 0.0, 20.0), (100.0, 60.0, -20.0, 10.0)),
}
"""Folded and unfolded pose by number of joints, deg. Each arm is 0.4 m long, or 0.28 m with one joint; every joint after the first
turns the other way."""
_MASS_KG = (0.15, 0.08)


def overrides_with_joints(count: int) -> list[str]:
    """Return the overrides that give the shipped vehicle a planar arm of 0 to 4 joints; without an arm it has no tool and sensor."""
    if count == 0:
        absent = ("arm", "tool", "devices.arm", "devices.force")
        return [f"vehicle.{key}=null" for key in absent]
    folded, unfolded = (list(pose) for pose in ARMS[count])
    length_m = 0.4 / count if count > 1 else 0.28
    masses_kg = [_MASS_KG[0] * 2.0 / count if index + 1 < count else _MASS_KG[1] for index in range(count)]
    joints = [
        f"{{servo_id: {index + 1}, sign: {1 if index % 2 == 0 else -1}, zero_count: {1024 if index % 2 == 0 else 3072}, "
        f"angle_deg: [{-30.0 if index else 60.0}, {150.0 if index else 175.0}], torque_max_nm: 2.5}}"
        for index in range(count)
    ]
    return [
        f"vehicle.arm.link_lengths_m={[length_m] * count}",
        f"vehicle.arm.link_masses_kg={masses_kg}",
        f"vehicle.arm.link_com_m={[0.6 * length_m] * count}",
        f"vehicle.arm.joints=[{', '.join(joints)}]",
        f"vehicle.arm.poses={{unfolded: {unfolded}}}",
        f"vehicle.safety.fold_arm_deg={folded}",
    ]


def vehicle_with_joints(count: int) -> Vehicle:
    """Return that vehicle."""
    return load_vehicle("tarot650_2r", overrides_with_joints(count))
