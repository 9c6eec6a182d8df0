"""The arm keeps clear of the rotors and the floor in every planned pose, and on the way on which a landing folds it from there."""

from __future__ import annotations

import math

import pytest

from companion.config.document import ConfigError
from companion.config.loader import load_flight, load_vehicle
from companion.config.vehicle import Vehicle
from companion.control.arm_hold import towards
from companion.mission.arm_clearance import ArmClearance
from companion.mission.check import check_mission
from tests.machines import overrides_with_joints

HANGING = (0.0, 90.0, 0.0, 0.0)


def radians(pose_deg: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(map(math.radians, pose_deg))


def problems(vehicle: str, phases: str, *overrides: str) -> list[str]:
    phases = f"[{{type: takeoff, height_m: 1.2, duration_s: 3.0}}, {phases}, {{type: land, speed_m_s: 0.35}}]"
    config = load_flight("hover", vehicle_path=vehicle, overrides=[f"mission.phases={phases}", *overrides])
    return check_mission(config.mission, config.vehicle)


def moves(*named: tuple[str, tuple[float, ...]]) -> str:
    return ", ".join(f"{{type: arm, name: {name}, arm_deg: {list(pose)}}}" for name, pose in named)


def test_a_mission_is_refused_if_the_arm_would_fold_into_a_rotor_from_one_of_its_poses() -> None:
    """The pose is clear of the rotors, and so is the way to it: first the other joints, then the yaw. A fold turns all together."""
    beside, tucked = (0.0, 70.0, 145.0, 40.0), (75.0, 70.0, 145.0, 40.0)
    folded = (0.0, 170.0, 145.0, 60.0)
    phases = moves(("beside", beside), ("tuck", tucked), ("away", beside), ("home", folded))
    (problem,) = problems("tarot650_4r", phases)
    assert "mission 'hover', phase 'tuck' has a pose from which the arm cannot be folded" in problem
    assert "from (75, 70, 145, 40) deg to safety.fold_arm_deg (0, 170, 145, 60) deg" in problem
    assert "would bring the net into a rotor" in problem and "rotor 3" in problem and "(also in 'away')" in problem
    assert problems("tarot650_4r", moves(("beside", beside), ("home", folded))) == []


def test_a_mission_is_refused_if_the_arm_would_fold_through_the_floor() -> None:
    """A single link points forward above the floor; on the way back to the folded pose it hangs down."""
    arm = [
        *overrides_with_joints(1),
        "vehicle.arm.joints[0].angle_deg=[-20.0, 175.0]",
        "vehicle.arm.poses={forward: [30.0]}",
    ]
    up, down = "{type: line, to_m: [-1.0, 0.0, 1.2]}", "{type: line, to_m: [-1.0, 0.0, 0.35], duration_s: 8.0}"
    forward, folded = "{type: arm, arm_deg: forward}", "{type: arm, arm_deg: folded}"
    (problem,) = problems("tarot650_2r", f"{forward}, {down}, {up}, {folded}", *arm)
    assert "would drag the arm over the floor" in problem and "(30) deg to safety.fold_arm_deg (165) deg" in problem
    assert problems("tarot650_2r", f"{forward}, {folded}, {down}, {up}", *arm) == []


def beside_the_body(angle_deg: float) -> tuple[Vehicle, tuple[float, ...]]:
    """Return a vehicle with a long single link in the plane of its left rotors, and the pose of that link."""
    vehicle = load_vehicle(
        "tarot650_2r",
        [
            *overrides_with_joints(1),
            "vehicle.arm.shoulder_body_m=[0.0, 0.23, -0.05]",
            "vehicle.arm.link_lengths_m=[0.9]",
        ],
    )
    return vehicle, radians((angle_deg,))


@pytest.mark.parametrize(("angle_deg", "hits"), [(-10.0, True), (0.0, False), (30.0, False)])
def test_a_link_that_passes_through_a_rotor_is_found_although_its_ends_are_clear(angle_deg: float, hits: bool) -> None:
    vehicle, arm_rad = beside_the_body(angle_deg)
    contact = ArmClearance(vehicle).rotor_contact(arm_rad)
    assert (contact is not None) is hits
    if contact is not None:
        assert (contact.part, contact.rotor) == ("link 1", 3)
        assert contact.at_body_m == pytest.approx(
            (0.2298, 0.23, -0.05 + 0.2298 * math.tan(math.radians(10.0))), abs=1e-3
        )


def test_the_rotor_is_as_large_as_the_propeller() -> None:
    assert load_vehicle("tarot650_2r").airframe.disk_radius_m == 0.165
    without_key = load_vehicle(
        "tarot650_2r", ["vehicle.airframe.rotor_radius_m=null", "vehicle.airframe.radius_m=0.45"]
    )
    assert without_key.airframe.disk_radius_m == pytest.approx(0.125)


def test_a_propeller_that_reaches_beyond_the_radius_of_the_vehicle_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"airframe\.radius_m: expected at least 0\.49 m.*rotor_radius_m, got 0\.45 m"
    ):
        load_vehicle("tarot650_2r", ["vehicle.airframe.radius_m=0.45"])


def test_a_fold_is_straight_in_joint_space() -> None:
    start, goal = radians((80.0, 45.0, 115.0, 90.0)), radians((0.0, 170.0, 145.0, 60.0))
    pose, steps = start, 0
    while pose != goal:
        pose = towards(pose, goal, math.radians(2.0))
        shares = [(now - a) / (b - a) for now, a, b in zip(pose, start, goal, strict=True)]
        assert max(shares) - min(shares) < 1e-9
        steps += 1
    assert steps == math.ceil(125.0 / 2.0)
    assert towards(goal, goal, 0.1) == goal and towards((), (), 0.1) == ()
