"""The grammar of contact phases."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pydantic import ValidationError

from companion.config.mission import Mission

APPROACH = {"type": "approach", "direction": [1.0, 0.0, 0.0], "distance_max_m": 0.3, "speed_m_s": 0.04}
PRESS = {"type": "press", "force_n": 5.0, "duration_s": 5.0}
SLIDE = {"type": "slide", "force_n": 3.0, "displacement_m": [0.0, -0.5], "speed_m_s": 0.05}
DETACH = {"type": "detach", "speed_m_s": 0.1}
HOLD = {"type": "hold", "duration_s": 1.0}


def mission(*phases: dict[str, Any]) -> Mission:
    return Mission.model_validate_json(
        json.dumps(
            {
                "schema_version": 1,
                "name": "contact",
                "vehicle": "v.yaml",
                "start": {"position_m": [0.0, 0.0], "arm_deg": [165.0, 140.0]},
                "limits": {
                    "speed_max_m_s": 0.8,
                    "acceleration_max_m_s2": 1.0,
                    "arm_speed_max_deg_s": 90.0,
                    "arm_acceleration_max_deg_s2": 180.0,
                },
                "phases": [
                    {"type": "takeoff", "height_m": 1.0, "duration_s": 3.0},
                    *phases,
                    {"type": "land", "speed_m_s": 0.3},
                ],
            }
        )
    )


@pytest.mark.parametrize("phases", [(APPROACH, PRESS, DETACH), (APPROACH, PRESS, SLIDE, SLIDE, PRESS, DETACH, HOLD)])
def test_a_contact_that_is_left_is_accepted(phases: tuple[dict[str, Any], ...]) -> None:
    assert len(mission(*phases).phases) == len(phases) + 2


@pytest.mark.parametrize(
    ("phases", "text"),
    [
        ((PRESS,), "a press must follow an approach"),
        ((SLIDE,), "a slide must follow an approach"),
        (({**SLIDE, "displacement_m": [0.0, 0.0]},), "is shorter than"),
        ((DETACH,), "a detach must follow a press"),
        ((APPROACH, DETACH), "a detach must follow a press"),
        ((APPROACH, HOLD), "a press or a slide must follow the approach, not a hold"),
        ((APPROACH, SLIDE, HOLD), "a detach must come before this hold"),
        ((APPROACH, PRESS, HOLD, DETACH), "a detach must come before this hold"),
        ((APPROACH, PRESS), "a detach must come before this land"),
        (({**APPROACH, "direction": [0.0, 0.0, 0.0]}, PRESS, DETACH), "has no length"),
    ],
)
def test_other_orders_are_refused(phases: tuple[dict[str, Any], ...], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        mission(*phases)
