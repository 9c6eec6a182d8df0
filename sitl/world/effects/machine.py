"""The real vehicle, which differs from its vehicle file."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

from companion.config.arm import Arm, Link
from companion.config.arm_chain import chain_of, without_tool
from companion.config.vehicle import Vehicle
from companion.model.arm_chain import ArmChain
from companion.model.types import Joints, Vec3
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import World


def true_chain(vehicle: Vehicle, world: World) -> ArmChain:
    """Return the true arm, which ends at the force-torque sensor; the turn of the arm's mount (`shoulder_ypr_rad`) is not included.

    The inertia of a rod follows from its true mass and length. That of any other link changes in proportion to its mass.
    """
    arm, machine = vehicle.arm, world.machine
    count = len(arm.joints)
    masses = tuple(1.0 + error for error in of_joints(world.link_mass_error, count))
    longer_m = of_joints(machine.link_length_error_m if machine.on else (0.0,), count)
    farther_m = of_joints(machine.link_com_error_m if machine.on else (0.0,), count)
    shoulder_m = machine.shoulder_offset_m if machine.on else (0.0, 0.0, 0.0)
    built = _links_as_built if arm.links else _rods_as_built
    changed = arm.model_copy(update=built(arm, shoulder_m, masses, longer_m, farther_m))
    return chain_of(without_tool(vehicle).model_copy(update={"arm": changed}))


def _rods_as_built(arm: Arm, shoulder_m: Vec3, masses: Joints, longer_m: Joints, farther_m: Joints) -> dict[str, Any]:
    return {
        "shoulder_body_m": _sum(arm.shoulder_body_m, shoulder_m),
        "link_lengths_m": tuple(map(operator.add, arm.link_lengths_m, longer_m)),
        "link_com_m": tuple(map(operator.add, arm.link_com_m, farther_m)),
        "link_masses_kg": tuple(map(operator.mul, arm.link_masses_kg, masses)),
    }


def _links_as_built(arm: Arm, shoulder_m: Vec3, masses: Joints, longer_m: Joints, farther_m: Joints) -> dict[str, Any]:
    """Return the changed keys of an arm with `links`; length errors act along the line to the next joint or the tip."""
    starts, ends = [_sum(arm.links[0].origin_m, shoulder_m)], [*(link.origin_m for link in arm.links[1:]), arm.tip_m]
    links: list[Link] = []
    for link, end_m, scale, longer, farther in zip(arm.links, ends, masses, longer_m, farther_m, strict=True):
        along = _direction(end_m)
        update = {
            "origin_m": starts[-1],
            "mass_kg": link.mass_kg * scale,
            "com_m": _sum(link.com_m, along, farther),
            "inertia_kg_m2": tuple(element * scale for element in link.inertia_kg_m2),
        }
        links.append(link.model_copy(update=update))
        starts.append(_sum(end_m, along, longer))
    return {"links": tuple(links), "tip_m": starts[-1]}


def _direction(v: Vec3) -> Vec3:
    length = math.hypot(*v)
    return (v[0] / length, v[1] / length, v[2] / length) if length > 0.0 else (0.0, 0.0, 0.0)


def _sum(a: Sequence[float], b: Sequence[float], scale: float = 1.0) -> Vec3:
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def centre_of_mass_m(machine: Machine) -> Vec3:
    """Return the centre of mass of the base without arm and tool, body frame."""
    return machine.centre_of_mass_m if machine.on else (0.0, 0.0, 0.0)


def shoulder_ypr_rad(machine: Machine) -> Vec3:
    """Return the yaw, pitch and roll of the shoulder mount in the body frame, in the order of MuJoCo's ZYX angles."""
    if not machine.on:
        return (0.0, 0.0, 0.0)
    roll, pitch, yaw = machine.shoulder_rpy_deg
    return (math.radians(yaw), math.radians(pitch), math.radians(roll))


def inertia_kg_m2(nominal: Vec3, machine: Machine) -> Vec3:
    """Return the true moments of inertia of the base, each limited to the sum of the other two, as of every rigid body."""
    if not machine.on:
        return nominal
    x, y, z = (moment * (1.0 + error) for moment, error in zip(nominal, machine.inertia_error, strict=True))
    return (min(x, y + z), min(y, x + z), min(z, x + y))
