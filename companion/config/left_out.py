"""Finds the figures of the machine that a vehicle file leaves out, so that those of the Tarot 650 hold."""

from __future__ import annotations

from companion.config.arm import UNFOLDED
from companion.config.vehicle import Vehicle
from companion.model.listing import listed


def figures_left_out(vehicle: Vehicle) -> list[str]:
    """Return each figure that the file does not give, with the value that is used: `airframe.radius_m = 0.49`.

    The vehicle must come from the loader: a vehicle that is rebuilt from a dump has every key.
    """
    airframe, arm = vehicle.airframe, vehicle.arm
    given, found = airframe.model_fields_set, []
    keys = ["inertia_kg_m2", "yaw_torque_per_thrust_m", "radius_m"]
    if airframe.rotors is None:
        keys += ["rotor_arm_m", "rotor_height_m"]
    found += [f"airframe.{key} = {_text(getattr(airframe, key))}" for key in keys if key not in given]
    if airframe.rotor_radius_m is None:
        found.append(f"airframe.rotor_radius_m = {airframe.disk_radius_m:.3g} (from radius_m)")
    if arm.joints:
        if "joint_armature_kg_m2" not in arm.model_fields_set:
            found.append(f"arm.joint_armature_kg_m2 = {arm.joint_armature_kg_m2:g}")
        if "fold_arm_deg" not in vehicle.safety.model_fields_set:
            found.append(f"safety.fold_arm_deg = {_text(vehicle.fold_arm_deg)}")
        if UNFOLDED in vehicle.poses_deg and UNFOLDED not in arm.poses:
            found.append(f"arm.poses.{UNFOLDED} = {_text(vehicle.poses_deg[UNFOLDED])}")
    return found


def _text(value: float | tuple[float, ...]) -> str:
    return f"[{listed(value, 'g')}]" if isinstance(value, tuple) else f"{value:g}"
