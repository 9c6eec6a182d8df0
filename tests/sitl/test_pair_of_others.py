"""A bar is also carried by two vehicles that differ: a stiff hexacopter at one end, at the other an arm of four joints that yields."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from companion.model.types import Outcome
from companion.sitl_config.team import load_team
from sitl.fast.team import FastTeam
from tests.short_carry import SHORT_CARRY
from tests.support import ROOT

VEHICLES = ROOT / "configs/vehicles"


def read(name: str) -> Any:
    return yaml.safe_load((VEHICLES / f"{name}.yaml").read_text(encoding="utf-8"))


def with_clamp(name: str, changes: dict[str, dict[str, Any]], servo_id: int) -> dict[str, Any]:
    """A vehicle of the repository with the clamp, the room and the tether of the one that carries a bar."""
    vehicle, clamp = read(name), read("tarot650_2r_clamp")
    vehicle["tool"] = {**clamp["tool"], "jaws": {**clamp["tool"]["jaws"], "servo_id": servo_id}}
    vehicle["room"] = clamp["room"]
    vehicle["tether"]["anchor_world_m"] = clamp["tether"]["anchor_world_m"]
    for section, values in changes.items():
        vehicle[section].update(values)
    return vehicle  # type: ignore[no-any-return]


@pytest.mark.usefixtures("short_start")
def test_an_arm_of_four_joints_and_a_hexacopter_carry_a_bar_together(tmp_path: Path) -> None:
    four = with_clamp("tarot650_4r", {"safety": {"fold_arm_deg": [0.0, 145.0, 145.0, 0.0]}}, 5)
    four["arm"]["urdf"] = str(VEHICLES / four["arm"]["urdf"])
    four["arm"]["poses"]["carry"] = [0.0, 75.0, 20.0, 0.0]
    hexa = with_clamp("hexa_2r", {"safety": {"fold_arm_deg": [145.0, 145.0]}}, 3)
    hexa["arm"]["poses"] = read("tarot650_2r_clamp")["arm"]["poses"]
    team = yaml.safe_load((ROOT / "configs/teams/carry.yaml").read_text(encoding="utf-8"))
    team["mission"] = str(ROOT / "configs/missions/carry.yaml")
    for end, vehicle in (("left", four), ("right", hexa)):
        (tmp_path / f"{end}.yaml").write_text(yaml.safe_dump(vehicle), encoding="utf-8")
        team["members"][end]["vehicle"] = f"{end}.yaml"
    (tmp_path / "team.yaml").write_text(yaml.safe_dump(team), encoding="utf-8")
    overrides = (*SHORT_CARRY, "right.mission.phases[2].compliance=null")
    result = FastTeam(load_team(str(tmp_path / "team.yaml"), overrides, world="ideal"), ({}, {})).run(120.0)
    assert [member.outputs[-1].outcome for member in result.members] == [Outcome.COMPLETED, Outcome.COMPLETED]
    arms = [member.inputs[-1].arm for member in result.members]
    assert [len(arm.angle_rad) for arm in arms if arm is not None] == [4, 2]
