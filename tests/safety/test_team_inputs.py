"""Clamp, bar and other vehicle with values that are not numbers, or out of range, count as not received."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec.structs import replace

from companion.model.team import BarPose, ClampState, Grip, PartnerState, TeamState, Together
from companion.model.types import Inputs, OperatorCommand
from companion.safety.flight_context import FlightContext
from companion.safety.team import TeamTracker, bar_tilted, bar_unseen
from companion.safety.validity import InputFilter

SAID = TeamState(
    grip=Grip.READY,
    together=Together(go_server_s=8.0),
    holds=False,
    lands=False,
    px4_lands=False,
    position_world_m=(0.0, 1.0, 1.0),
)
RECORDS: dict[str, Any] = {
    "clamp": ClampState(1.0, 1.5),
    "bar": BarPose(
        stamp_s=1.0, position_world_m=(0.0, 0.0, 1.0), attitude_wxyz=(1.0, 0.0, 0.0, 0.0), tracking_valid=True
    ),
    "partner": PartnerState(stamp_s=1.0, said=SAID),
}
SOUND = Inputs(tick=0, t_s=1.0, command=OperatorCommand.NONE, recorder_dropped=0, **RECORDS)


def said(**values: Any) -> dict[str, Any]:
    return {"said": replace(SAID, **values)}


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("clamp", {"angle_rad": math.nan}),
        ("clamp", {"angle_rad": -1e6}),
        ("clamp", {"stamp_s": math.inf}),
        ("bar", {"position_world_m": (0.0, math.nan, 1.0)}),
        ("bar", {"attitude_wxyz": (0.0, 0.0, 0.0, 0.0)}),
        ("bar", {"stamp_s": math.nan}),
        ("partner", {"stamp_s": math.nan}),
        ("partner", said(position_world_m=(0.0, 0.0, math.inf))),
        ("partner", said(together=Together(go_server_s=math.nan))),
        ("partner", said(server_s=math.inf)),
    ],
)
def test_a_value_that_is_not_valid_makes_the_record_one_that_was_not_received(field: str, values: Any) -> None:
    checked = InputFilter()
    bad = replace(SOUND, **{field: replace(RECORDS[field], **values)})
    assert checked.clean(bad) == replace(SOUND, **{field: None})
    assert set(checked.invalid) == {field}
    assert checked.clean(SOUND) is SOUND
    assert checked.clean(bad) == replace(SOUND, **{field: None})


def test_a_bar_out_of_sight_may_have_any_pose() -> None:
    unseen = replace(RECORDS["bar"], tracking_valid=False, position_world_m=(math.nan,) * 3)
    inputs = replace(SOUND, bar=unseen)
    assert InputFilter().clean(inputs) is inputs


def test_a_bar_whose_values_are_not_valid_any_more_is_one_that_is_not_seen() -> None:
    tracker, carrying = TeamTracker(), FlightContext(True, True, 0.0, grip=Grip.CARRYING)
    tracker.update(SOUND, carrying, 1.0)
    tracker.update(replace(SOUND, bar=None), carrying, 1.6)
    assert bar_unseen(tracker, None) is not None and bar_tilted(tracker, None) is None
