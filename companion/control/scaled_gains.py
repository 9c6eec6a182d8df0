"""Gains that follow the vehicle: those of a preset were found for one machine and are multiplied by ratios of inertia on another.

With r, the inertia of a row on this vehicle divided by that on that machine, the law of the row becomes tau = r tau_found(e_tau / r).
Bandwidths, damping ratios, `gain_new` and `gain_cond` are those of that machine, and so is the proof, with E / r as the disturbance.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, TypeVar

from companion.config.arm_chain import chain_of
from companion.config.controller import ControllerConfig, LawConfig, Machine, law_class
from companion.config.gains import fitted
from companion.config.vehicle import Vehicle
from companion.config.yaml_text import flow_text
from companion.control.arm_model.chain_dynamics import ChainDynamics
from companion.model.arm_chain import ArmChain
from companion.model.types import Joints

C = TypeVar("C", bound=LawConfig)


_POSES = 256
_PRIMES = (2, 3, 5, 7, 11, 13, 17)
"""Their roots spread the poses, one for each joint."""


def joint_inertia_kg_m2(vehicle: Vehicle) -> Joints:
    """Return the inertia of each joint as in `Machine`, to four digits, so that a preset can state it exactly."""
    return _smallest_inertia_kg_m2(chain_of(vehicle), tuple([joint.angle_deg for joint in vehicle.arm.joints]))


@functools.lru_cache(maxsize=8)
def _smallest_inertia_kg_m2(chain: ArmChain, limits_deg: tuple[tuple[float, float], ...]) -> Joints:
    """Return the smallest inertia of each joint in 256 poses, the same in every flight, which are denser towards the joint limits.

    A joint's loop is the fastest where its inertia is the smallest: a yaw joint above a hanging arm turns little more than its own
    rotor.
    """
    dynamics, still = ChainDynamics(chain, 1.0, (1.0, 1.0, 1.0), 1.0), (0.0,) * len(limits_deg)
    smallest = [math.inf for _ in limits_deg]
    for pose in range(_POSES):
        shares = [0.5 - 0.5 * math.cos(math.pi * (pose * math.sqrt(prime) % 1.0)) for prime in _PRIMES]
        spans = zip(limits_deg, shares, strict=False)
        angles = tuple([math.radians(low + share * (high - low)) for (low, high), share in spans])
        mass = dynamics.arm_terms(angles, still).mass
        smallest = [min(before, mass[joint][joint]) for joint, before in enumerate(smallest)]
    return tuple([float(f"{inertia:.4g}") for inertia in smallest])


def joint_ratios(vehicle: Vehicle, found_for_kg_m2: Joints) -> Joints:
    """Return the inertia of each joint divided by that of the machine for which gains were found; its last value is repeated."""
    own = joint_inertia_kg_m2(vehicle)
    return tuple([inertia / other for inertia, other in zip(own, fitted(found_for_kg_m2, len(own)), strict=True)])


def for_vehicle(vehicle: Vehicle, config: C) -> C:
    """Return the gains for the vehicle, with lists of its length; unchanged if `found_for` is absent."""
    found = config.found_for
    if found is None:
        return config
    mass = vehicle.airframe.mass_kg / found.mass_kg
    scale = (mass, mass, mass, 1.0, 1.0, 1.0, *(joint_ratios(vehicle, found.joint_inertia_kg_m2) or (1.0,)))
    already = fitted(config.scale or (1.0,), len(scale))
    rows = [ratio / before for ratio, before in zip(scale, already, strict=True)]
    changes: dict[str, Any] = {key: fitted(getattr(config, key), len(rows)) for key in config.gain_lists}
    for keys, ratios in ((config.scaled_by_row, rows), (config.scaled_by_joint, rows[6:])):
        for key in keys:
            gains = fitted(getattr(config, key), len(ratios))
            changes[key] = tuple([gain * ratio for gain, ratio in zip(gains, ratios, strict=True)])
    if config.scale is None and len(rows) - 6 > len(found.joint_inertia_kg_m2):
        share = len(found.joint_inertia_kg_m2) / (len(rows) - 6)
        for key in config.shared_by_links:
            changes[key] = tuple([share * gain for gain in changes[key]])
    for key in config.scaled_by_mass:
        value = getattr(config, key)
        changes[key] = tuple([rows[0] * part for part in value]) if isinstance(value, tuple) else rows[0] * value
    return config.model_copy(update={**changes, "scale": scale})


def written_for(settings: ControllerConfig, vehicle: Vehicle) -> ControllerConfig:
    """Return the gains that fly on the vehicle as gains that were found for it, so that on another one they follow its inertia."""
    if not isinstance(settings, LawConfig) or not hasattr(law_class(settings.law), "for_vehicle"):
        return settings
    joints = joint_inertia_kg_m2(vehicle) or (settings.found_for.joint_inertia_kg_m2 if settings.found_for else (1.0,))
    machine = Machine(mass_kg=vehicle.airframe.mass_kg, joint_inertia_kg_m2=joints)
    return settings.model_copy(update={"found_for": machine, "scale": None})


def controller_yaml(settings: ControllerConfig, preset: str, remarks: Sequence[str]) -> str:
    """Return the text of a controller file.

    Args:
        settings: law and gains.
        preset: name of the gains.
        remarks: comments above them, one for each line.
    """
    data = settings.model_dump(mode="json", exclude_defaults=True)
    head = {"schema_version": 1, "law": data["law"], "preset": preset}
    body = {key: value for key, value in data.items() if key not in head}
    lines = [*(f"# {remark}" for remark in remarks), *(f"{key}: {flow_text(value)}" for key, value in head.items())]
    return "\n".join([*lines, "", *(f"{key}: {flow_text(value)}" for key, value in body.items())]) + "\n"


def scale_text(config: ControllerConfig) -> str:
    """Return by how much the gains that `for_vehicle` returned differ from those of the file; empty if they do not."""
    scale = config.scale if isinstance(config, LawConfig) else None
    if scale is None or set(scale) == {1.0}:
        return ""
    on_joints = ", ".join(f"{ratio:.2f}" for ratio in scale[6:])
    return f"gains of {config.law}/{config.preset}: times {scale[0]:.2f} on x, y and z and {on_joints} on the joints (docs/arm.md)"
