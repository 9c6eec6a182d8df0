"""Every setting of `world.*`, found in the pydantic models: a pair of worlds that differ in this setting alone.

A new setting needs no entry here if its type says what other values it takes. A setting whose other values cannot be guessed, or that
acts only together with another, needs an entry in `VALUES` or `TOGETHER`; without one the test fails and names the setting.
"""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from companion.config.base import Model
from companion.sitl_config.effects.mocap import Mocap
from companion.sitl_config.effects.thrower import Person
from companion.sitl_config.faults import CONTACT_PHASES, KINDS, Fault
from companion.sitl_config.surfaces import Surface
from companion.sitl_config.world import Push, Servo, World

Settings = dict[str, Any]


class Pair(NamedTuple):
    """Two worlds that differ in one setting."""

    setting: str
    usual: Settings
    changed: Settings
    acts: int = 0
    """When it acts at the earliest: 0 from the start, 1 with turning rotors, 2 late in a flight."""


EXAMPLES: dict[type[Model], Settings] = {
    Push: {"t_s": 0.1, "duration_s": 0.1, "force_world_n": (0.0, 0.0, -2.0)},
    Servo: {},
    Person: {"from_m": (1.2, 0.5, 0.3)},
    Fault: {"kind": "gust", "t_s": 0.1},
    Mocap: {"on": True, "lost_share": 0.2, "wobble_every_s": 0.5},
    # The corner of a plate under the tip of the rod, which `test_world_settings.WITH_ROD` carries folded.
    Surface: {
        "point_m": (-0.544, -0.03, 0.136),
        "normal": (0.1, 0.1, 1.0),
        "size_m": (0.05, 0.05),
        "stiffness_n_m": 500.0,
    },
}
"""Examples of the parts of the world whose fields are tested; an effect that is not listed is switched on."""

VALUES: dict[str, Any] = {
    "mocap_axes": ("-x", "-y", "z"),
    "mocap_other_id": 9,
    "px4_params": {"MC_ROLLRATE_P": 0.1},
    "net_weight_kg": 0.5,
    "payload_kg": 0.3,
    "throw_to": "hovering",
    "markers.fixed_m": ((1.0, 1.0, 0.03),),
    "markers.wand_at_m": (1.0, 1.0, 1.0),
    "markers.range_m": 0.5,
    "handling_taps": 2,
    "servos.id": 9,
    "servos.baud": 57600,
    "servos.model": "XM430-W350",
    "servos.firmware": 37,
    "servos.current_limit_counts": 600,
    "catch_at_m[1]": 1.0,
    "faults.phase": "takeoff",
    "surfaces.name": "panel",
    "faults.duration_s": 0.1,
    "faults.size": 3.0,
    "faults.after": "start",
    # PX4 learns smaller ones before take-off.
    **{f"imu.gyro_bias_deg_s[{axis}]": 12.0 for axis in range(3)},
    "imu.accel_bias_m_s2[2]": 1.0,
}
"""Other values of settings for which type and default do not suffice."""

_HANDLED: Settings = {"handling": True, "handling_t_s": 0.0}
_HANDLED_FOR_LONG: Settings = {**_HANDLED, "px4_params": {"EKF2_EV_CTRL": 0}}
"""Handling for long: without an estimate the vehicle does not arm."""
TOGETHER: dict[str, Settings] = {
    "handling": {"handling_t_s": 0.0},
    "handling_t_s": _HANDLED,
    "handling_taps": _HANDLED_FOR_LONG,
    "handling_tap_n": {**_HANDLED_FOR_LONG, "handling_taps": 3},
    "net_weight_kg": {"net_weight_t_s": 0.4},
    "net_weight_t_s": {"net_weight_kg": 0.5, "net_weight_t_s": 0.4},
    "keep_s": {"throws": 2, "keep_s": 0.2},
    "throws": {"keep_s": 0.2},
    "throw_after_s": {"throw_to": "hovering", "catch_at_m": (0.4, 0.0), "throw_after_s": 0.5},
    "payload_radius_m": {"net": {"on": True}, "catch_at_m": (0.2, 0.0)},
}
"""Further settings of both worlds that make the setting act early in a flight."""

BESIDE_PART: dict[str, Settings] = {"net": {"catch_at_m": (0.2, 0.0)}, "thrower": {"seed": 7}}
"""Settings of both worlds beside a part: at this place the short catch does not accelerate, and the throw meets the net's middle; the
throw with this seed is caught.
"""

TOGETHER_IN_PART: dict[str, Settings] = {
    "faults.phase": {"t_s": None, "phase": "line"},
    "faults.servo": {"kind": "servo_overload"},
}
"""The same for a field of a part: the part's other fields."""

ACTS_LATE = frozenset({"throws", "keep_s", "throw_after_s", "handling_taps", "handling_tap_n", "faults.phase"})
"""Settings that act late in a flight."""

_NEVER = {"kind": "gust", "t_s": 1000.0}
BESIDE: dict[str, Settings] = {"tether_cut": {"kind": "tether_taut", "t_s": 0.0, "size": 0.02}}
"""Kinds of faults that act only together with another one."""
IN_THE_AIR = frozenset({"motor_weak", "offboard_refused", "pilot_takeover", "tether_taut", "tether_snag", "tether_cut"})
"""Kinds of faults that show only once the rotors turn."""
SIZES: dict[str, float] = {"payload_missed": 0.0, "autopilot_reboot": 0.1}
"""Sizes of faults for which half of the default size makes no difference."""


def pairs() -> Iterator[Pair]:
    """Return a pair for each setting, for each component of a vector, and for each field of each part."""
    for name, field in World.model_fields.items():
        parts = _models(field.annotation)
        for part in parts:
            yield from _of_part(name, field, part)
        if not parts:
            together = TOGETHER.get(name, {})
            for number, changed in _changes(name, field, together, World):
                yield Pair(name + number, together, {**together, **changed}, _acts(name))


def fault_pairs() -> Iterator[Pair]:
    """Return two sizes for each kind of fault that has a size, and the other kinds with and without the fault."""
    for kind, about in KINDS.items():
        after = "catch" if kind.startswith("payload_") else "arming" if kind in IN_THE_AIR else "start"
        acts = 2 if kind.startswith("tether_") else ("start", "arming", "catch").index(after)
        fault = {"kind": kind, "t_s": 0.1, "after": after}
        world = {"surfaces": [EXAMPLES[Surface]]} if about.phases == CONTACT_PHASES else {}
        if about.default is not None and kind != "pilot_takeover":
            other = {**fault, "size": SIZES.get(kind, 0.5 * about.default)}
            yield Pair(f"faults.size {kind}", {**world, "faults": [fault]}, {**world, "faults": [other]}, acts)
        else:
            with_it = BESIDE.get(kind, _NEVER)
            yield Pair(
                f"faults.kind {kind}", {**world, "faults": [with_it]}, {**world, "faults": [with_it, fault]}, acts
            )


def _acts(setting: str) -> int:
    return 2 if setting in ACTS_LATE else 0


def _of_part(name: str, field: FieldInfo, part: type[Model]) -> Iterator[Pair]:
    wide = 2 if part is Servo else 1
    beside = BESIDE_PART.get(name, {})
    for key, inner in part.model_fields.items():
        if (name, key) == ("faults", "kind") or key == "on":
            continue  # `fault_pairs`; a part whose other settings act when it is on, and do not when it is off, is switched
        path = f"{name}.{key}"
        usual = {**_example(part), **TOGETHER_IN_PART.get(path, {})}
        for number, changed in _changes(path, inner, usual, part):
            for place in range(wide):
                suffix = f" of {place + 1}" if wide > 1 else ""
                yield Pair(
                    path + number + suffix,
                    {**beside, name: _placed(field, part, usual, place)},
                    {**beside, name: _placed(field, part, {**usual, **changed}, place)},
                    _acts(path),
                )


def _example(part: type[Model]) -> Settings:
    assert part in EXAMPLES or "on" in part.model_fields, f"say in EXAMPLES what {part.__name__} looks like"
    return EXAMPLES.get(part, {"on": True})


def _placed(field: FieldInfo, part: type[Model], settings: Settings, place: int) -> Any:
    if part is Servo:
        return [settings if index == place else {} for index in range(2)]
    return [settings] if isinstance(field.default, tuple) else settings


def _changes(path: str, field: FieldInfo, usual: Settings, model: type[Model]) -> Iterator[tuple[str, Settings]]:
    """Yield the number of the component ("" without one) and the changed settings."""
    name = path.rpartition(".")[2]
    if path in VALUES:
        yield "", {name: VALUES[path]}
        return
    default = usual[name] if name in usual else field.get_default(call_default_factory=True)
    if isinstance(default, tuple) and default and all(isinstance(value, (int, float)) for value in default):
        for index, value in enumerate(default):
            within = (default, index)
            yield f"[{index}]", {name: _accepted(f"{path}[{index}]", field, usual, model, value, within)}
        return
    yield "", {name: _accepted(path, field, usual, model, default, None)}


def _accepted(
    path: str, field: FieldInfo, usual: Settings, model: type[Model], value: Any, within: tuple[Any, int] | None
) -> Any:
    name = path.rpartition(".")[2].partition("[")[0]
    for other in [VALUES[path]] if path in VALUES else _others(value, field.annotation):
        whole = other
        if within is not None:
            vector, index = within
            whole = (*vector[:index], other, *vector[index + 1 :])
        try:
            model.model_validate({**usual, name: whole})
        except ValidationError:
            continue
        return whole
    raise AssertionError(
        f"world.{path}: say in tests/sitl/world_settings.py, VALUES, what else it may be than {value!r}"
    )


def _others(value: Any, annotation: Any) -> list[Any]:
    if isinstance(value, bool):
        return [not value]
    literals = [choice for choice in _literals(annotation) if choice != value]
    if literals:
        return literals
    if isinstance(value, int):
        return [value + 1, value + 2, value - 1, value // 2]
    if isinstance(value, float):
        return [1.5 * value + 0.2, 1.5 * value + 2.0, value + 0.2, 0.5 * value]
    return []


def _literals(annotation: Any) -> list[Any]:
    if typing.get_origin(annotation) is Literal:
        return list(typing.get_args(annotation))
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, typing.Annotated):
        return [choice for inner in typing.get_args(annotation) for choice in _literals(inner)]
    return []


def _models(annotation: Any) -> list[type[Model]]:
    if isinstance(annotation, type) and issubclass(annotation, Model):
        return [annotation]
    found = [model for inner in typing.get_args(annotation) for model in _models(inner)]
    return list(dict.fromkeys(found))
