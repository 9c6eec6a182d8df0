"""No take-off on an estimate that drifts, and none without a stream of setpoints."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import pytest

from companion.core.flight_core import FlightCore
from companion.model import flight_stage as seq
from companion.model.frames import quat_from_euler_zyx, quat_multiply
from companion.model.outputs import Outputs
from companion.model.types import AutopilotRequest, FlightMode, Inputs, Outcome
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from tests.flights.ends import Changed
from tests.safety.healthy import put

replace = msgspec.structs.replace
Change = Callable[[Inputs], Inputs]


def configured(*overrides: str) -> SitlConfig:
    return load_sitl("configs/missions/hover.yaml", overrides=overrides)


def off_by(x_m: float, yaw_deg: float, *, until_s: float = math.inf, swing_s: float | None = None) -> Change:
    """PX4's estimate is this far from motion capture, steadily or swinging to and fro."""

    def change(i: Inputs) -> Inputs:
        if i.vehicle is None or i.t_s >= until_s:
            return i
        share = 1.0 if swing_s is None else math.sin(2.0 * math.pi * i.t_s / swing_s)
        x, y, z = i.vehicle.position_world_m
        turn = quat_from_euler_zyx(0.0, 0.0, math.radians(share * yaw_deg))
        attitude = quat_multiply(turn, i.vehicle.attitude_wxyz)
        return put("vehicle", position_world_m=(x + share * x_m, y, z), attitude_wxyz=attitude)(i)

    return change


def rocked(x_m: float, swing_s: float) -> Change:
    """The vehicle is moved to and fro: PX4's estimate and motion capture show the same."""

    def change(i: Inputs) -> Inputs:
        if i.vehicle is None or i.mocap is None:
            return i
        by_m = x_m * math.sin(2.0 * math.pi * i.t_s / swing_s)
        (x, y, z), (a, b, c) = i.vehicle.position_world_m, i.mocap.position_world_m
        i = put("mocap", position_world_m=(a + by_m, b, c))(i)
        return put("vehicle", position_world_m=(x + by_m, y, z))(i)

    return change


def events(outputs: list[Outputs]) -> list[tuple[str, str]]:
    return [(event.id, event.text) for o in outputs for event in o.events]


@pytest.mark.parametrize(
    ("change", "drifts"),
    [
        (off_by(0.07, 0.0), "its position is 7"),
        (off_by(0.05, 0.0, swing_s=0.7), "drifts by 3"),
        (off_by(0.0, 6.5), "its yaw is 6."),
        (off_by(0.0, 5.0, swing_s=0.6), "drifts by 3."),
        (rocked(0.05, 0.7), "does not stand still: its position has moved by 3"),
    ],
    ids=["off", "swings", "turned", "swings in yaw", "moved"],
)
def test_an_estimate_that_has_not_settled_or_a_vehicle_that_is_moved_is_refused_and_named(
    change: Change, drifts: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seq, "WAIT_TIMEOUT_S", 3.0)
    result = Changed(configured(), change).run(limit_s=20.0)
    assert result.outputs[-1].outcome is Outcome.REFUSED
    [(id_, text)] = events(result.outputs)
    assert id_ == "estimate_unsteady"
    assert drifts in text
    assert {o.request for o in result.outputs} <= {AutopilotRequest.NONE, AutopilotRequest.DISARM}
    waited_s = result.outputs[-1].t_s - result.outputs[0].t_s
    assert waited_s == pytest.approx(seq.WAIT_TIMEOUT_S, abs=0.5)


def test_it_takes_off_after_a_tare_with_a_settled_estimate() -> None:
    result = Changed(configured(), off_by(0.06, 0.0, until_s=2.0)).run(limit_s=7.5)
    assert [id_ for id_, _ in events(result.outputs)] == ["takeoff"]
    asked_s = next(o.t_s for o in result.outputs if o.request is AutopilotRequest.OFFBOARD)
    # The mean of a second is near long before the spread has become small. The tare of that second is renewed.
    assert 2.0 + 0.85 * seq.TARE_S < asked_s - seq.STREAM_BEFORE_OFFBOARD_S < 2.0 + 2.1 * seq.TARE_S


def test_an_ordinary_start_waits_for_no_more_than_the_tare() -> None:
    outputs = FastFlight(configured()).run(limit_s=3.0).outputs
    waited_s = next(o.t_s for o in outputs if o.phase != "wait") - outputs[0].t_s
    assert waited_s == pytest.approx(seq.TARE_S, abs=0.02)


def test_a_px4_that_is_in_offboard_already_is_given_a_stream_before_it_is_armed() -> None:
    """So it is after a landing: it would refuse to arm on no setpoints."""
    flight = FastFlight(configured())
    inputs = flight.run(limit_s=4.0).inputs
    core, armed_s, streamed_s = FlightCore(flight.config), None, None
    for i in inputs:
        o = core.step(put("status", mode=FlightMode.OFFBOARD, armed=False)(i))
        if o.attitude is not None and streamed_s is None:
            streamed_s = o.t_s
        if o.request is AutopilotRequest.ARM and armed_s is None:
            armed_s = o.t_s
    assert streamed_s is not None and armed_s is not None
    assert armed_s - streamed_s > 0.9 * seq.STREAM_BEFORE_OFFBOARD_S
