"""Every setting of `world.*` has an effect: it changes a flight in the fast closed loop, and what the devices send over the wires."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from typing import Any

import pytest

from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.world import World
from sitl.fast.loop import FastFlight, FastResult
from tests.sitl.simulated_devices import END_STEPS, Emitted, emitted
from tests.sitl.world_settings import Pair, Settings, fault_pairs, pairs
from tests.support import HOVER, SHORT_CATCH

BASE = load_sitl(SHORT_CATCH)
WITH_ROD = load_sitl(HOVER, vehicle_path="tarot650_2r_rod")
"""Flown in worlds with surfaces, which a net does not touch."""
PAIRS = [*pairs(), *fault_pairs()]

_SET_UP = "the companion's set-up of the bus writes this register, or a row of its preflight judges it; the fast loop has neither"
ON_WIRES_ONLY = {
    "natnet_version": "the fast loop has no NatNet bytes",
    "mocap_other_id": "an address: the fast loop has no stream of several rigid bodies",
    "arm_hand": "it holds a limp arm; in the fast loop the arm gives torque from the start",
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
EARLY = {"air", "battery", "compliance", "imu", "machine", "mocap", "push", "rotors"}
"""Parts of shared worlds that act before the catch."""
UNTIL_STEPS = (130, 400, END_STEPS)
"""The same on the wires, in steps of the physics."""


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
    return (WITH_ROD if world.surfaces else BASE).model_copy(update={"world": world})


@cache
def usual_flight(world_json: str, limit_s: float) -> FastResult:
    return FastFlight(in_world(World.model_validate_json(world_json))).run(limit_s)


@cache
def usual_emitted(world_json: str, end: int) -> Emitted:
    return emitted(in_world(World.model_validate_json(world_json)), end)


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


def devices_differ(pair: Pair, end: int) -> bool:
    """Return whether the devices' output differs up to this physics step."""
    usual = usual_emitted(world(pair.usual).world.model_dump_json(), end)
    return emitted(world(pair.changed), end, usual) != usual


def tried(pair: Pair, limits: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the limits to try in turn until the pair differs."""
    if json.dumps(pair.usual) not in SHARED:
        return limits[pair.acts :]
    return limits[1:] if pair.usual.keys() & EARLY else limits[-1:]


def field(pair: Pair) -> str:
    """Return the setting without its component or place."""
    return pair.setting.partition("[")[0].partition(" ")[0]


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: pair.setting)
def test_it_changes_a_flight_in_the_fast_loop(pair: Pair) -> None:
    if field(pair) in ON_WIRES_ONLY:
        assert not flights_differ(pair, EARLY_S), "it does act in the fast loop: take it off the list"
    else:
        differ = any(flights_differ(pair, limit_s) for limit_s in tried(pair, UNTIL_S))
        assert differ, f"world.{pair.setting} does nothing in the fast loop"


OF_DEVICES = (
    *(
        "payload_kg",
        "seed",
        "hover_thrust_error",
        "rotor_lag_s",
        "setpoint_delay_s",
        "arm_delay_s",
        "arm_hand",
        "hand_t_s",
    ),
    *(
        "push.t_s",
        "mocap_",
        "natnet_version",
        "gyro_noise",
        "force_noise",
        "servos.",
        "battery_",
        "px4_params",
        "faults.t_s",
    ),
    *("imu.on", "rotors.on", "battery.on", "servo_mechanics.on", "faults.kind", "faults.size link_delay"),
    *("faults.size bus_noise", "faults.size clock_step", "faults.size autopilot_reboot"),
)
"""How settings begin that are tried on the wires: those of the devices, and some that show that `Plant` and `Faults` get theirs."""
SENT = [
    pair
    for pair in PAIRS
    if pair.setting.startswith(OF_DEVICES)
    and pair.setting != "faults.kind bus_delay"  # it delays answers, which are not timed here: test_fault_wires.py
    and pair.acts < 2
    and "surfaces" not in pair.usual
]
"""Both loops give the world's settings as a whole to one `Plant` and one `Faults`: what these do is seen in the fast loop."""


@pytest.mark.parametrize("pair", SENT, ids=lambda pair: pair.setting)
def test_it_changes_what_the_devices_send(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    # The server notes what it struck; no process of ours is struck.
    monkeypatch.setattr("sitl.server.inject_process_fault", lambda kind, pid: True)
    differ = any(devices_differ(pair, end) for end in tried(pair, UNTIL_STEPS))
    assert differ, f"world.{pair.setting} does nothing on the wires"


def test_the_list_of_exceptions_names_settings_that_there_are() -> None:
    assert set(ON_WIRES_ONLY) <= {field(pair) for pair in PAIRS}
    assert len({field(pair) for pair in PAIRS} - set(ON_WIRES_ONLY)) > 40


def test_the_devices_send_the_same_when_nothing_is_changed() -> None:
    usual = usual_emitted(world({}).world.model_dump_json(), END_STEPS)
    assert emitted(world({}), END_STEPS, usual) == usual
    caught = usual.steps[-1][-1][-1]
    assert "thrown" in caught[-2]
    assert "caught" in caught[-1]
