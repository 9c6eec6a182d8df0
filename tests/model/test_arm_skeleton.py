"""The lines that drawings and clearances use are where the arm's kinematics have its joints."""

from __future__ import annotations

import numpy as np
import pytest

from companion.analysis.arm_skeleton import pose
from companion.config.arm_chain import chain_of
from companion.config.loader import load_vehicle
from companion.control.arm_model.chain_manipulator import ChainManipulator
from companion.model.arm_skeleton import NO_ARM, ArmSkeleton, logged_skeleton, skeleton_of
from tests.control.test_arm_chain import random_chain
from tests.machines import vehicle_with_joints


@pytest.mark.parametrize("joints", [1, 4, 7])
def test_the_skeleton_has_the_joints_of_the_kinematics(joints: int) -> None:
    rng = np.random.default_rng(joints)
    chain = random_chain(rng, joints)
    manipulator, skeleton = ChainManipulator(chain), skeleton_of(chain)
    angles = rng.uniform(-3, 3, (5, joints))
    points, axes = pose(skeleton, angles)
    for angle, found, found_axes in zip(angles, points, axes, strict=True):
        at = tuple(angle.tolist())
        np.testing.assert_allclose(found, [*manipulator.joints_body_m(at), manipulator.net_body_m(at)], atol=1e-12)
        arms = found[-1] - found[:-1]
        np.testing.assert_allclose(np.cross(found_axes, arms).T, manipulator.jacobian_body_m(at), atol=1e-12)


def test_the_skeleton_of_a_logged_arm_is_that_of_its_chain() -> None:
    two = load_vehicle("tarot650_2r")
    link = {
        "origin_m": (0.1, 0.0, -0.05),
        "origin_rpy_deg": (10.0, 90.0, -20.0),
        "axis": (0.0, 1.0, 1.0),
        "mass_kg": 0.1,
    }
    body = {"com_m": (0.1, 0.0, 0.0), "inertia_kg_m2": (1e-4, 2e-4, 2e-4, 0.0, 0.0, 0.0)}
    rods = {"link_lengths_m": (), "link_masses_kg": (), "link_com_m": ()}
    joints = two.arm.model_dump()["joints"]
    bodies = type(two.arm).model_validate(
        {**rods, "links": (link | body,) * 2, "tip_m": (0.2, 0.0, 0.1), "joints": joints}
    )
    turned = two.arm.model_copy(
        update={"joints": (two.arm.joints[0].model_copy(update={"axis": (0.0, 0.0, 2.0)}), two.arm.joints[1])}
    )
    for arm in (two.arm, turned, bodies):
        expected = skeleton_of(chain_of(two.model_copy(update={"arm": arm})))
        found = logged_skeleton({"arm": arm.model_dump(mode="json"), "tool": {"net_radius_m": 0.09}})
        assert isinstance(found, ArmSkeleton)
        assert found.shoulder_body_m == pytest.approx(expected.shoulder_body_m)
        np.testing.assert_allclose(found.links_body_m, expected.links_body_m, atol=1e-15)
        np.testing.assert_allclose(found.joint_axes, expected.joint_axes, atol=1e-15)
    assert skeleton_of(chain_of(two)).is_in_xz_plane
    assert not skeleton_of(chain_of(two.model_copy(update={"arm": turned}))).is_in_xz_plane
    assert skeleton_of(chain_of(two)).reach_m == pytest.approx(two.arm.reach_m)


def test_a_logged_rod_lengthens_the_last_link() -> None:
    rod = load_vehicle("configs/vehicles/tarot650_2r_rod.yaml")
    found = logged_skeleton(rod.model_dump(mode="json"))
    assert found is not None
    np.testing.assert_allclose(found.links_body_m, skeleton_of(chain_of(rod)).links_body_m, atol=1e-15)
    assert found.reach_m == pytest.approx(rod.reach_m) == pytest.approx(0.85)


@pytest.mark.parametrize(
    "arm",
    [
        None,
        {},
        {"link_lengths_m": ["a"]},
        {"link_lengths_m": [0.1], "shoulder_body_m": [0.0, 0.0]},
        {"links": 3},
        {"links": [None]},
        {"links": [{"origin_m": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 0.0]}]},
        {"links": [{"origin_m": [0.0, 0.0, float("nan")], "axis": [0.0, 0.0, 1.0]}]},
    ],
)
def test_an_invalid_logged_arm_has_no_skeleton(arm: object) -> None:
    assert logged_skeleton({"arm": arm}) is None


def test_no_arm_is_an_empty_skeleton() -> None:
    assert skeleton_of(chain_of(vehicle_with_joints(0))) == NO_ARM
