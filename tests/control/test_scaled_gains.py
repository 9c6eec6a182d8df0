"""Gains that follow the vehicle: the same motion on a machine of other inertia, and the shipped machine unchanged."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from companion.config.arm_chain import chain_of
from companion.config.controller import LAWS, PRESETS, AdaptiveConfig, LawConfig
from companion.config.gains import fitted
from companion.config.loader import load_flight, load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_hold import DAMPING_NMS_RAD, STIFFNESS_NM_RAD, ArmHold
from companion.control.arm_model import dynamics_of
from companion.control.scaled_gains import for_vehicle, joint_inertia_kg_m2, scale_text
from companion.control.trial import build_law
from companion.model.types import IDENTITY_QUAT
from tests.control.test_any_arm import DT_S, ticks
from tests.machines import overrides_with_joints, vehicle_with_joints
from tests.support import CATCH

EVERY = [(law, preset) for law in ("adaptive", "csc", "psc") for preset in PRESETS[law]]


def gains(law: str, preset: str, *overrides: str, vehicle: str = "tarot650_2r") -> LawConfig:
    controller = load_flight(CATCH, vehicle, law, preset, overrides).controller
    assert isinstance(controller, LawConfig)
    return controller


@pytest.mark.parametrize(("law", "preset"), EVERY)
def test_the_shipped_machine_flies_the_gains_of_the_file_exactly(law: str, preset: str) -> None:
    given = gains(law, preset, "controller.found_for=null")
    flown = gains(law, preset)
    assert flown.scale == (1.0,) * 8
    assert scale_text(flown) == scale_text(given) == ""
    for key in {*flown.scaled_by_row, *flown.scaled_by_joint, *flown.gain_lists}:
        values = getattr(flown, key)
        assert values == fitted(getattr(given, key), len(values)), key
    for key in flown.scaled_by_mass:
        assert getattr(flown, key) == getattr(given, key)


def heavy(factor: float) -> Vehicle:
    """The vehicle with four joints without its tool; every inertia, friction and limit of force is multiplied by a factor."""
    given: Any = load_vehicle("tarot650_4r").model_dump()
    airframe, arm = given["airframe"], given["arm"]
    airframe |= {key: factor * airframe[key] for key in ("mass_kg", "thrust_max_n")} | {"battery_cells": 4}
    airframe["inertia_kg_m2"] = tuple(factor * value for value in airframe["inertia_kg_m2"])
    arm |= {"joint_armature_kg_m2": 0.008 * factor, "joint_friction_nm": 0.04 * factor, "urdf": None}
    arm["joints"] = [
        joint | {"servo": "XM540-W270", "torque_max_nm": factor, "velocity_max_deg_s": 180.0} for joint in arm["joints"]
    ]
    for link in arm["links"]:
        link["mass_kg"] *= factor
        link["inertia_kg_m2"] = tuple(factor * value for value in link["inertia_kg_m2"])
    given["devices"]["force"] = None
    return Vehicle.model_validate(given | {"tool": None})


@pytest.mark.parametrize(("law", "preset"), EVERY)
def test_ten_times_the_inertia_gets_ten_times_the_force_in_the_same_motion(law: str, preset: str) -> None:
    given = gains(law, preset, "controller.force_lowpass_hz=1e6")
    light, strong = (build_law(for_vehicle(vehicle, given), vehicle) for vehicle in (heavy(1.0), heavy(10.0)))
    for state, reference in ticks(4):
        force = state.force_ext_world_n
        assert force is not None
        one = light.step(DT_S, state, reference, 1.0)
        harder = replace(state, force_ext_world_n=(10.0 * force[0], 10.0 * force[1], 10.0 * force[2]))
        ten = strong.step(DT_S, harder, reference, 1.0)
        np.testing.assert_allclose(ten.attitude_wxyz, one.attitude_wxyz, atol=1e-9)
        assert ten.collective_n == pytest.approx(10.0 * one.collective_n)
        np.testing.assert_allclose(ten.arm_torque_nm, 10.0 * np.array(one.arm_torque_nm), rtol=1e-8)
        np.testing.assert_allclose(ten.log.gamma, one.log.gamma, rtol=1e-8, atol=1e-12)
        assert ten.log.rho == pytest.approx(one.log.rho)


@pytest.mark.parametrize(("law", "preset"), EVERY)
@pytest.mark.parametrize("joints", [0, 1, 4])
def test_scaled_gains_satisfy_the_laws_conditions_and_are_not_scaled_again(law: str, preset: str, joints: int) -> None:
    config = load_flight("hover", None, law, preset, [*overrides_with_joints(joints), "vehicle.airframe.mass_kg=4.5"])
    flown = config.controller
    assert isinstance(flown, LawConfig)
    assert flown.scale is not None
    assert flown.scale[:3] == (1.5,) * 3
    assert len(flown.scale) == 6 + max(1, joints)
    assert LAWS[law].model_validate_json(flown.model_dump_json()) == flown
    again = for_vehicle(config.vehicle, flown)
    assert again == flown
    assert "times 1.50 on x, y and z" in scale_text(flown)


@pytest.mark.parametrize(("joints", "share"), [(1, 1.0), (2, 1.0), (3, 2.0 / 3.0), (4, 0.5)])
def test_the_links_of_a_longer_arm_share_the_rate_of_their_moments(joints: int, share: float) -> None:
    """All of them act on the first joint: with the rates of two links, four made the joints swing if torques came 10 ms late."""
    found = gains("adaptive", "recommended")
    own = gains("adaptive", "recommended", *overrides_with_joints(joints))
    assert isinstance(found, AdaptiveConfig) and isinstance(own, AdaptiveConfig)
    assert own.scale is not None
    wanted = [
        share * ratio * rate for ratio, rate in zip(own.scale[6:], fitted(found.moment_rate, joints), strict=True)
    ]
    assert own.moment_rate == pytest.approx(wanted)


def test_gains_without_a_machine_are_used_as_written() -> None:
    given = gains("adaptive", "recommended", "controller.found_for=null", vehicle="tarot650_4r")
    assert given.scale is None
    assert for_vehicle(vehicle_with_joints(3), given) is given


def test_a_joint_has_its_smallest_inertia_within_the_joint_limits() -> None:
    vehicle = load_vehicle("tarot650_4r")
    dynamics, found = dynamics_of(vehicle), joint_inertia_kg_m2(vehicle)
    spans = [np.radians(np.linspace(*joint.angle_deg, 15)) for joint in vehicle.arm.joints[1:]]
    poses = [(0.0, *map(float, angles)) for angles in itertools.product(*spans)]
    smallest = np.min([np.diag(dynamics.arm_terms(pose, (0.0,) * 4).mass) for pose in poses], axis=0)
    np.testing.assert_allclose(found, smallest, rtol=0.05)
    assert found[0] < 1.1 * vehicle.arm.joint_armature_kg_m2, "the yaw joint under a hanging arm turns its own rotor"


def test_each_servo_may_have_its_own_armature() -> None:
    vehicle = load_vehicle("tarot650_4r", ["vehicle.arm.joints[2].armature_kg_m2=0.02"])
    assert vehicle.arm.armatures_kg_m2 == (0.008, 0.008, 0.02, 0.008)
    rods = load_vehicle("tarot650_2r", ["vehicle.arm.joints[1].armature_kg_m2=0"])
    assert [link.armature_kg_m2 for link in chain_of(rods).links] == [0.008, 0.0]
    more = np.subtract(joint_inertia_kg_m2(vehicle), joint_inertia_kg_m2(load_vehicle("tarot650_4r")))
    np.testing.assert_allclose(more, (0.0, 0.0, 0.012, 0.0), atol=1e-5)


def test_a_held_joint_of_little_inertia_is_damped_as_the_shipped_ones() -> None:
    assert ArmHold(load_vehicle("tarot650_2r")).ratios == (1.0, 1.0)
    small = vehicle_with_joints(3)
    inertia, still = np.array(joint_inertia_kg_m2(small)), (0.0, 0.0, 0.0)
    hold, up = ArmHold(small), tuple(map(math.radians, small.fold_arm_deg))

    def torque(angle_rad: float, rate_rad_s: float) -> np.ndarray[Any, Any]:
        moved, turning = tuple(angle + angle_rad for angle in up), (rate_rad_s,) * 3
        return np.subtract(
            hold.torque_nm(up, still, moved, turning, IDENTITY_QUAT),
            hold.torque_nm(up, still, up, still, IDENTITY_QUAT),
        )

    ratios = inertia / (0.01666, 0.01778, 0.01778)
    np.testing.assert_allclose(torque(0.1, 0.0), 0.1 * STIFFNESS_NM_RAD * ratios)
    np.testing.assert_allclose(torque(0.0, 0.1), 0.1 * DAMPING_NMS_RAD * ratios)
