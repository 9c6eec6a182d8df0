"""Every setting of `world.*` is read by the simulated world, every fault changes a flight, and a part that is off changes nothing.

What the parts do: `world/`. That a flight over the wires is that of the fast loop: `tests/flights/test_lockstep.py`. What acts on wires
alone: `test_fault_wires.py` and `test_servo_model.py`.
"""

from __future__ import annotations

import json
import typing
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest

from companion.config.base import Model
from companion.sitl_config.faults import CONTACT_PHASES, KINDS, FaultKind
from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.team import load_team
from companion.sitl_config.world import World
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.fast.team import FastTeam
from tests.support import HOVER, SHORT_CATCH, set_options

Settings = dict[str, Any]
ELSEWHERE = {
    "World.natnet_version": "the fast loop has no NatNet bytes",
    "World.mocap_other_id": "the fast loop has no stream of several rigid bodies",
    "World.arm_handling": "it holds a limp arm; in the fast loop the arm gives torque from the start",
    "World.extends": "a world file's key: the loader has read the other world",
    "Surface.name": "it stands in the report alone",
}
"""Settings that the fast closed loop does not read, and why."""

PLATE = {"point_m": (-0.544, -0.03, 0.136), "normal": (0.1, 0.1, 1.0), "size_m": (0.05, 0.05), "stiffness_n_m": 500.0}
"""A surface whose corner is under the tip of the folded rod."""


@pytest.fixture(autouse=True)
def _short(short_start: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight with faults that is ended in the air is not followed to the floor."""
    monkeypatch.setattr("sitl.fast.loop.SETTLE_S", 0.0)


def models(annotation: Any) -> list[type[Model]]:
    """The models in a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, Model):
        return [annotation]
    return [model for inner in typing.get_args(annotation) for model in models(inner)]


PARTS = {name: part for name, field in World.model_fields.items() for part in models(field.annotation)}
EFFECTS = {name: part for name, part in PARTS.items() if "on" in part.model_fields}


def overrides(**world: Any) -> list[str]:
    return set_options(**{f"world.{key}": value for key, value in world.items()})[1::2]


def test_every_setting_is_read_by_the_simulated_world(monkeypatch: pytest.MonkeyPatch) -> None:
    """A catch with every effect, a rod on a plate, and a vehicle that is handled."""
    on = overrides(**{f"{name}.on": True for name in EFFECTS})
    gust = {"kind": "gust", "phase": "line", "duration_s": 0.1, "size": 0.1}
    servo = {"kind": "servo_overload", "after": "catch", "t_s": 0.0, "servo": 2}
    push = {"t_s": 2.0, "duration_s": 0.1, "force_world_n": [0.0, 0.0, 0.1]}
    # At this place the short catch does not accelerate, and with this seed the net is hit.
    catch = overrides(
        push=push, servos=[{}, {}], throws=2, keep_s=0.2, faults=[gust, servo], seed=7, catch_at_m=[0.2, 0.0]
    )
    people = [{"from_m": [0.2, 1.0, 0.5], "flight_s": 0.5}]
    waiting = overrides(throw_to="hovering", people=people, catch_at_m=[-1.0, 0.0], payload_kg=0.2)
    handled = overrides(handling=True, handling_t_s=0.0, handling_taps=1, net_weight_kg=0.5, net_weight_t_s=0.4)
    flights = [
        (load_sitl(SHORT_CATCH, overrides=[*on, *catch, "vehicle.devices.mocap.ball={kind: marker}"]), 7.3),
        (
            load_sitl(
                HOVER, vehicle_path="tarot650_2r_rod", overrides=overrides(surfaces=[{**PLATE, "gives_way_n": 8.0}])
            ),
            0.6,
        ),
        (load_sitl(HOVER, overrides=handled), 0.6),
        (load_sitl(HOVER, overrides=waiting), 8.5),
    ]
    pair = load_team("carry", ["world.bar={}"])
    read: set[str] = set()

    def reading(model: Model, name: str) -> Any:
        if name in type(model).model_fields:
            read.add(f"{type(model).__name__}.{name}")
        return object.__getattribute__(model, name)

    with monkeypatch.context() as patched:
        patched.setattr(Model, "__getattribute__", reading)
        results = [FastFlight(config).run(limit_s) for config, limit_s in flights]
        FastTeam(pair).run(0.6)
    assert results[0].caught
    parts: list[type[Model]] = [World, *PARTS.values()]
    settings = {f"{part.__name__}.{name}" for part in parts for name in part.model_fields}
    assert settings - read == set(ELSEWHERE)


# -- faults ----------------------------------------------------------------------------------------------------------

_NEVER: Settings = {"kind": "gust", "t_s": 1000.0}
BESIDE: dict[str, Settings] = {"tether_cut": {"kind": "tether_taut", "t_s": 0.0, "size": 0.02}}
"""Kinds of faults that act only together with another one."""
IN_THE_AIR = frozenset({"motor_weak", "offboard_refused", "pilot_takeover", "tether_taut", "tether_snag", "tether_cut"})
"""Kinds of faults that show only once the rotors turn."""
SIZES: dict[str, float] = {"autopilot_reboot": 0.1}
"""Sizes of faults for which half of the default size makes no difference."""
ELSEWHERE_FLOWN = {
    "payload_missed": "test_throws.py: the miss has the size of the fault",
    "payload_double": "test_faults.py: both payloads hang in the net",
    "payload_dropped": "test_faults.py: it is felt no more",
    "clamp_overload": "test_pair.py: the one who has a clamp lands, and both set the bar down",
}
"""Kinds of faults, for most of which a flight to the catch is needed, whose effect is measured elsewhere."""
UNTIL_S = 7.3
"""Flight time that includes the catch."""


class Usual:
    """A flight that is flown as far as others are compared with it."""

    def __init__(self, config: SitlConfig) -> None:
        self.result = FastResult()
        self._ticks = FastFlight(config).ticks(self.result, UNTIL_S)

    def reaches(self, tick: int) -> bool:
        """Return whether the flight has this tick."""
        while len(self.result.outputs) <= tick and next(self._ticks, None) is not None:
            pass
        return len(self.result.outputs) > tick


def in_world(settings: Settings) -> SitlConfig:
    mission, vehicle = (HOVER, "tarot650_2r_rod") if "surfaces" in settings else (SHORT_CATCH, None)
    return load_sitl(mission, vehicle_path=vehicle).model_copy(update={"world": World.model_validate(settings)})


@cache
def usual_flight(settings: str) -> Usual:
    return Usual(in_world(json.loads(settings)))


def flights_differ(usual: Settings, changed: SitlConfig) -> bool:
    """Return whether core, world or guardian differ in the fast loop."""
    flown, result, tick = usual_flight(json.dumps(usual)), FastResult(), 0
    for tick, outputs in enumerate(FastFlight(changed).ticks(result, UNTIL_S), 1):
        its = flown.result
        if not flown.reaches(tick - 1) or outputs != its.outputs[tick - 1]:
            return True
        if result.after != its.after[: len(result.after)]:
            return True
        if result.inputs[-1] != its.inputs[tick - 1] or result.snapshots[-1] != its.snapshots[tick - 1]:
            return True
    return flown.reaches(tick)


def fault_pairs() -> Iterator[tuple[FaultKind, Settings, Settings]]:
    """Two sizes of each kind that has a size, the other kinds with and without the fault."""
    for kind, about in KINDS.items():
        if kind in ELSEWHERE_FLOWN:
            continue
        after = "catch" if kind.startswith("payload_") else "arming" if kind in IN_THE_AIR else "start"
        fault = {"kind": kind, "t_s": 0.1, "after": after}
        world: Settings = {"surfaces": [PLATE]} if about.phases == CONTACT_PHASES else {}
        if about.default is not None and kind != "pilot_takeover":
            usual, changed = [fault], [{**fault, "size": SIZES.get(kind, 0.5 * about.default)}]
        else:
            beside = BESIDE.get(kind, _NEVER)
            usual, changed = [beside], [beside, fault]
        yield kind, {**world, "faults": usual}, {**world, "faults": changed}


@pytest.mark.parametrize(("kind", "usual", "changed"), [*fault_pairs()])
def test_every_fault_and_its_size_change_a_flight(kind: FaultKind, usual: Settings, changed: Settings) -> None:
    assert flights_differ(usual, in_world(changed)), f"{kind} does nothing"


def test_parts_that_are_off_change_nothing_whatever_their_other_settings_are() -> None:
    def off(part: type[Model]) -> Model:
        values = {name: field.get_default(call_default_factory=True) for name, field in part.model_fields.items()}
        changed = {name: 1.5 * value + 0.2 for name, value in values.items() if isinstance(value, float)}
        return part.model_construct(**{**values, **changed, "on": False})

    world = World().model_copy(update={name: off(part) for name, part in EFFECTS.items()})
    assert not flights_differ({}, in_world({}).model_copy(update={"world": world}))
