"""What a command does and what is said of it, flown: hold, resume, land, abort and start in every stage. Fast closed loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import msgspec
import pytest

from companion.config.loader import load_flight
from companion.core.transition import Parameters
from companion.core.verdict import sentence_of, verdict_of
from companion.model.flight_stage import Stage
from companion.model.outputs import Outputs
from companion.model.types import FlightMode, Inputs, OperatorCommand, Outcome, SafetyAction
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from tests.flights.ends import Changed, flown_until
from tests.flights.test_ladder_flights import TAUT
from tests.safety.healthy import put
from tests.support import HOVER, LOW_HOVER

pytestmark = pytest.mark.usefixtures("short_start")

HOLD, RESUME, LAND, ABORT, START = (
    OperatorCommand.HOLD,
    OperatorCommand.RESUME,
    OperatorCommand.LAND,
    OperatorCommand.ABORT,
    OperatorCommand.START,
)
Change = Callable[[Inputs], Inputs]
Script = Sequence[tuple[float, OperatorCommand]]


@dataclass
class Commanded:
    """A flight with commands of one tick each, and what was said of them."""

    inputs: list[Inputs]
    outputs: list[Outputs]
    flight: FastFlight
    effects: list[tuple[bool, str]] = field(default_factory=list)

    @property
    def ids(self) -> list[str]:
        return [event.id for o in self.outputs for event in o.events]

    @property
    def outcome(self) -> Outcome | None:
        return self.outputs[-1].outcome

    def at(self, t_s: float) -> Outputs:
        return next(o for o in self.outputs if o.t_s >= t_s)


class _Asking(Changed):
    def __init__(self, script: Script, change: Change, *overrides: str) -> None:
        super().__init__(load_sitl("configs/missions/hover.yaml", overrides=overrides), change)
        self._script = list(script)

    def _inputs(self, tick: int) -> Inputs:
        i = super()._inputs(tick)
        if self._script and i.t_s >= self._script[0][0]:
            return msgspec.structs.replace(i, command=self._script.pop(0)[1])
        return i


def commanded(
    *script: tuple[float, OperatorCommand],
    change: Change = lambda i: i,
    sets: Sequence[str] = (),
    until_s: float = 60.0,
) -> Commanded:
    flight = _Asking(script, change, *sets)
    result = flown_until(flight, lambda o: o.t_s >= until_s or o.outcome is not None)
    assert not result.crashed
    flown = Commanded(result.inputs, result.outputs, flight)
    for k, i in enumerate(result.inputs):
        if i.command is not OperatorCommand.NONE:
            verdict = result.outputs[k].verdict
            assert verdict is not None
            flown.effects.append((verdict.accepted, sentence_of(verdict, i.command)))
    assert len(flown.effects) == len(script), "the flight was over before a command came"
    return flown


@cache
def ordinary() -> Commanded:
    """A low flight without a command."""
    return commanded(sets=LOW)


def off_its_way(since_s: float, until_s: float, x_m: float = 0.65) -> Change:
    """PX4 and motion capture both have the vehicle elsewhere: off its reference, by their word."""

    def change(i: Inputs) -> Inputs:
        if i.vehicle is None or i.mocap is None or not since_s <= i.t_s < until_s:
            return i
        (x, y, z), (a, b, c) = i.vehicle.position_world_m, i.mocap.position_world_m
        i = put("vehicle", position_world_m=(x + x_m, y, z))(i)
        return put("mocap", position_world_m=(a + x_m, b, c))(i)

    return change


# -- hold, resume, land ----------------------------------------------------------------------------------------------


def test_hold_resume_hold_resume_land() -> None:
    first = ((5.0, HOLD), (6.0, HOLD), (7.0, RESUME), (7.5, RESUME), (7.8, HOLD), (8.3, RESUME))
    flown = commanded(*first, (9.0, LAND), (9.5, LAND), (9.7, HOLD), (9.9, RESUME), (10.1, START), until_s=10.2)
    assert flown.effects == [
        (True, "holding"),
        (True, "already holding"),
        (True, "continuing"),
        (False, "resume refused: not holding"),
        (True, "holding"),
        (True, "continuing"),
        (True, "landing"),
        (True, "already landing"),
        (False, "hold refused: the vehicle is landing"),
        (False, "resume refused: the vehicle is landing"),
        (False, "start refused: already in the air"),
    ]
    asked = [id_ for id_ in flown.ids if id_.startswith("operator_")]
    assert asked == [
        *("operator_hold", "operator_hold", "operator_resume", "operator_resume", "operator_hold", "operator_resume"),
        *("operator_land", "operator_land", "operator_hold", "operator_resume", "operator_start"),
    ]
    assert flown.outputs[-1].action is SafetyAction.LAND


def test_a_hold_that_nobody_may_end_yet() -> None:
    """Off its reference: held by the monitor; going on is refused until that has been gone for a second."""
    script, change = ((5.5, RESUME), (6.0, RESUME), (6.7, RESUME)), off_its_way(5.0, 5.3, 0.7)
    flown = commanded(*script, change=change, sets=FORGIVING, until_s=7.0)
    for accepted, text in flown.effects[:2]:
        assert not accepted
        assert text.startswith("resume refused: 0.")
        assert text.endswith("m off the reference (limit 0.60 m)")
    assert flown.effects[2] == (True, "continuing")
    assert [id_ for id_ in flown.ids if id_ in ("tracking_hold", "resume_refused")] == [
        *("tracking_hold", "resume_refused", "resume_refused")
    ]
    assert {flown.at(t_s).action for t_s in (5.52, 6.02)} == {SafetyAction.HOLD}
    assert flown.at(6.72).action is SafetyAction.NOMINAL


def test_a_resume_while_a_cause_stands_that_came_during_the_hold_is_refused() -> None:
    change = off_its_way(7.2, 99.0, 0.7)
    flown = commanded((6.7, HOLD), (8.2, RESUME), change=change, sets=FORGIVING, until_s=8.8)
    assert flown.effects[0] == (True, "holding")
    assert flown.effects[1][1].startswith("resume refused: ")
    assert flown.at(8.7).action is SafetyAction.HOLD


# A jump of pose and estimate together is no finding of the ones that watch for jumps; 0.8 m off would be a landing.
FORGIVING = (
    "vehicle.safety.mocap_jump_m=2.0",
    "vehicle.safety.mocap_inertial_m=2.0",
    "vehicle.safety.tracking_error_abort_m=5",
    "vehicle.safety.hold_max_s=6",
)


def test_commands_while_it_goes_back_along_the_tether() -> None:
    flown = commanded(
        (7.2, HOLD), (7.3, RESUME), (7.5, LAND), sets=(*TAUT, "vehicle.safety.retract_max_s=20"), until_s=8.2
    )
    assert flown.effects[:2] == [
        (False, "hold refused: the vehicle is returning along the tether and will land"),
        (False, "resume refused: the vehicle is returning along the tether and will land"),
    ]
    assert flown.effects[2] == (True, "landing")


def test_too_low_to_hold() -> None:
    flown = commanded((4.1, HOLD), until_s=4.7)
    assert flown.effects == [(True, "too low to hold: landing")]


def test_nothing_is_done_against_a_pilot() -> None:
    def change(i: Inputs) -> Inputs:
        return put("status", mode=FlightMode.MANUAL)(i) if i.t_s >= 4.0 else i

    flown = commanded((4.2, HOLD), (4.3, RESUME), (4.4, LAND), (4.5, ABORT), (4.6, START), change=change, until_s=4.7)
    assert flown.effects == [
        (False, f"{name} refused: a pilot has control; nothing is sent")
        for name in ("hold", "resume", "land", "abort", "start")
    ]
    assert flown.at(4.2).phase == "a pilot flies"
    assert all(o.attitude is None for o in flown.outputs if o.t_s > 4.1)


def test_commands_while_px4_lands_on_its_own() -> None:
    blind = ("world.faults=[{kind: mocap_loss, t_s: 3.7}]",)
    flown = commanded((5.2, LAND), (5.3, ABORT), (5.4, HOLD), (5.5, RESUME), (5.6, START), sets=blind, until_s=5.8)
    assert flown.effects[:2] == [(True, "recorded; PX4's own landing continues")] * 2
    assert [accepted for accepted, _ in flown.effects[2:]] == [False, False, False]
    assert all("PX4 is landing on its own" in text for _, text in flown.effects[2:])


# -- before take-off -------------------------------------------------------------------------------------------------

WAITS = ("mission.start.takeoff=by_operator",)
LOW = tuple(f"{key}={value}" for key, value in LOW_HOVER.items())


def times_of(flown: Commanded) -> dict[str, float]:
    """When each phase begins."""
    found: dict[str, float] = {}
    for o in flown.outputs:
        found.setdefault(o.phase, o.t_s)
    return found


ARMING = (
    "not taking off: the start is cancelled; PX4 was asked to arm: its rotors may start until it is disarmed, keep away"
)


@pytest.mark.parametrize(
    ("phase", "command", "text"),
    [
        ("wait", HOLD, "not taking off: the start is cancelled"),
        ("offboard", LAND, "not taking off: the start is cancelled"),
        ("arm", ABORT, ARMING),
        ("spool up", LAND, "not taking off: the rotors are spooling down"),
    ],
)
def test_called_off_before_it_lifts(phase: str, command: OperatorCommand, text: str) -> None:
    begin_s = times_of(ordinary())[phase]
    flown = commanded((begin_s + 0.004, command))
    assert flown.effects == [(True, text)]
    assert flown.outcome is Outcome.ABORTED
    stays = [event.text for o in flown.outputs for event in o.events if "stays on the ground" in event.text]
    assert not stays or phase in ("wait", "offboard"), "the rotors may start after it is said"
    assert "takeoff" not in flown.ids
    assert not flown.flight.px4.armed


@pytest.mark.parametrize(("phase", "late_s"), [("spool up", 0.045), ("take-off", 0.025)])
def test_no_command_to_land_makes_the_rotors_surge(phase: str, late_s: float) -> None:
    begin_s = times_of(ordinary())[phase] + late_s
    flown = commanded((begin_s, LAND), until_s=begin_s + 0.5)
    thrust = [o.attitude.thrust for o in flown.outputs if o.attitude is not None]
    steps = [after - before for before, after in itertools.pairwise(thrust)]
    assert max(steps) < 0.02, "more than spooling up adds in a tick"
    assert [accepted for accepted, _ in flown.effects] == [True]


def test_a_flight_that_takes_off_by_itself_needs_no_start() -> None:
    phases = times_of(ordinary())
    begin_s = [phases[phase] for phase in ("wait", "offboard", "arm", "spool up")]
    flown = commanded(
        *((t_s + late_s, command) for t_s in begin_s for late_s, command in ((0.004, START), (0.104, RESUME))),
        sets=LOW,
        until_s=begin_s[-1] + 0.3,
    )
    assert flown.effects[0::2] == [
        (False, "start refused: this flight takes off by itself as soon as it is ready"),
        *[(True, "already taking off")] * 3,
    ]
    assert flown.effects[1::2] == [(False, "resume refused: on the ground")] * 4


def test_it_waits_for_start_with_nothing_sent_and_then_flies() -> None:
    lands_s = times_of(ordinary())["land"] + 3.0  # PX4's heartbeats come once a second
    flown = commanded((2.0, HOLD), (3.0, START), (lands_s + 0.2, HOLD), (lands_s + 0.4, RESUME), sets=(*WAITS, *LOW))
    assert flown.effects == [
        (True, "the vehicle stays on the ground until start is commanded"),
        (True, "taking off"),
        (False, "hold refused: the vehicle is landing"),
        (True, "the landing continues"),
    ]
    waiting = [o for o in flown.outputs if o.phase == "waits for start"]
    assert waiting[-1].t_s - waiting[0].t_s > 1.0
    assert all(o.attitude is None and o.arm_torque_nm is None and o.request.value == "none" for o in waiting)
    assert flown.outcome is Outcome.COMPLETED
    assert [id_ for id_ in flown.ids if id_ != "catch"] == [
        *("operator_start", "takeoff", "operator_hold", "operator_resume", "touchdown")
    ]


@pytest.mark.parametrize("command", [LAND, ABORT])
def test_it_waits_for_start_and_stands_down_on_command(command: OperatorCommand) -> None:
    flown = commanded((2.5, command), sets=WAITS)
    assert flown.effects == [(True, "not taking off: the start is cancelled")]
    assert flown.outcome is Outcome.ABORTED
    assert flown.outputs[-1].t_s < 2.6


def test_what_is_lost_while_it_waits_is_reported_and_may_come_back_at_any_time() -> None:
    """It is carried half a metre away and back."""
    change = off_its_way(3.0, 5.0, 0.5)
    flown = commanded((4.5, START), (8.0, START), change=change, sets=(*WAITS, *FORGIVING, *LOW), until_s=12.5)
    assert flown.effects[0][0] is False
    assert "start refused: mission 'hover': starts at" in flown.effects[0][1]
    assert flown.effects[1] == (True, "taking off")
    assert [id_ for id_ in flown.ids if id_.startswith("operator_") or "ready" in id_ or "declined" in id_] == [
        *("not_ready", "operator_start", "start_declined", "operator_start")
    ]
    assert flown.at(4.8).phase == "wait"
    assert flown.at(7.8).phase == "waits for start" and "takeoff" in flown.ids


def test_an_estimate_that_wanders_off_while_it_waits_is_reported() -> None:
    def change(i: Inputs) -> Inputs:
        if i.vehicle is None or not 3.0 <= i.t_s < 5.0:
            return i
        x, y, z = i.vehicle.position_world_m
        return put("vehicle", position_world_m=(x + 0.07, y, z))(i)

    flown = commanded((4.8, START), (8.0, START), change=change, sets=WAITS, until_s=8.2)
    assert flown.effects[0][0] is False
    assert flown.effects[0][1].startswith("start refused: PX4's estimate has not settled")
    assert flown.effects[1] == (True, "taking off")


def test_a_start_that_comes_before_it_is_ready_is_refused_and_not_remembered() -> None:
    flown = commanded((0.55, START), (3.0, START), (3.5, START), sets=WAITS, until_s=3.6)
    assert flown.effects[0][0] is False
    assert flown.effects[0][1].startswith("start refused: ")
    assert flown.at(2.9).phase == "waits for start"
    assert flown.effects[1:] == [(True, "taking off"), (True, "already taking off")]


def test_the_net_is_weighed_right_before_the_start() -> None:
    """The sensor drifts by 2 N while it waits: a tare of before would feel that."""

    def change(i: Inputs) -> Inputs:
        if i.force is None:
            return i
        drift_n = 2.0 * min(1.0, i.t_s / 3.0)
        x, y, z = i.force.force_sensor_n
        return put("force", force_sensor_n=(x + drift_n, y, z))(i)

    flown = commanded((4.5, START), change=change, sets=(*WAITS, *LOW), until_s=9.8)
    felt = [o.control.force_ext_world_n for o in flown.outputs if o.control is not None and o.phase == "hold"]
    assert felt
    assert max(math.hypot(*force_n) for force_n in felt) < 0.6


def test_the_plan_begins_where_it_stands_at_the_start() -> None:
    """It was pushed 5 cm aside while it waited: within the tolerance, so it goes up from there."""
    flown = commanded((4.5, START), change=off_its_way(2.5, 9.0, 0.05), sets=(*WAITS, *FORGIVING), until_s=8.0)
    spooled = next(o for o in flown.outputs if o.phase == "spool up" and o.reference is not None)
    at_start = next(i for i in flown.inputs if i.command is START)
    assert spooled.reference is not None and at_start.vehicle is not None
    assert math.dist(spooled.reference.position_world_m, at_start.vehicle.position_world_m) < 1e-9


def test_a_finding_of_the_ground_refuses_it_while_it_waits() -> None:
    def change(i: Inputs) -> Inputs:
        return put("status", battery_remaining=0.1)(i) if i.t_s > 2.5 else i

    flown = commanded(change=change, sets=WAITS)
    assert flown.ids == ["battery_warn", "battery_low"] or flown.ids == ["battery_low", "battery_warn"]
    assert flown.outcome is Outcome.REFUSED


def test_armed_by_somebody_else_while_it_waits_it_is_not_flown() -> None:
    def change(i: Inputs) -> Inputs:
        return put("status", armed=True, mode=FlightMode.OFFBOARD)(i) if 2.5 < i.t_s < 3.5 else i

    flown = commanded(change=change, sets=WAITS)
    assert flown.ids == ["armed_externally"]
    assert flown.outcome is Outcome.REFUSED


def test_after_the_flight_nothing_is_to_be_done() -> None:
    over = msgspec.structs.replace(Parameters.of(load_flight(HOVER)).initial_state(), stage=Stage.DONE)
    verdicts = [(command, verdict_of(command, over, over, (), 0.0)) for command in (LAND, HOLD, RESUME, START)]
    assert [(verdict.accepted, sentence_of(verdict, command)) for command, verdict in verdicts] == [
        (True, "already down"),
        (False, "hold refused: the flight is over"),
        (False, "resume refused: the flight is over"),
        (False, "start refused: the flight is over"),
    ]
