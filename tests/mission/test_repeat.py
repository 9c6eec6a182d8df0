"""A mission that repeats flies what it would fly if its phases were written down so often, and costs what two repetitions cost."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from companion.config.loader import load_flight
from companion.config.mission import Mission
from companion.mission.active_plan import ActiveTrajectory
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.mission.sample_check import SampleCheck
from companion.model.types import PhaseKind, Reference

ROOT = Path(__file__).parents[2]
VEHICLE = load_flight(ROOT / "configs/missions/catch.yaml").vehicle
START = (-1.03, 0.02, VEHICLE.airframe.ground_clearance_m)
AROUND_THE_ANCHOR = ("vehicle.tether.anchor_world_m=[0, 0, 0]",)


def mission(name: str, *overrides: str) -> Mission:
    return load_flight(ROOT / f"configs/missions/{name}.yaml", overrides=overrides).mission


def problems(name: str, *overrides: str) -> list[str]:
    config = load_flight(ROOT / f"configs/missions/{name}.yaml", overrides=overrides)
    return check_mission(config.mission, config.vehicle)


def written_out(once: Mission, count: int) -> Mission:
    document = once.model_dump(mode="json")
    first, *middle, last = document["phases"]
    return Mission.model_validate({**document, "repeat": 1, "phases": [first, *middle * count, last]})


def repeated(once: Mission, count: int) -> Mission:
    return Mission.model_validate({**once.model_dump(mode="json"), "repeat": count})


def numbers(reference: Reference) -> list[float]:
    return [
        *reference.position_world_m,
        *reference.velocity_world_m_s,
        *reference.acceleration_world_m_s2,
        *reference.jerk_world_m_s3,
        reference.yaw_rad,
        reference.yaw_rate_rad_s,
        *reference.arm_rad,
        *reference.arm_rate_rad_s,
        *reference.arm_acceleration_rad_s2,
    ]


@pytest.mark.parametrize("name", ["catch", "circuit"])
@pytest.mark.parametrize("count", [2, 5])
def test_it_is_the_same_motion_as_written_out(name: str, count: int) -> None:
    once = mission(name)
    short = Plan.build(repeated(once, count), VEHICLE, START, 0.05)
    long = Plan.build(written_out(once, count), VEHICLE, START, 0.05)
    assert short.duration_s == pytest.approx(long.duration_s, abs=1e-9)
    steps = 2000
    for step in range(-10, steps + 10):
        t_s = long.duration_s * step / steps
        assert numbers(short.reference(t_s)) == pytest.approx(numbers(long.reference(t_s)), abs=1e-8)
        assert short.jerks(t_s)[1] == pytest.approx(long.jerks(t_s)[1], abs=1e-6)
        one, other = short.segment(t_s), long.segment(t_s)
        edge_s = min(abs(t_s - other.start_s), abs(t_s - other.end_s))
        if edge_s > 1e-6:
            assert (one.kind, one.name.split(" (")[0]) == (other.kind, other.name.split(" (")[0])
            assert (one.start_s, one.end_s) == pytest.approx((other.start_s, other.end_s), abs=1e-9)


def test_without_repeat_the_plan_is_what_it_was() -> None:
    plan = Plan.build(mission("catch"), VEHICLE)
    assert [segment.name for segment in plan.segments] == [
        "take-off", "settle", "catch", "stabilise", "return", "above the start", "land"
    ]  # fmt: skip
    assert {segment.repetition for segment in plan.segments} == {0}


def test_phases_are_counted_by_name() -> None:
    plan = Plan.build(mission("catch", "mission.repeat=240"), VEHICLE)
    period_s = 15.0
    for repetition in (1, 2, 3, 17, 239, 240):
        begin_s = 3.0 + (repetition - 1) * period_s
        segment = plan.segment(begin_s + 3.5)
        assert (segment.name, segment.repetition, segment.index) == (f"catch ({repetition} of 240)", repetition, 2)
        assert (segment.start_s, segment.end_s) == pytest.approx((begin_s + 0.5, begin_s + 6.5))
    assert plan.segment(1.0).name == "take-off"
    assert plan.segment(3.0 + 240 * period_s + 1e-6).name == "land"
    assert plan.segment(1e6) is plan.segments[-1]
    assert plan.segments[-1].end_s == plan.duration_s


@pytest.mark.parametrize("period_s", [0.1 + 0.2, 7.0 / 3.0])
def test_every_seam_belongs_to_one_segment_and_the_machine_rests_there(period_s: float) -> None:
    """Periods that a binary number cannot hold: the times of the seams are rounded."""
    change = (
        "mission.phases=[{type: takeoff, height_m: 1, duration_s: 3}, "
        f"{{type: hold, name: stay, duration_s: {period_s}}}, {{type: land, speed_m_s: 0.35}}]"
    )
    plan = Plan.build(mission("catch", change, "mission.catch=null", "mission.repeat=1000"), VEHICLE)
    course = ActiveTrajectory(plan, 0.0)
    for repetition in range(1, 1001):
        middle_s = 3.0 + (repetition - 0.5) * period_s
        assert plan.segment(middle_s).name == f"stay ({repetition} of 1000)"
        seam_s = 3.0 + repetition * period_s
        for t_s in (math.nextafter(seam_s, 0.0), seam_s, math.nextafter(seam_s, math.inf)):
            segment = course.segment(t_s)
            assert segment.start_s - 1e-9 <= t_s <= segment.end_s + 1e-9
            assert segment.kind is not PhaseKind.TAKEOFF
            assert plan.reference(t_s).velocity_world_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_a_thousand_repetitions_are_planned_as_two() -> None:
    two, many = (Plan.build(mission("circuit", f"mission.repeat={count}"), VEHICLE) for count in (2, 1000))
    assert len(many.segments) == len(two.segments)
    assert many.duration_s > 100 * two.duration_s


def test_a_thousand_repetitions_are_checked_as_two(monkeypatch: pytest.MonkeyPatch) -> None:
    judged: list[float] = []
    violations = SampleCheck.violations

    def counting(judge: SampleCheck, t_s: float, *rest: Any) -> Any:
        judged.append(t_s)
        return violations(judge, t_s, *rest)

    monkeypatch.setattr(SampleCheck, "violations", counting)
    counts = []
    for repeat in (2, 1000):
        judged.clear()
        assert problems("catch", f"mission.repeat={repeat}") == []
        counts.append(len(judged))
        assert judged == sorted(judged)
    assert counts[0] == counts[1]


def test_what_is_wrong_only_from_the_second_repetition_on_is_reported() -> None:
    """The line to (-1, 0) is short from the start, and too long in its time from where the repetition ends."""
    phases = (
        "mission.phases=[{type: takeoff, height_m: 1, duration_s: 3}, {type: line, name: to, to_m: [-0.9, 0, 1], duration_s: 2}, "
        "{type: line, name: away, to_m: [1, 0, 1], duration_s: 8}, {type: land, speed_m_s: 0.35}]"
    )
    assert problems("catch", phases) == []
    found = problems("catch", phases, "mission.repeat=3")
    assert any("phase 'to (2 of 3)' flies too fast" in problem for problem in found)
    assert not any("(1 of 3)" in problem for problem in found)


def test_what_is_wrong_in_every_repetition_is_reported_once() -> None:
    told = problems("catch", "mission.repeat=9", "mission.phases[2].to_m=[1.9, 0, 1]")
    assert len(told) == len(problems("catch", "mission.phases[2].to_m=[1.9, 0, 1]"))
    [room] = [line for line in told if "leaves the room" in line]
    assert "phase 'catch (1 of 9)' leaves the room" in room
    assert room.endswith("(also in 'stabilise (1 of 9)', 'return (1 of 9)')")


def test_every_repetition_has_a_catch_of_its_own() -> None:
    """0.2 m off the plan are allowed for around each catch: the room's far end must leave them in the second one, too."""
    far_end = "vehicle.room.x_m=[-2.2, 1.58]"
    once, twice = problems("catch", far_end), problems("catch", far_end, "mission.repeat=2")
    assert len(once) == len(twice) == 1
    assert "0.2 m for the catch" in twice[0]


def test_a_tether_that_each_repetition_winds_up_a_little_is_refused() -> None:
    assert problems("circuit", *AROUND_THE_ANCHOR) == []
    [told] = problems("circuit", *AROUND_THE_ANCHOR, "vehicle.tether.turns_max=5", "mission.repeat=12")
    assert "its 12 repetitions wind up the tether: 12.0" in told
    assert problems("circuit", *AROUND_THE_ANCHOR, "vehicle.tether.turns_max=12.5", "mission.repeat=12") == []
    assert problems("circuit", "mission.repeat=1000") == [], "beside the anchor nothing is wound"


@pytest.mark.parametrize(("repeat", "words"), [(0, "1"), (1001, "1000"), ("often", "integer")])
def test_how_often_has_bounds(repeat: object, words: str) -> None:
    document = mission("catch").model_dump(mode="json")
    with pytest.raises(ValidationError, match=words):
        Mission.model_validate({**document, "repeat": repeat})


def test_with_nothing_in_between_there_is_nothing_to_repeat() -> None:
    document = mission("catch").model_dump(mode="json")
    document["phases"] = [document["phases"][0], document["phases"][-1]]
    assert Mission.model_validate(document).repeat == 1
    with pytest.raises(ValidationError, match="there is nothing between take-off and landing to repeat") as refused:
        Mission.model_validate({**document, "repeat": 2})
    assert refused.value.errors()[0]["loc"] == ("repeat",)


def test_a_path_that_begins_where_the_last_repetition_ended_is_refused() -> None:
    document = mission("circuit").model_dump(mode="json")
    document["phases"][2:4] = [{"type": "path", "waypoints_m": [[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.0, 1.0]]}]
    assert Mission.model_validate(document).repeat == 1
    with pytest.raises(ValidationError, match="repeats the previous point of the path") as refused:
        Mission.model_validate({**document, "repeat": 2})
    assert [error["loc"] for error in refused.value.errors()] == [("phases", 2, "waypoints_m", 0)]
