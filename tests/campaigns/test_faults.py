"""How a flight with a fault is judged, on flights made up for it."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from companion.campaigns.faults.judge import FaultFlight, Point, Tick, good, row_of
from companion.campaigns.faults.sitl_flights import _offset_s
from companion.campaigns.faults.sitl_flights import flown as flown_over_wires
from companion.campaigns.faults.variants import CHOSEN, CONTACT, VARIANTS, Variant, planned
from companion.cli.main import main
from companion.launcher.launcher import FlightResult
from companion.launcher.run import summary_of
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.model.types import Event, Inputs, OperatorCommand, Outcome, PhaseKind, SafetyAction, Severity, Vec3
from companion.safety.notices import NOTICES
from companion.safety.rules import RULES
from companion.sitl_config.faults import CONTACT_PHASES, KINDS, PHASES
from companion.sitl_config.loader import load_sitl
from tests.campaigns.made_up import fault_row
from tests.support import CATCH, level_pose
from tools.docs.faults import outcomes_markdown

VEHICLE = load_sitl(CATCH).vehicle
STANDING_M = VEHICLE.airframe.ground_clearance_m
LOST = Variant("mocap_loss")


def event(t_s: float, event_id: str, action: SafetyAction) -> Event:
    return Event(t_s=t_s, id=event_id, severity=Severity.CRITICAL, action=action, text=event_id)


def flight(
    *,
    outcome: str = "aborted",
    landed: bool = True,
    at: Vec3 = (0.0, 0.0, 1.0),
    drift_m: float = 0.0,
    sink_m_s: float = 0.5,
    tension_n: float = 0.0,
    slack_m: float = 1.2,
    events: tuple[Event, ...] = (event(10.12, "mocap_lost", SafetyAction.AUTOPILOT_LAND),),
    begun_s: float | None = 10.0,
    error: str | None = None,
) -> FaultFlight:
    """A fault at 10 s; 1 s later it sinks, and drifts sideways while it does."""
    x, y, z = at
    course = []
    for k in range(900):
        t_s = 8.0 + 0.01 * k
        sunk_m = min(z - STANDING_M, max(0.0, t_s - 11.0) * sink_m_s)
        sideways = drift_m * min(1.0, max(0.0, t_s - 10.5))
        course.append(
            Point(
                t_s=t_s,
                position_world_m=(x + sideways, y, z - sunk_m),
                tilt_rad=0.1,
                slack_m=slack_m,
                tension_n=tension_n if t_s > 12.0 else 0.0,
            )
        )
    ticks = [
        Tick(p.t_s, PhaseKind.FLIGHT, SafetyAction.NOMINAL if p.t_s < 10.12 else SafetyAction.AUTOPILOT_LAND, at)
        for p in course
    ]
    return FaultFlight(
        outcome=outcome,
        begun_s=begun_s,
        course=course,
        ticks=ticks,
        events=events,
        landed=landed,
        caught=False,
        error=error,
    )


def test_a_flight_that_was_given_up_and_stands_has_landed() -> None:
    row = row_of(LOST, "line", flight(drift_m=0.25), VEHICLE)
    assert row["outcome"] == "landed"
    assert row["detected_s"] == pytest.approx(0.12)
    assert row["reacted_s"] == pytest.approx(0.12)
    assert row["event"] == "mocap_lost"
    assert row["action"] == "autopilot_land"
    assert row["drift_m"] == pytest.approx(0.25, abs=0.01)
    assert row["min_height_m"] == 1.0
    assert row["worst_tilt_deg"] == pytest.approx(5.73, abs=0.01)
    assert row["min_slack_m"] == 1.2
    assert list(row) == list(fault_row({"kind": "mocap_loss", "phase": "line", "size": None, "duration_s": None}))
    assert good(row)


@pytest.mark.parametrize(
    ("made", "problem"),
    [
        (flight(landed=False), "aborted"),
        (flight(outcome="lost"), "lost"),
        (flight(sink_m_s=2.5), "crashed"),
        (flight(tension_n=20.0), "pulled its tether taut by its own motion"),
        (flight(at=(1.9, 0.0, 1.0)), "left the geofence"),
        (flight(begun_s=None), "the fault never began"),
        (flight(outcome="lost", error="ZeroDivisionError: x"), "internal error"),
    ],
)
def test_a_violated_safety_requirement_is_a_problem(made: FaultFlight, problem: str) -> None:
    row = row_of(LOST, "line", made, VEHICLE)
    assert problem in row["problems"]
    assert not good(row)


def test_refused_on_the_ground_is_well() -> None:
    row = row_of(Variant("arming_refused"), "ground", flight(outcome="refused", events=()), VEHICLE)
    assert good(row)
    assert row["drift_m"] is None


def test_a_tether_that_was_made_taut_may_be_so_but_not_be_followed_outward() -> None:
    taut = event(10.5, "tether_taut", SafetyAction.RETRACT)
    assert good(row_of(Variant("tether_taut", 0.1), "line", flight(tension_n=20.0, events=(taut,)), VEHICLE))
    made = flight(tension_n=20.0, events=(taut,))
    outward = [dataclasses.replace(p, slack_m=(p.slack_m or 0.0) - (0.3 if p.t_s > 12.5 else 0.0)) for p in made.course]
    row = row_of(Variant("tether_taut", 0.1), "line", dataclasses.replace(made, course=outward), VEHICLE)
    assert row["problems"] == ["moved outward on a taut tether"]


def test_what_is_reported_after_the_landing_is_no_answer() -> None:
    made = flight(outcome="completed", events=(event(16.5, "force_lost", SafetyAction.LAND),))
    ticks = [Tick(t.t_s, t.kind if t.t_s < 16.0 else PhaseKind.DONE, SafetyAction.NOMINAL, None) for t in made.ticks]
    row = row_of(Variant("force_loss"), "line", dataclasses.replace(made, ticks=ticks, caught=True), VEHICLE)
    assert (row["action"], row["event"], row["reacted_s"]) == ("nominal", None, None)


def test_the_table_of_kinds_names_events_that_exist() -> None:
    known = {rule.id for rule in RULES} | {"guardian_took_over", "offboard_refused", "arming_refused"}
    known |= {notice.id for notice in NOTICES}
    assert {name for kind in KINDS.values() for name in kind.named_by} - known == set()


def test_the_campaign_flies_every_kind_of_fault_with_a_size_where_it_has_one() -> None:
    assert len(set(VARIANTS)) == len(VARIANTS)
    assert {variant.kind for variant in (*VARIANTS, *CONTACT)} == set(KINDS)
    assert {variant.kind for variant in CHOSEN} < set(KINDS)
    for variant in (*VARIANTS, *CONTACT):
        assert (variant.size is not None) == (KINDS[variant.kind].size is not None), variant


def test_the_chosen_kinds_and_phases_are_flown() -> None:
    assert {variant.kind for variant, _ in planned(["gust"], [])} == {"gust"}
    assert {phase for _, phase in planned([], ["line"])} == {"line"}
    assert planned(["autopilot_reboot"], []) == [(Variant("autopilot_reboot", 2.0), "ground")]
    assert planned(["autopilot_reboot"], ["line"]) == [(Variant("autopilot_reboot", 2.0), "line")]
    assert {phase for _, phase in planned([], [])} == set(PHASES)
    assert len(planned([], CONTACT_PHASES)) == len(CONTACT) * len(CONTACT_PHASES)
    assert planned([], ["press"], wires=True) == [(Variant("kill_flight"), "press")]


def test_phases_of_a_contact_are_not_mixed_with_others(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "--phases", "line,press"]) == EXIT_BAD_INPUT
    assert "fly two campaigns" in capsys.readouterr().err


def test_a_force_above_the_limit_for_0_1_s_is_a_problem_and_a_spike_is_not() -> None:
    made, limit_n = flight(), VEHICLE.safety.contact_force_max_n
    for lasting_s, problems in ((0.03, []), (0.2, [f"pressed with {2.0 * limit_n:.1f} N (limit {limit_n:g} N)"])):
        course = [
            dataclasses.replace(p, contact_n=2.0 * limit_n if 12.0 <= p.t_s < 12.0 + lasting_s else 0.0)
            for p in made.course
        ]
        row = row_of(LOST, "press", dataclasses.replace(made, course=course), VEHICLE)
        assert row["problems"] == problems


def test_the_page_of_the_docs_shows_the_outcome_of_each_phase() -> None:
    rows = [row_of(LOST, "line", flight(), VEHICLE), row_of(LOST, "return", flight(landed=False), VEHICLE)]
    last = outcomes_markdown(rows).splitlines()[-1]
    assert last.startswith("| `mocap_loss` |  | landed 0.12 | **aborted** 0.12 |")


# -- over wires --------------------------------------------------------------------------------------------------------


def test_a_flight_without_files_is_lost_with_the_reason(tmp_path: Path) -> None:
    found = flown_over_wires(tmp_path, load_sitl(CATCH))
    assert found.outcome == "lost"
    assert "summary.json" in str(found.error)


def pose(frame: int, stamp_s: float) -> Inputs:
    seen = level_pose(stamp_s, frame_number=frame)
    return Inputs(tick=frame, t_s=stamp_s, mocap=seen, command=OperatorCommand.NONE, recorder_dropped=0)


def test_clocks_are_compared_at_the_frame_nearest_to_the_fault_that_both_logs_have() -> None:
    inputs = [pose(n, 100.0 + 0.005 * n) for n in range(400, 1000) if n % 7]
    frames = [(200, 1.0), (600, 3.0), (903, 4.5), (1100, 5.5)]
    assert _offset_s(inputs, frames, 5.4) == pytest.approx(100.0 + 0.005 * 904 - 4.5), (
        "903 is not in the log, the next one is"
    )
    assert _offset_s(inputs, frames, 2.0) == pytest.approx(100.0)
    assert _offset_s([], frames, 2.0) == 0.0


def test_what_a_dead_recorder_did_not_log_is_in_the_summary_all_the_same(tmp_path: Path) -> None:
    told = {
        "t_s": 9.1,
        "mission_t_s": 4.1,
        "id": "recorder_drops",
        "severity": "warning",
        "action": "warn",
        "text": "x",
    }
    _, made = summary_of(load_sitl(CATCH), FlightResult(Outcome.COMPLETED, events=(told,)), tmp_path, None)
    assert made["events"] == [told]


# -- command line ------------------------------------------------------------------------------------------------------


def test_the_list_names_every_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "--list", "--json"]) == EXIT_OK
    listed: list[dict[str, Any]] = json.loads(capsys.readouterr().out)
    assert [kind["kind"] for kind in listed] == list(KINDS)
    assert main(["faults", "--list"]) == EXIT_OK
    shown = capsys.readouterr().out
    assert all(kind in shown for kind in KINDS)


def test_faults_of_an_absent_part_are_not_flown(capsys: pytest.CaptureFixture[str]) -> None:
    only = ["--kinds", "tether_cut,force_loss", "--set", "vehicle.tether=null", "--set", "vehicle.devices.force=null"]
    assert main(["faults", str(CATCH), *only]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert "not flown, because the vehicle has no devices.force and tether: " in line
    assert all(kind in line for kind in ("tether_cut", "force_loss"))
