"""What a vehicle file leaves out means the Tarot 650, and is named."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from companion.config.left_out import figures_left_out
from companion.config.loader import load_vehicle
from tests.support import ROOT


@pytest.mark.parametrize("name", ["tarot650_2r", "tarot650_4r", "hexa_2r"])
def test_the_shipped_files_leave_nothing_out(name: str) -> None:
    assert figures_left_out(load_vehicle(name)) == []


def test_each_figure_that_a_file_leaves_out_is_named_with_the_value_that_is_used(tmp_path: Path) -> None:
    text = (ROOT / "configs/vehicles/hexa_2r.yaml").read_text(encoding="utf-8")
    data = yaml.safe_load(text)
    del data["arm"]["poses"], data["arm"]["joint_armature_kg_m2"], data["safety"]["fold_arm_deg"]
    for key in ("inertia_kg_m2", "rotor_arm_m", "rotor_height_m", "yaw_torque_per_thrust_m", "rotor_radius_m"):
        del data["airframe"][key]
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    assert figures_left_out(load_vehicle(str(path))) == [
        "airframe.inertia_kg_m2 = [0.045, 0.045, 0.075]",
        "airframe.yaw_torque_per_thrust_m = 0.025",
        "airframe.rotor_arm_m = 0.325",
        "airframe.rotor_height_m = 0.03",
        "airframe.rotor_radius_m = 0.195 (from radius_m)",
        "arm.joint_armature_kg_m2 = 0.008",
        "safety.fold_arm_deg = [165, 140]",
        "arm.poses.unfolded = [100, 60]",
    ]
    without = load_vehicle(
        str(path), [f"vehicle.{key}=null" for key in ("arm", "tool", "devices.arm", "devices.force")]
    )
    assert not any("arm_deg" in text or "armature" in text for text in figures_left_out(without))


def test_rotors_that_are_listed_need_no_layout() -> None:
    rotors = "[{position_body_m: [0.3, 0.3, 0], spin: cw}, {position_body_m: [-0.3, 0.3, 0], spin: ccw}, "
    rotors += "{position_body_m: [-0.3, -0.3, 0], spin: cw}, {position_body_m: [0.3, -0.3, 0], spin: ccw}]"
    vehicle = load_vehicle("tarot650_2r", [f"vehicle.airframe.rotors={rotors}", "vehicle.airframe.radius_m=0.6"])
    assert figures_left_out(vehicle) == []
