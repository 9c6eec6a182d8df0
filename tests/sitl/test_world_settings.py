"""Every setting of `world.*` has an effect: it changes a flight in the fast closed loop.

`tests/flights/test_lockstep.py` shows that a flight over the wires is that of the fast loop; what acts on wires alone is tested in
`test_fault_wires.py` and `test_servo_model.py`.
"""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from typing import Any

import pytest

from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.world import World
from sitl.fast.loop import FastFlight, FastResult
from tests.sitl.world_settings import Pair, Settings, fault_pairs, pairs
from tests.support import HOVER, SHORT_CATCH

BASE = load_sitl(SHORT_CATCH)
WITH_ROD = load_sitl(HOVER, vehicle_path="tarot650_2r_rod")
"""Flown in worlds with surfaces, which a net does not touch."""
WITH_BALL = load_sitl(SHORT_CATCH, overrides=("vehicle.devices.mocap.ball={kind: marker}",))
"""Flown in worlds with errors of single markers, which are streamed for it alone."""
PAIRS = [*pairs(), *fault_pairs()]

_SET_UP = "the companion's set-up of the bus writes this register, or a row of its preflight judges it; the fast loop has neither"
ON_WIRES_ONLY = {
    "natnet_version": "the fast loop has no NatNet bytes",
    "mocap_other_id": "an address: the fast loop has no stream of several rigid bodies",
    "arm_handling": "it holds a limp arm; in the fast loop the arm gives torque from the start",
    "servos.firmware": _SET_UP,
    "servos.return_delay_us": _SET_UP,
    "servos.operating_mode": _SET_UP,
    "servos.position_limit_counts": "mode 0 has no position limits",
    "extends": "a world file's key: the loader has read the other world",
    "surfaces.name": "it stands in the report alone",
    "servos.shadow_id": "a second address on the bus",
}
"""Settings without a meaning in the fast closed loop, and why."""

TARE_S = 0.1
"""In the fast loop, instead of the flight's second: nothing but noise happens meanwhile."""
UNTIL_S = EARLY_S, _, _ = 0.65, 3.5, 8.3
"""Flight times in the fast loop: until the servos give torque, until the rotors turn, and including the catch.

A pair flies until its first difference. Shorter flights are tried first, unless other pairs share the usual world.
"""
SHARED = {world for world, pairs_of_it in Counter(json.dumps(pair.usual) for pair in PAIRS).items() if pairs_of_it > 3}
EARLY = {"air", "battery", "compliance", "imu", "machine", "markers", "mocap", "push", "rotors"}
"""Parts of shared worlds that act before the catch."""


class Unlike(Exception):
    """The flight differs."""


class Watched(list[Any]):
    """A record that ends the flight at the first difference from an earlier record."""

    def __init__(self, usual: list[Any]) -> None:
        super().__init__()
        self._usual = usual

    def append(self, item: Any) -> None:
        """Add an item.

        Raises:
            Unlike: the earlier record has another one, or none.
        """
        if len(self) >= len(self._usual) or item != self._usual[len(self)]:
            raise Unlike
        super().append(item)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wait before take-off is short, and a flight with faults that is ended in the air is not followed to the floor."""
    monkeypatch.setattr("companion.model.flight_stage.TARE_S", TARE_S)
    monkeypatch.setattr("companion.mission.settled.SETTLED_S", TARE_S)
    monkeypatch.setattr("sitl.fast.loop.SETTLE_S", 0.0)


def world(settings: Settings) -> SitlConfig:
    return in_world(World.model_validate(settings))


def in_world(world: World) -> SitlConfig:
    return (WITH_ROD if world.surfaces else WITH_BALL if world.markers.on else BASE).model_copy(update={"world": world})


@cache
def usual_flight(world_json: str, limit_s: float) -> FastResult:
    return FastFlight(in_world(World.model_validate_json(world_json))).run(limit_s)


def flights_differ(pair: Pair, limit_s: float) -> bool:
    """Return whether core, world or guardian differ in the fast loop up to this time."""
    usual = usual_flight(world(pair.usual).world.model_dump_json(), limit_s)
    result = FastResult(
        inputs=Watched(usual.inputs),
        outputs=Watched(usual.outputs),
        snapshots=Watched(usual.snapshots),
        after=Watched(usual.after),
    )
    try:
        FastFlight(world(pair.changed))._run(result, limit_s)
    except Unlike:
        return True
    return len(result.inputs) < len(usual.inputs)


def tried(pair: Pair) -> tuple[float, ...]:
    """Return the flight times to try in turn until the pair differs."""
    if json.dumps(pair.usual) not in SHARED:
        return UNTIL_S[pair.acts :]
    return UNTIL_S[1:] if pair.usual.keys() & EARLY else UNTIL_S[-1:]


def field(pair: Pair) -> str:
    """Return the setting without its component or place."""
    return pair.setting.partition("[")[0].partition(" ")[0]


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair.setting)
def test_it_changes_a_flight_in_the_fast_loop(pair: Pair) -> None:
    if field(pair) in ON_WIRES_ONLY:
        assert not flights_differ(pair, EARLY_S), "it does act in the fast loop: take it off the list"
    else:
        differ = any(flights_differ(pair, limit_s) for limit_s in tried(pair))
        assert differ, f"world.{pair.setting} does nothing in the fast loop"


def test_the_list_of_exceptions_names_settings_that_there_are() -> None:
    assert set(ON_WIRES_ONLY) <= {field(pair) for pair in PAIRS}
    assert len({field(pair) for pair in PAIRS} - set(ON_WIRES_ONLY)) > 40


def test_parts_that_are_off_change_nothing_whatever_their_other_settings_are() -> None:
    off: dict[str, Settings] = {}
    for pair in PAIRS:
        for part, settings in pair.changed.items():
            if isinstance(settings, dict) and "on" in settings:
                off.setdefault(part, {}).update({**settings, "on": False})
    assert {"air", "battery", "downwash", "force_sensor", "imu", "machine", "mocap", "net", "rotors"} <= off.keys()
    assert not flights_differ(Pair("off", {}, off), UNTIL_S[-1])
