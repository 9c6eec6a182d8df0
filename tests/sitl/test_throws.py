"""Repeated throws: the world's behaviour, and a repeating flight that catches each of them."""

from __future__ import annotations

import math
from functools import cache

import pytest

from companion.model.types import Outcome
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.world.payload import Payload
from sitl.world.throws import with_throws
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_wait")

CATCH_S, PERIOD_S, KEEP_S = 2.45, 6.0, 1.0
"""Time of the first catch of `TO_AND_FRO`, time between two catches, and time in the net."""
TO_AND_FRO = (
    'mission.phases=[{"type": "takeoff", "height_m": 0.5, "duration_s": 1.5},'
    ' {"type": "line", "name": "catch", "to_m": [0.4, 0, 0.5], "duration_s": 2}, {"type": "hold", "duration_s": 1},'
    ' {"type": "line", "to_m": [-0.2, 0, 0.5], "duration_s": 2}, {"type": "hold", "duration_s": 1},'
    ' {"type": "land", "speed_m_s": 0.35}]',
    f"world.keep_s={KEEP_S}",
)
"""The short catch, flown there and back: it may be repeated."""
FIRST_MISSED = "world.faults=[{kind: payload_missed, t_s: 0, duration_s: 8.2, size: 0.5}]"
"""The first of its throws goes beside the net."""


def events(result: FastResult) -> list[tuple[str, float]]:
    """Ids with mission times."""
    begun_s = next(event.t_s for output in result.outputs for event in output.events if event.id == "takeoff")
    return [(event.id, event.t_s - begun_s) for output in result.outputs for event in output.events]


def test_a_throw_that_misses_is_flown_past_and_each_pass_catches_the_next_until_all_are_thrown() -> None:
    overrides = (*TO_AND_FRO, "mission.repeat=3", "world.throws=3", FIRST_MISSED)
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=overrides))
    result, payload = flight.run(limit_s=200.0), flight.plant.scene.payload
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert (payload.throws, payload.catches, payload.missed) == (3, 2, True)
    (names, times_s) = zip(*events(result), strict=True)
    assert names == ("takeoff", "catch", "payload_left", "catch", "touchdown"), "the last one stays in the net"
    assert (times_s[1], times_s[3]) == pytest.approx((CATCH_S + PERIOD_S, CATCH_S + 2 * PERIOD_S), abs=0.15)
    assert times_s[1] + KEEP_S + 0.5 <= times_s[2] < times_s[1] + KEEP_S + 1.0, "keep_s after the catch it is taken out"


HOVERS = (
    'mission.phases=[{"type": "takeoff", "height_m": 1.0, "duration_s": 2.0}, {"type": "hold", "duration_s": 2.5},'
    ' {"type": "land", "speed_m_s": 0.35}]',
    'mission.start.arm_deg="unfolded"',
    "world.catch_at_m=[-0.2, 0]",
    "world.throw_to=hovering",
)
"""A vehicle that goes up with its arm unfolded and waits there."""
PERSON = "world.people=[{from_m: [1.2, 1.4, 0.5], flight_s: 0.6}]"


@cache
def waited(*overrides: str) -> tuple[FastResult, Payload]:
    flight = FastFlight(load_sitl(SHORT_CATCH, overrides=(*HOVERS, *overrides)))
    return flight.run(until_mission_s=4.4), flight.plant.scene.payload


def thrown_at(result: FastResult, payload: Payload) -> float:
    """Mission time of the throw."""
    assert payload.thrown_t_s is not None
    begun_s = next(event.t_s for output in result.outputs for event in output.events if event.id == "takeoff")
    return payload.thrown_t_s - begun_s


def test_a_vehicle_that_hovers_gets_the_throw_once_its_net_has_been_at_rest() -> None:
    result, payload = waited()
    assert payload.caught_t_s is not None and payload.miss_m is not None and payload.miss_m < 0.05
    assert 2.2 < thrown_at(result, payload) < 3.5
    later, after = waited("world.throw_after_s=1.8")
    assert thrown_at(later, after) == pytest.approx(thrown_at(result, payload) + 0.8, abs=0.05)


@pytest.mark.parametrize("override", ["world.throw_to=passing", "world.catch_at_m=[0.1, 0]"])
def test_nobody_throws_to_a_vehicle_that_hovers_elsewhere_or_should_pass(override: str) -> None:
    _, payload = waited(override)
    assert (payload.thrown_t_s, payload.miss_m) == (None, None)


def test_people_are_told_from_the_mission_whether_the_vehicle_passes() -> None:
    assert with_throws(load_sitl(SHORT_CATCH, overrides=["world.throw_to=either"])).world.throw_to == "passing"
    for beside in ("world.catch_at_m=[0.5, 0]", "world.catch_at_m=[0, 0.6]"):
        config = load_sitl(SHORT_CATCH, overrides=["world.throw_to=either", beside])
        assert with_throws(config).world.throw_to == "hovering"


def test_a_person_throws_from_a_place_for_a_time_and_allows_for_the_drag() -> None:
    _, braked = waited(PERSON, "world.payload_drag_coefficient=1.5", "world.payload_kg=0.1")
    assert braked.thrown_t_s is not None and braked.caught_t_s is not None
    assert braked.caught_t_s - braked.thrown_t_s == pytest.approx(0.6, abs=0.06)


def test_each_seed_picks_one_of_the_people() -> None:
    people = "world.people=[{from_m: [1, 0, 0.5], flight_s: 0.4}, {from_m: [0, 1, 0.5], flight_s: 0.7}]"
    flights = [FastFlight(load_sitl(SHORT_CATCH, overrides=[people, f"world.seed={seed}"])) for seed in range(12)]
    assert {flight.plant.scene.payload._flight_s for flight in flights} == {0.4, 0.7}


def test_the_miss_is_the_distance_from_the_nets_centre() -> None:
    _, payload = waited("world.faults=[{kind: payload_missed, t_s: 0, duration_s: 20, size: 0.2}]")
    assert payload.caught_t_s is None
    assert payload.miss_m == pytest.approx(0.2, abs=0.03)


def test_a_person_may_aim_beside_the_net() -> None:
    _, payload = waited(PERSON.replace("}]", ", aims_m: [0.1, -0.2, 0]}]"))
    assert payload.caught_t_s is None
    assert payload.miss_m == pytest.approx(math.hypot(0.1, 0.2), abs=0.05)


def test_a_second_ball_may_be_thrown_a_while_after_the_first() -> None:
    fault = "world.faults=[{kind: payload_double, after: throw, t_s: 0.1, size: 0.1}]"
    result, payload = waited(fault, "vehicle.devices.mocap.ball={kind: marker}")
    assert payload.thrown_t_s is not None
    seen = [(i.markers.exposed_s - payload.thrown_t_s, len(i.markers.markers)) for i in result.inputs if i.markers]
    assert {count for since_s, count in seen if 0.01 < since_s < 0.09} == {1}
    assert {count for since_s, count in seen if 0.12 < since_s < 0.3} == {2}


def test_a_throw_that_never_rises_to_the_net_has_its_smallest_distance_as_miss() -> None:
    _, payload = waited("world.people=[{from_m: [1.2, 0, 0.05], flight_s: 0.25}]", "world.payload_drag_coefficient=200")
    assert payload.miss_m is not None and 0.2 < payload.miss_m < 1.42


def test_single_markers_show_the_ball_from_the_throw_to_the_net() -> None:
    result, payload = waited("vehicle.devices.mocap.ball={kind: marker}")
    assert payload.thrown_t_s is not None and payload.caught_t_s is not None
    seen = [(i.markers.exposed_s, i.markers.markers) for i in result.inputs if i.markers is not None]
    assert not any(markers for exposed_s, markers in seen if exposed_s <= payload.thrown_t_s)
    flight = [
        (t_s, markers[0].position_world_m) for t_s, markers in seen if payload.thrown_t_s < t_s < payload.caught_t_s
    ]
    assert len(flight) > 50
    (t0, p0), (t1, p1), (t2, p2) = flight[4], flight[len(flight) // 2], flight[-4]
    falls = ((p2[2] - p1[2]) / (t2 - t1) - (p1[2] - p0[2]) / (t1 - t0)) / ((t2 - t0) / 2)
    assert falls == pytest.approx(-9.81, abs=0.3)
    assert all(i.markers is None for i in waited()[0].inputs)
