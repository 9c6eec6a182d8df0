"""The real vehicle, which differs from its vehicle file."""

from __future__ import annotations

import math
import operator

from companion.config.vehicle import Vehicle
from companion.model.types import Vec3
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.per_joint import of_joints


def as_built(vehicle: Vehicle, machine: Machine) -> Vehicle:
    """Return the vehicle with its true inertia, shoulder position, link lengths and centres of mass of the links."""
    if not machine.on:
        return vehicle
    airframe, arm = vehicle.airframe, vehicle.arm
    shoulder, lengths, coms = arm.shoulder_body_m, arm.link_lengths_m, arm.link_com_m
    (x, y, z), (dx, dy, dz) = shoulder, machine.shoulder_offset_m
    longer = of_joints(machine.link_length_error_m, len(lengths))
    farther = of_joints(machine.link_com_error_m, len(coms))
    return vehicle.model_copy(
        update={
            "airframe": airframe.model_copy(update={"inertia_kg_m2": _inertia_kg_m2(airframe.inertia_kg_m2, machine)}),
            "arm": arm.model_copy(
                update={
                    "shoulder_body_m": (x + dx, y + dy, z + dz),
                    "link_lengths_m": tuple(map(operator.add, lengths, longer)),
                    "link_com_m": tuple(map(operator.add, coms, farther)),
                }
            ),
        }
    )


def centre_of_mass_m(machine: Machine) -> Vec3:
    """Return the centre of mass of the base without arm and tool, body frame."""
    return machine.centre_of_mass_m if machine.on else (0.0, 0.0, 0.0)


def shoulder_ypr_rad(machine: Machine) -> Vec3:
    """Return the yaw, pitch and roll of the shoulder mount in the body frame, in the order of MuJoCo's ZYX angles."""
    if not machine.on:
        return (0.0, 0.0, 0.0)
    roll, pitch, yaw = machine.shoulder_rpy_deg
    return (math.radians(yaw), math.radians(pitch), math.radians(roll))


def _inertia_kg_m2(nominal: Vec3, machine: Machine) -> Vec3:
    """Return the true moments of inertia, each limited to the sum of the other two, which no moment of a rigid body exceeds."""
    x, y, z = (moment * (1.0 + error) for moment, error in zip(nominal, machine.inertia_error, strict=True))
    return (min(x, y + z), min(y, x + z), min(z, x + y))
