"""Bad rotors in a vehicle file are refused in one line that names the key."""

from __future__ import annotations

import re
from typing import Any

import pytest
from pydantic import ValidationError

from companion.config.airframe import Airframe
from companion.config.document import ConfigError
from companion.config.loader import load_flight
from tests.support import CATCH

FRONT = [(0.3, 0.2), (0.3, -0.2)]
SQUARE = [*FRONT, (-0.3, 0.2), (-0.3, -0.2)]


def airframe(places: list[tuple[float, float]], spins: str) -> Airframe:
    """An airframe with these rotors; `spins` has one letter per rotor: l for ccw, r for cw."""
    rotors = [
        {"position_body_m": (x, y, 0.0), "spin": "ccw" if spin == "l" else "cw"}
        for (x, y), spin in zip(places, spins, strict=True)
    ]
    values: dict[str, Any] = {"mass_kg": 3.0, "thrust_max_n": 60.0, "ground_clearance_m": 0.3, "rotors": rotors}
    return Airframe.model_validate(values)


def test_listed_rotors_replace_the_layout() -> None:
    found = airframe(SQUARE, "lrrl").rotor_layout
    assert found.positions_body_m == tuple((x, y, 0.0) for x, y in SQUARE)
    assert found.spins == (1, -1, -1, 1)


@pytest.mark.parametrize(
    ("places", "spins", "location", "text"),
    [
        (SQUARE[:3], "lrl", ("rotors",), "expected 4 to 12 rotors .*, got 3"),
        (SQUARE * 4, "lrrl" * 4, ("rotors",), "expected 4 to 12 rotors .*, got 16"),
        ([*FRONT, *FRONT], "lrrl", ("rotors",), "on one line"),
        (SQUARE, "llll", ("rotors",), "no yaw torque"),
        (SQUARE, "llrr", ("rotors",), "no yaw torque"),
        (
            [*SQUARE[:3], (-300.0, -200.0)],
            "lrrl",
            ("rotors", 3, "position_body_m"),
            "expected less than radius_m, 0.49 m",
        ),
        ([*FRONT, (-0.02, 0.2), (-0.02, -0.2)], "lrrl", ("rotors", 0), "not balanced .* has 12% of the mean thrust"),
    ],
)
def test_rotors_that_cannot_fly_are_refused(
    places: list[tuple[float, float]], spins: str, location: tuple[str | int, ...], text: str
) -> None:
    with pytest.raises(ValidationError) as caught:
        airframe(places, spins)
    (problem,) = caught.value.errors()
    assert problem["loc"] == location
    assert re.search(text, problem["msg"]), problem["msg"]


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("vehicle.airframe.layout=hexa", "airframe.layout.*hexa_x"),
        ("vehicle.airframe.rotor_arm_m=325.0", r"airframe.rotor_arm_m.*expected less than radius_m, 0.49 m"),
        ("vehicle.airframe.battery_cells=6", "safety.battery_voltage_min_v.*expected 16.8 to 24.6 V for the 6 cells"),
        ("vehicle.tether.rotor_inner_radius_m=0.4", "tether.rotor_inner_radius_m.*expected less than 0.325 m"),
        ("vehicle.airframe.rotors=[]", "airframe.rotors.*expected 4 to 12 rotors"),
    ],
)
def test_a_bad_layout_is_refused_in_one_line(override: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_flight(CATCH, overrides=(override,))
    (line,) = caught.value.lines
    assert re.search(text, line), line
