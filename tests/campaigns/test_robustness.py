"""Random draws added up, ranked, named, and kept as cases."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from companion.campaigns.robustness.cases import Cases, Kept, as_cases, fly_command, read_cases, worse_than, write_cases
from companion.campaigns.robustness.draws import influence, sensor_of, thirds, worst
from companion.campaigns.robustness.plots import write_distribution
from companion.campaigns.runner import Row
from companion.config.document import ConfigError
from companion.model.types import Outcome
from companion.sitl_config.loader import load_sitl
from tests.campaigns.made_up import WORLD
from tests.campaigns.made_up import draw_row as row
from tests.support import CATCH


def test_the_worst_are_those_that_crashed_then_gave_up_then_were_off() -> None:
    rows = [
        row(0, 0.02),
        row(1, None, "aborted"),
        row(2, 0.05),
        row(3, None, "crashed"),
        row(4, None, "lost"),
        row(5, 0.05),
    ]
    assert [one["number"] for one in worst(rows, 5)] == [3, 4, 1, 2, 5]


def test_flights_with_one_payload_are_counted_once() -> None:
    [part] = thirds([row(number, 0.02, payload_kg=0.2) for number in range(4)])
    assert (part.payload_kg, part.flights, part.caught) == ((0.2, 0.2), 4, 4)


def test_cases_come_back_from_their_file_as_they_were(tmp_path: Path) -> None:
    rows = [
        row(0, 0.0423),
        row(1, None, "aborted"),
        row(2, 0.031, caught=False, force_bias_n=[1.0, 2.0, 11.5], faults=[]),
    ]
    cases = Cases(mission="a.yaml", controller="adaptive", preset="recommended", cases=as_cases(rows))
    path = tmp_path / "cases.yaml"
    write_cases(cases, path, "two lines\nof remark")
    assert read_cases(path) == cases
    assert [case.knobs() for case in read_cases(path).cases] == [one["world"] for one in rows]
    names = [case.name for case in cases.cases]
    assert names == ["draw_0", "draw_1", "draw_2"]
    assert cases.cases[0].kept == Kept(outcome=Outcome.COMPLETED, caught=True, e_p_m=0.0423)
    assert cases.cases[1].kept.e_p_m is None
    assert [case.name for case in cases.named([names[1]])] == [names[1]]
    with pytest.raises(ConfigError, match="--case nobody: no such case; available: draw_0, draw_1"):
        cases.named(["nobody"])


def test_a_file_of_cases_takes_any_name_of_a_mission_and_of_a_vehicle(tmp_path: Path) -> None:
    mission = "my flights: #1/on the \x85 line.yaml"
    overrides = ("controller.rho_max=5.0", "vehicle.safety.room.x_m=[-3, 3]")
    cases = Cases(
        mission=mission,
        controller="adaptive",
        preset="paper",
        vehicle="my: vehicle.yaml",
        overrides=overrides,
        cases=as_cases([row(0, 0.04)]),
    )
    write_cases(cases, tmp_path / "cases.yaml", "")
    assert read_cases(tmp_path / "cases.yaml") == cases


def test_a_mistake_in_a_file_of_cases_is_reported_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "cases.yaml"
    cases = Cases(mission="a.yaml", controller="adaptive", preset="paper", cases=as_cases([row(0, 0.04)]))
    write_cases(cases, path, "")
    path.write_text(path.read_text().replace("payload_kg: 0.38", "payload: 0.38"))
    with pytest.raises(ConfigError, match=r"cases.yaml:\d+:7: cases\[0\].world.payload"):
        read_cases(path)


def test_the_printed_command_flies_the_same_world() -> None:
    drawn = {**WORLD, "machine": {"on": True, "inertia_error": [0.1, 0.0, 0.0]}}
    line = fly_command(str(CATCH), "adaptive", "recommended", "ideal", drawn, ["controller.rho_max=5.0"], "hexa_2r")
    words = shlex.split(line)
    assert words[:4] == ["companion", "fly", str(CATCH), "--sitl"]
    assert words[words.index("--world") + 1] == "ideal"
    vehicle = words[words.index("--vehicle") + 1]
    config = load_sitl(CATCH, vehicle, "adaptive", "recommended", words[words.index("--set") + 1 :])
    assert config.vehicle.name == "hexa-2r"
    (case,) = as_cases([row(0, 0.04, machine=drawn["machine"])])
    assert config.world == case.world


@pytest.mark.parametrize(
    ("now", "kept", "why"),
    [
        (row(0, 0.0499), Kept(outcome=Outcome.COMPLETED, caught=True, e_p_m=0.04), None),
        (row(0, 0.0501), Kept(outcome=Outcome.COMPLETED, caught=True, e_p_m=0.04), "e_p 0.0501 m"),
        (row(0, None, "aborted"), Kept(outcome=Outcome.COMPLETED, caught=True, e_p_m=0.04), "aborted"),
        (row(0, None, "aborted"), Kept(outcome=Outcome.ABORTED, caught=True), None),
        (row(0, 0.01), Kept(outcome=Outcome.ABORTED, caught=True), None),
        (row(0, None, "crashed"), Kept(outcome=Outcome.ABORTED, caught=True), "crashed"),
        (row(0, None, "crashed"), Kept(outcome=Outcome.CRASHED, caught=True), "crashed"),
        (row(0, 0.01, caught=False), Kept(outcome=Outcome.COMPLETED, caught=True, e_p_m=0.04), "no longer caught"),
        (row(0, 0.01), Kept(outcome=Outcome.COMPLETED, caught=False, e_p_m=0.04), None),
    ],
)
def test_worse_than_kept(now: Row, kept: Kept, why: str | None) -> None:
    found = worse_than(now, kept)
    assert found is None if why is None else found is not None and why in found


def test_thirds_are_of_payload_and_grade_only_what_was_caught_and_completed() -> None:
    rows = [row(n, 0.01 * (1 + n), payload_kg=0.1 + 0.05 * n) for n in range(7)]
    rows += [row(7, 0.9, payload_kg=0.12, caught=False), row(8, None, "aborted", payload_kg=0.4)]
    first, second, third = thirds(rows)
    assert (first.payload_kg[0], third.payload_kg[1]) == pytest.approx((0.1, 0.4))
    assert [part.flights for part in (first, second, third)] == [3, 2, 4]
    assert [part.caught for part in (first, second, third)] == [2, 2, 4]
    assert first.e_p_m == pytest.approx({"p50": 0.015, "p95": 0.0195, "max": 0.02})
    assert third.e_p_m == pytest.approx({"p50": 0.06, "p95": 0.069, "max": 0.07})


def test_flights_are_distinguished_by_what_the_force_sensor_was_like() -> None:
    silent = {**row(0, 0.02), "events": ["takeoff", "catch", "force_lost", "touchdown"]}
    assert sensor_of(silent) == "lost after the catch"
    assert sensor_of({**silent, "felt": False}) == "missing at the catch"
    assert sensor_of({**silent, "events": ["takeoff", "touchdown"]}) == "working"


def test_what_drives_the_error_is_found() -> None:
    rows = [row(n, 0.01 + 0.001 * n, wind_m_s=[0.1 * n, 0.0, 0.0], rotor_lag_s=0.06 - 0.0001 * n**2) for n in range(20)]
    found = influence(rows)
    assert found == pytest.approx({"wind_speed_m_s": 1.0, "rotor_lag_s": -1.0})


def test_without_a_completed_catch_there_is_no_plot(tmp_path: Path) -> None:
    assert not write_distribution([row(12, None, "aborted")], "nothing", tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
