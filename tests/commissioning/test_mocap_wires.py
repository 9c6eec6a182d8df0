"""`companion mocap check` and `align` over real wires: each planted fault is found, and the patch that is written puts it right."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from companion.model.exit_codes import EXIT_OK
from tests.support import CATCH, ROOT, Ended, Sandbox, World, run_here, set_options

VEHICLE = ROOT / "configs/vehicles/tarot650_2r.yaml"
WATCH_S = 2
LIFTED_S = 4
"""The hand lifts the machine as soon as the world begins."""


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    """A vehicle file that may be written."""
    return Path(shutil.copy(VEHICLE, tmp_path / "vehicle.yaml"))


def addresses(world: World, *left_out: str) -> list[str]:
    """`--set` options without those keys of motion capture that are to come from the vehicle file."""
    keys = {
        name: {key: value for key, value in keys.items() if name != "mocap" or key not in left_out}
        for name, keys in world.devices.items()
    }
    flat = {f"vehicle.devices.{name}.{key}": value for name, one in keys.items() for key, value in one.items()}
    return set_options(**flat)


def document(ended: Ended) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(ended.out)
    assert found["schema_version"] == 1
    assert found["ok"] == (ended.code == EXIT_OK), ended
    return found


def bad(found: Mapping[str, Any]) -> dict[str, str]:
    """Rows that refuse: id and what to do."""
    return {row["id"]: row["fix"] for row in found["rows"] if not row["ok"] and row["level"] == "refuse"}


def changes(found: Mapping[str, Any]) -> dict[str, Any]:
    return {change["key"]: change["new"] for change in (found["patch"] or {"changes": []})["changes"]}


def test_a_sound_stream_is_described_and_a_server_at_another_address_found_by_broadcast(
    sandbox: Sandbox, vehicle: Path
) -> None:
    with World(sandbox) as world:
        ended = sandbox.run("mocap", "check", "--seconds", WATCH_S, "--json", "--vehicle", VEHICLE, *addresses(world))
        options = ["mocap", "check", "--seconds", 1, "--vehicle", vehicle, *addresses(world, "server")]
        wrong = [*options, *set_options(**{"vehicle.devices.mocap.server": "127.0.0.9"})]
        first = document(run_here(*wrong, "--write", "--yes", "--json"))
        people = run_here(*options)
    found = json.loads(ended.out)
    # What a busy computer makes of the arrival times is not this test's.
    assert not {"mocap.server", "mocap.own", "mocap.delay", "mocap.tracked", "mocap.error"} & set(bad(found))
    assert found["server"]["natnet"] == "4.1"
    assert found["server"]["interface"] == "lo"
    assert [(body["id"], body["name"]) for body in found["bodies"]] == [(1, "tarot650-2r")]
    assert found["timing"]["latency_s"]["p50"] == pytest.approx(0.006, abs=0.0015)
    assert found["timing"]["server_rate_hz"] == pytest.approx(200.0, rel=0.02)
    for words in ("id 1", "tarot650-2r", "100 % tracked", "#####", "ms and more", "unicast on lo"):
        assert words in people.out
    assert "no answer" in first["rows"][0]["read"]
    assert bad(first) == {"mocap.server": "set devices.mocap.server: 127.0.0.1"}
    assert changes(first) == {"devices.mocap.server": "127.0.0.1"}
    sandbox.assert_nobody_left(5.0)


def test_wrong_body_half_the_rate_and_more_latency_are_found_and_the_patch_is_right(
    sandbox: Sandbox, vehicle: Path
) -> None:
    """The file names a wand on the floor; the vehicle is another body."""
    knobs = {
        "world.mocap_rate_hz": 100.0,
        "world.mocap_latency_s": 0.035,
        "world.mocap_other_id": 1,
        "vehicle.devices.mocap.rigid_body_id": 7,
        "world.handling": True,
        "world.handling_t_s": 0.5,
    }
    overrides = [word for word in set_options(**knobs) if word != "--set"]
    with World(sandbox, overrides=overrides) as world:
        options = ["--json", "--vehicle", vehicle, *addresses(world, "rate_hz")]
        first = document(run_here("mocap", "check", "--move", "--write", "--yes", "--seconds", LIFTED_S, *options))
        again = document(run_here("mocap", "check", "--seconds", 1, *options))
    fixes = bad(first)
    assert {"mocap.own", "mocap.rate", "mocap.delay"} <= set(fixes)
    assert "id 7" in fixes["mocap.own"]
    proposed = changes(first)
    rate_hz = proposed.pop("devices.mocap.rate_hz")
    # The frames that arrived: fewer than 100 a second where a busy computer lost some.
    assert 50.0 < rate_hz < 105.0
    assert f"{rate_hz:g}" in fixes["mocap.rate"] and "Motive" in fixes["mocap.rate"]
    assert re.search(r"EKF2_EV_DELAY to the result, about 3[56] ms", fixes["mocap.delay"])
    assert proposed == {"devices.mocap.rigid_body_id": 7}
    assert Path(first["written"]).read_bytes() == VEHICLE.read_bytes()
    assert "# Motive: Settings > Streaming > Up Axis" in vehicle.read_text(encoding="utf-8")
    # Motive's own latency stays; what was wrong in the file is right.
    assert "mocap.own" not in bad(again)
    assert "mocap.delay" in bad(again)
    assert changes(again) == {}


def test_a_y_up_stream_is_found_and_written(sandbox: Sandbox, vehicle: Path) -> None:
    """The machine stands while the devices open and the test begins; then the hand lifts it."""
    knobs = ("world.handling=true", "world.handling_t_s=6", "world.payload_kg=0", 'world.mocap_axes=["x","z","-y"]')
    with World(sandbox, overrides=knobs) as world:
        options = ["--json", "--write", "--yes", "--vehicle", vehicle, *addresses(world, "up_axis")]
        ended = run_here("mocap", "align", CATCH, *options)
    found = document(ended)
    assert changes(found) == {"devices.mocap.up_axis": "y"}
    assert {"hand.lift", "hand.turn"} <= set(bad(found))
    assert "up_axis: y " in vehicle.read_text(encoding="utf-8")
    assert "lift it straight up" in ended.err
