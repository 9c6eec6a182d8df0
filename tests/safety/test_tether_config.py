"""A vehicle file whose tether is not known is not loaded, and one line says where and what."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from companion.config.document import ConfigError
from companion.config.loader import MOVED, load_flight, logged_flight
from tests.support import CATCH

ROOT = Path(__file__).parents[2]
ANCHOR = "  anchor_world_m: [0.0, -1.2, 0.0]\n"
LENGTH = "  length_m: 3.0\n"


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    for folder, name in (("vehicles", "tarot650_2r"), ("missions", "catch")):
        (tmp_path / folder).mkdir()
        shutil.copy(ROOT / "configs" / folder / f"{name}.yaml", tmp_path / folder)
    return tmp_path / "missions" / "catch.yaml"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (ANCHOR, "", r"tether\.anchor_world_m: missing; expected a list of 3 numbers"),
        (LENGTH, "", r"tether\.length_m: missing; expected a number > 0"),
        (LENGTH, "  length_m:\n", r"tether\.length_m: expected a number > 0, got nothing"),
        (LENGTH, "  length_m: 0.0\n", r"tether\.length_m: expected a number > 0, got 0\.0"),
        (LENGTH, LENGTH + "  turns: 2\n", r"tether\.turns: unknown key; .*turns_max.*"),
        (LENGTH, LENGTH + "  pull_min_n: -1\n", r"tether\.pull_min_n: expected a number > 0, got -1"),
    ],
)
def test_a_tether_that_is_not_known_is_not_loaded(mission: Path, old: str, new: str, line: str) -> None:
    path = mission.parents[1] / "vehicles" / "tarot650_2r.yaml"
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_flight(mission)
    (found,) = str(caught.value).splitlines()
    assert re.fullmatch(rf".*tarot650_2r\.yaml:\d+:\d+: {line}", found), found


def test_a_file_states_that_a_vehicle_has_no_tether(mission: Path) -> None:
    path = mission.parents[1] / "vehicles" / "tarot650_2r.yaml"
    before, _, rest = path.read_text(encoding="utf-8").partition("tether:\n")
    path.write_text(before + "tether: null\n" + rest.partition("\n\n")[2], encoding="utf-8")
    assert load_flight(mission).vehicle.tether is None


def test_keys_of_version_0_1_are_still_read() -> None:
    below = "vehicle.tether.react_time_s=0.4", "vehicle.tether.stop_deceleration_m_s2=1.5"
    config = load_flight(CATCH, overrides=below)
    assert (config.vehicle.safety.react_time_s, config.vehicle.safety.stop_deceleration_m_s2) == (0.4, 1.5)
    logged = json.loads(config.model_dump_json())
    for (old_part, old_key), (part, key) in MOVED.items():
        logged["vehicle"][old_part][old_key] = logged["vehicle"][part].pop(key)
    assert logged_flight(json.dumps(logged)) == config
    with pytest.raises(ConfigError) as twice:
        load_flight(CATCH, overrides=["vehicle.safety.react_time_s=0.3", below[0]])
    assert "--set vehicle.tether.react_time_s: unknown key" in str(twice.value)
