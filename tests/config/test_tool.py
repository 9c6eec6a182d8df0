"""The tool at the tip of the arm: its keys, and what a rod changes in checks."""

from __future__ import annotations

import math

import pytest

from companion.config.document import ConfigError
from companion.config.loader import load_flight, load_vehicle
from companion.control.arm_model import manipulator_of
from companion.control.sensing import ForceSensing
from companion.mission.arm_clearance import ArmClearance
from companion.mission.check import check_mission
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import IDENTITY_QUAT, ForceSample

ROD = load_vehicle("configs/vehicles/tarot650_2r_rod.yaml")
FOLDED, PRESS = (tuple(map(math.radians, ROD.poses_deg[name])) for name in ("folded", "press"))


@pytest.mark.parametrize(
    ("tool", "line"),
    [
        ("{sensor_mass_kg: 0.1, net_mass_kg: 0.1}", "net_radius_m: missing; a net has it"),
        (
            "{kind: rod, sensor_mass_kg: 0.1, mass_kg: 0.1, length_m: 0.3, tip_radius_m: 0.01, net_radius_m: 0.1}",
            "net_radius_m: must be absent; a rod does not have it",
        ),
        (
            "{kind: brush, sensor_mass_kg: 0.1, mass_kg: 0.1, length_m: 0.3, tip_radius_m: 0.01}",
            "stiffness_n_m: missing; a brush has it",
        ),
        (
            "{kind: rot, sensor_mass_kg: 0.1}",
            'kind: expected one of "net", "rod", "brush", "clamp", got "rot" (did you mean rod?)',
        ),
    ],
)
def test_a_tool_has_the_keys_of_its_kind(tool: str, line: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_flight("configs/missions/hover.yaml", overrides=[f"vehicle.tool={tool}"])
    assert [text.split(": tool.")[1] for text in refused.value.lines] == [line]


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("vehicle.tool.jaws.servo_id=2", "joint 2 has the servo id 2 too; give each servo its own id"),
        ("vehicle.devices.arm.type=steady", "tool.jaws: a clamp needs devices.arm.type dynamixel, got steady"),
    ],
)
def test_a_clamp_has_a_servo_of_its_own_on_a_bus_of_dynamixel_servos(override: str, line: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_flight("configs/missions/hover.yaml", "configs/vehicles/tarot650_2r_clamp.yaml", overrides=[override])
    assert [text for text in refused.value.lines if text.endswith(line)]


def test_jaws_whose_servo_could_be_in_either_of_two_turns_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"expected less than 340 deg from closed_deg \(180 deg\), got -165 deg"):
        load_flight(
            "configs/missions/hover.yaml",
            "configs/vehicles/tarot650_2r_clamp.yaml",
            overrides=["vehicle.tool.jaws.open_deg=-165"],
        )


def test_the_rod_reaches_beyond_the_rotors_and_below_them() -> None:
    x_m, y_m, z_m = manipulator_of(ROD).net_body_m(PRESS)
    assert x_m >= ROD.airframe.radius_m + 0.25
    assert y_m == 0.0
    assert z_m < -0.1
    clearance = ArmClearance(ROD)
    assert clearance.rotor_contact(PRESS) is None
    fold = clearance.fold(PRESS)
    assert fold.contact is None
    assert fold.lowest_body_m > -ROD.airframe.ground_clearance_m + 0.01
    assert manipulator_of(ROD).net_body_m(FOLDED)[0] + ROD.tip_radius_m <= ROD.airframe.radius_m + 0.015


@pytest.mark.parametrize("mission", ["hover", "circuit"])
def test_missions_without_a_catch_suit_a_rod(mission: str) -> None:
    config = load_flight(f"configs/missions/{mission}.yaml", "tarot650_2r_rod")
    assert check_mission(config.mission, config.vehicle) == []


def test_a_catch_with_a_rod_is_refused_by_name() -> None:
    config = load_flight("configs/missions/catch.yaml", "tarot650_2r_rod")
    found = [line for line in check_mission(config.mission, config.vehicle) if "payload" in line]
    assert found == [
        "mission 'catch', phase 'catch' expects a payload in the net, but vehicle 'tarot650-2r-rod' has no net (tool), but a rod; "
        "choose a vehicle with a net, or remove catch from the mission"
    ]


def test_the_weight_of_the_rod_is_taken_out_of_the_reading() -> None:
    assert ROD.tool is not None
    sensing = ForceSensing(ROD.tool, manipulator_of(ROD))
    weight_n = ROD.tool.beyond_sensor_kg * GRAVITY_M_S2

    def reading(x: float, y: float, z: float) -> ForceSample:
        sensing._last_stamp_s = None
        return ForceSample(stamp_s=1.0, force_sensor_n=(x, y, z), torque_sensor_nm=(0.0, 0.0, 0.0), overload=False)

    sensing.collect(reading(0.5, -0.3, 0.2 - weight_n), IDENTITY_QUAT, FOLDED)  # the rod is level
    sensing.finish_tare()
    assert sensing.bias_sensor_n == pytest.approx((0.5, -0.3, 0.2))
    force_n = sensing.external_world_n(reading(0.5 - 5.0, -0.3, 0.2 - weight_n), IDENTITY_QUAT, PRESS)
    assert force_n == pytest.approx((-5.0, 0.0, 0.0))
