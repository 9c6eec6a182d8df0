"""Two vehicles and a bar in the fast loop: what happens to both when something happens to one."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import pytest
from msgspec.structs import replace

from companion.model.outputs import Outputs
from companion.model.team import Grip, TeamState
from companion.model.types import AutopilotRequest, OperatorCommand, Outcome, SafetyAction
from companion.model.verdict import Answer
from companion.sitl_config.team import load_team
from sitl.campaigns.flights import outcome_of
from sitl.campaigns.pair import down_s
from sitl.fast.result import FastResult
from sitl.fast.team import FastTeam, TeamResult
from tests.short_carry import SHORT_CARRY

Commands = Sequence[Mapping[float, OperatorCommand]]


@pytest.fixture(autouse=True)
def _short(short_start: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flight with faults that is ended in the air is not followed to the floor."""
    monkeypatch.setattr("sitl.fast.loop.SETTLE_S", 0.0)
    monkeypatch.setattr("companion.phases.carry.grip.SETTLE_S", 0.5)


def team_of(*overrides: str, commands: Commands = ({}, {})) -> FastTeam:
    return FastTeam(load_team("carry", [*SHORT_CARRY, *overrides], world="ideal"), commands)


def flown(*overrides: str, commands: Commands = ({}, {}), limit_s: float = 120.0) -> tuple[FastTeam, TeamResult]:
    team = team_of(*overrides, commands=commands)
    return team, team.run(limit_s)


def ids(result: FastResult) -> list[str]:
    return list(dict.fromkeys(event.id for outputs in result.outputs for event in outputs.events))


def outcomes(result: TeamResult) -> list[Outcome | None]:
    return [member.outputs[-1].outcome for member in result.members]


def assert_both_down_unharmed(team: FastTeam) -> None:
    for flight in team.flights:
        assert not flight.plant.machine.crashed
        assert not flight.px4.armed


def assert_both_have_let_go(team: FastTeam, result: TeamResult, height_m: float) -> None:
    """The flight is ended here: how it then lands is followed in the flight of a killed member."""
    for member, flight in zip(result.members, team.flights, strict=True):
        assert "bar_let_go" in ids(member)
        assert member.outputs[-1].action is SafetyAction.LAND
        assert not flight.plant.machine.crashed
    assert team.scene.bar is not None
    assert team.scene.bar.let_go_m == pytest.approx(0.0, abs=height_m)


@functools.cache
def held() -> tuple[FastTeam, TeamResult]:
    """A flight of both with a hold of each on the way: the right one holds because the left one does, and then by its own command. Then
    the right one's force sensor falls silent.
    """
    hold, resume = OperatorCommand.HOLD, OperatorCommand.RESUME
    return flown(
        "right.world.faults=[{kind: force_loss, t_s: 14.5}]",
        commands=({11.5: hold, 12.1: resume}, {11.8: hold, 12.6: resume}),
    )


def times(member: FastResult, grip: Grip) -> list[float]:
    return [o.t_s for o in member.outputs if o.team is not None and o.team.grip is grip]


def test_both_lift_carry_set_down_and_land() -> None:
    team, result = held()
    assert outcomes(result) == [Outcome.COMPLETED, Outcome.COMPLETED]
    for member in result.members:
        steps = ["takeoff", "gripped", "released", "touchdown"]
        assert [one for one in ids(member) if one in steps] == steps
    assert result.truth is not None
    figures = result.truth.report()
    assert figures["bar_p_rms_m"] is not None
    assert figures["bar_p_rms_m"] < 0.04
    assert figures["share"] == pytest.approx(0.5, abs=0.05)
    assert figures["let_go"] == pytest.approx(0.0, abs=0.02)
    left, right = (times(member, Grip.CARRYING) for member in result.members)
    assert abs(left[0] - right[0]) <= 0.0051
    assert_both_down_unharmed(team)


def test_without_the_force_of_one_the_bar_is_carried_on_and_its_pull_is_not_taken_for_the_tethers() -> None:
    _, result = held()
    right = result.members[1]
    assert "force_lost" in ids(right) and not {"bar_lost", "partner_lands", "tether_snagged"} & set(ids(right))
    lost_s = next(event.t_s for o in right.outputs for event in o.events if event.id == "force_lost")
    carried = [o for o in right.outputs if o.team is not None and o.team.grip is Grip.CARRYING]
    pulls_s = [o.t_s for o in carried if o.tether is not None and o.tether.pull_n > 0.0]
    assert carried[0].t_s < pulls_s[0] and pulls_s[-1] <= lost_s < carried[-1].t_s - 0.2


def test_a_hold_of_both_ends_at_one_instant_once_each_that_was_commanded_is_resumed() -> None:
    """To resume the left one is not enough."""
    _, result = held()
    assert [o.verdict.answer for o in result.members[0].outputs if o.verdict is not None] == [
        Answer.HOLDING,
        Answer.CONTINUING_TOGETHER,
    ]
    assert "partner_holds" in ids(result.members[1])
    went_on = [[e.t_s for o in member.outputs for e in o.events if e.id == "goes_on"] for member in result.members]
    assert [len(instants) for instants in went_on] == [1, 1]
    assert went_on[0][0] > 12.6
    assert abs(went_on[0][0] - went_on[1][0]) <= 0.0051
    left, right = (times(member, Grip.STANDING) for member in result.members)
    assert abs(left[0] - right[0]) <= 0.0051, "both have continued at one place of their plans"


def test_members_that_are_far_apart_in_their_plans_do_not_continue_but_set_the_bar_down_when_the_hold_expires() -> None:
    """What the left one announces is 5 s ahead: followed, the right one would leave its end of the bar."""
    commands: Commands = ({10.8: OperatorCommand.HOLD, 11.1: OperatorCommand.RESUME}, {})
    team = team_of("vehicle.safety.hold_max_s=1.2", commands=commands)
    left = team.flights[0]
    announced = left.announced

    def ahead(outputs: Outputs | None) -> TeamState | None:
        said = announced(outputs)
        if said is None:
            return None
        return replace(said, together=replace(said.together, plan_s=said.together.plan_s + 5.0))

    left.announced = ahead  # type: ignore[method-assign]
    result = team.run(15.1)
    for member in result.members:
        assert "goes_on" not in ids(member)
    assert "hold_expired" in ids(result.members[0])
    assert "partner_lands" in ids(result.members[1])
    assert_both_have_let_go(team, result, 0.03)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"agreed": "of other files"}, "the other vehicle flies another mission"),
        ({"system_id": 1}, "PX4 of the other vehicle has MAV_SYS_ID 1, too"),
        ({"server_s": 1000.0}, "motion capture's clock shows"),
    ],
    ids=["another version of the mission", "the same system id", "another server"],
)
def test_with_a_member_that_does_not_go_with_it_a_vehicle_arms_nothing(
    changed: dict[str, object], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How long it waits: tests/core/test_sequence.py."""
    monkeypatch.setattr("companion.model.flight_stage.WAIT_TIMEOUT_S", 1.0)
    team = team_of()
    right = team.flights[1]
    announced = right.announced

    def other(outputs: Outputs | None) -> TeamState | None:
        said = announced(outputs)
        return None if said is None else replace(said, **changed)

    right.announced = other  # type: ignore[method-assign]
    left = team.run(2.0).members[0]
    (refused,) = [event.text for outputs in left.outputs for event in outputs.events if event.id == "start_refused"]
    assert text in refused
    assert left.outputs[-1].outcome is Outcome.REFUSED
    assert not any(outputs.request is AutopilotRequest.ARM for outputs in left.outputs)


@functools.cache
def retried() -> tuple[FastTeam, TeamResult]:
    """The bar's body is said to be 6 cm beside where it is; the first of the places that are searched is 4 cm ahead. A warning before
    that, here of a full disk, stops nothing. Soon after the bar has left its feet the right one's process is killed.
    """
    disk_full = "left.world.faults=[{kind: disk_full, t_s: 3.0}]"
    killed = "right.world.faults=[{kind: kill_flight, after: lift, t_s: 0.2}]"
    return flown("left.world.bar={pivot_offset_m: [0.06, 0.0, 0.0]}", disk_full, killed)


def test_jaws_that_close_beside_the_handle_try_again_beside_it() -> None:
    _, result = retried()
    assert {"recorder_drops", "gripped_nothing"} <= set(ids(result.members[0]))
    assert all(times(member, Grip.CARRYING) for member in result.members)


def test_a_member_whose_process_is_killed_brings_both_down() -> None:
    team, result = retried()
    left, right = result.members
    assert right.guardian_landed
    assert {"partner_lands", "bar_let_go"} <= set(ids(left))
    assert left.outputs[-1].outcome is outcome_of(right) is Outcome.ABORTED
    assert_both_down_unharmed(team)
    assert team.scene.bar is not None
    assert team.scene.bar.lifted_s is not None
    assert team.flights[1].faults.begun_s == pytest.approx(team.scene.bar.lifted_s + 0.2, abs=0.005)
    (touchdown_s,) = [event.t_s for outputs in left.outputs for event in outputs.events if event.id == "touchdown"]
    disk_full_s = team.flights[0].faults.begun_s
    assert disk_full_s is not None
    assert down_s(team, result) == pytest.approx(touchdown_s - disk_full_s, abs=1.0)


def test_a_member_that_px4_lands_blindly_is_not_waited_for_and_does_not_descend_into_its_handle() -> None:
    team, result = flown("right.world.faults=[{kind: mocap_occluded, t_s: 9.3}]")
    left, right = result.members
    assert {"mocap_invalid", "bar_let_go"} <= set(ids(right))
    (holds_s, lands_s) = (
        next(e.t_s for o in left.outputs for e in o.events if e.id == name)
        for name in ("partner_holds", "partner_lands")
    )
    assert lands_s == holds_s
    assert_both_down_unharmed(team)


def test_a_clamp_whose_servo_shuts_down_in_the_air_lands_both_and_the_bar_is_set_down() -> None:
    team, result = flown("left.world.faults=[{kind: clamp_overload, t_s: 11.3}]")
    left, right = result.members
    assert ids(left)[2] == "clamp_error"
    assert ids(right)[2:4] == ["partner_holds", "partner_lands"]
    assert outcomes(result) == [Outcome.ABORTED, Outcome.ABORTED]
    assert_both_down_unharmed(team)
    assert team.scene.bar is not None
    assert team.scene.bar.let_go_m == pytest.approx(0.0, abs=0.02)


def test_a_bar_too_far_from_its_place_is_not_gripped_and_both_land_beside_it() -> None:
    team, result = flown("mission.phases[1].wait_max_s=1.5", "left.world.bar={pivot_offset_m: [0.3, 0.0, 0.0]}")
    assert [ids(member) for member in result.members] == 2 * [["takeoff", "not_gripped", "touchdown"]]
    assert outcomes(result) == [Outcome.ABORTED, Outcome.ABORTED]
    assert_both_down_unharmed(team)
    for member in result.members:
        assert abs(member.truth[-1].position_world_m[1]) > 1.2, "away from the ends of the bar at 0.6"


def test_a_bar_that_tilts_stops_both() -> None:
    """The right one's battery sags until its rotors carry it no more: before one of the two notices anything else, both hold."""
    sags = "right.world.faults=[{kind: battery_sag, t_s: 9.3, duration_s: 3.0, size: 4.0}]"
    team, result = flown(sags, limit_s=13.3)
    for member in result.members:
        assert ids(member)[2] == "bar_tilted"
    assert_both_have_let_go(team, result, 0.1)


def test_a_link_that_gets_later_and_later_lands_both() -> None:
    """They keep arriving: only the clock that both share shows how old they are. A silent link: tests/safety/test_rules.py."""
    config = load_team("carry", SHORT_CARRY, world="ideal")
    team = FastTeam(config, link_delay_s=lambda t_s: 0.002 if t_s <= 10.8 else 0.5 * (t_s - 10.8))
    result = team.run(14.6)
    for member in result.members:
        assert ids(member)[2] == "partner_late"
    assert_both_have_let_go(team, result, 0.1)
