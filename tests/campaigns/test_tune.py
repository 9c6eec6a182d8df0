"""`companion tune`: conditions by construction, the search with a made-up cost, what is kept, and one real search."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import pytest

from companion.campaigns.cost import ABORTED, LOST, MISSED, cost_of, flight_cost, terms_of
from companion.campaigns.process import Message
from companion.campaigns.tune.draws import draws_of
from companion.campaigns.tune.search import Evaluation, Search, rungs_of, survivors_of
from companion.campaigns.tune.space import Point, Space
from companion.cli.main import main
from companion.config.controller import PRESETS, AdaptiveConfig, LawConfig
from companion.config.loader import load_flight
from companion.control.scaled_gains import joint_inertia_kg_m2
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from tests.campaigns.made_up import compare_row, draw_row, fly_made_up
from tests.support import CATCH, HOVER, ROOT, run_here, set_options

HEXA = ROOT / "examples/tune/hexa_3r.yaml"
OURS = [(law, preset) for law in ("adaptive", "csc", "psc") for preset in PRESETS[law]]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# -- the space ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("law", "preset"), OURS)
def test_every_point_of_the_space_meets_the_conditions_of_its_law(law: str, preset: str) -> None:
    config, draw = load_flight(CATCH, HEXA, law, preset), random.Random(preset)
    space = Space.of(config.controller, config.vehicle)
    corners: list[Point] = [(0.0,) * len(space.axes), (1.0,) * len(space.axes)]
    for point in corners + [tuple(draw.choice((0.0, draw.random(), 1.0)) for _ in space.axes) for _ in range(5)]:
        settings = space.settings(point)
        assert isinstance(settings, LawConfig)
        for axis, value, coordinate in zip(space.axes, space.values(point), point, strict=True):
            assert value == pytest.approx(axis.factor(coordinate) * axis.start, rel=1e-5), axis.name
        if isinstance(settings, AdaptiveConfig):
            rows = zip(
                settings.inertia_md,
                settings.damping_kd,
                settings.stiffness_kp,
                settings.phi,
                settings.damping_d,
                strict=True,
            )
            for m_d, k_d, k_p, phi, d in rows:
                assert d > 0.0 and k_d / m_d > phi, "gain_new"
                assert (k_d - m_d * phi) * phi == pytest.approx(k_p, rel=1e-9), "gain_cond"
        for key, value in config.controller.model_dump().items():
            if not value and key not in ("scale", "found_for"):
                assert not getattr(settings, key), f"{key} is switched off by the preset and stays off"


def test_the_start_is_what_flies_and_a_found_file_flies_unchanged_on_its_vehicle() -> None:
    config = load_flight(CATCH, HEXA, "adaptive", "paper")
    space = Space.of(config.controller, config.vehicle)
    for point in (space.start_point, (0.5,) * len(space.axes)):
        settings = space.settings(point)
        Path("found.yaml").write_text(json.dumps(settings.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
        flown = load_flight(CATCH, HEXA, "found.yaml").controller
        assert isinstance(flown, LawConfig) and isinstance(settings, LawConfig) and settings.found_for is not None
        assert settings.found_for.mass_kg == config.vehicle.airframe.mass_kg
        assert settings.found_for.joint_inertia_kg_m2 == joint_inertia_kg_m2(config.vehicle)
        assert flown.model_dump(exclude={"scale"}) == settings.model_dump(exclude={"scale"})
    start = space.settings(space.start_point)
    assert start.model_dump(exclude={"scale", "found_for"}) == config.controller.model_dump(
        exclude={"scale", "found_for"}
    )
    other = load_flight(CATCH, None, "found.yaml").controller
    assert isinstance(other, AdaptiveConfig) and isinstance(flown, AdaptiveConfig)
    assert other.lambda_gain[0] == pytest.approx(flown.lambda_gain[0] * 3.0 / 6.4), (
        "elsewhere the gains follow the vehicle"
    )


@pytest.mark.usefixtures("undrawn")
def test_campaigns_fly_a_file_of_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    file = str(ROOT / "configs/controllers/csc_tuned.yaml")
    fly_made_up(monkeypatch, compare_row)
    words = ("--mission", str(CATCH), "--payloads", "0.2", "--seeds", "1", "--presets", "tuned")
    ended = run_here("compare", *words, "--controllers", f"{file},psc,{file}", "--out", "out", "--json")
    assert ended.code == EXIT_OK, ended.err
    rows = json.loads(ended.out)["rows"]
    assert [(row["controller"], row["preset"]) for row in rows] == [(file, "tuned"), ("psc", "tuned")]
    fly_made_up(monkeypatch, lambda flight: draw_row(flight["number"], 0.01))
    ended = run_here("robustness", str(CATCH), "--draws", "1", "--controller", file, "--out", "draws")
    assert f"--controller {file} --preset tuned --world" in ended.out, "the printed command flies the same file"


# -- cost and laboratories ---------------------------------------------------------------------------------------------


def test_the_cost_of_flights() -> None:
    flight = {"controller": "adaptive", "preset": "paper", "payload_kg": 0.2, "seed": 1}
    row = compare_row(flight)
    # e_p 0.1 after and 0.01 before, peak 0.1, e_q 3 deg, arm 0.1 N m, activity 0.03 N m
    assert flight_cost(row) == pytest.approx(0.1 + 0.003 + 0.02 + 0.003 + 0.01 + 0.015)
    assert flight_cost(compare_row(flight, None)) == LOST
    assert flight_cost({**row, "outcome": "aborted"}) == ABORTED
    assert flight_cost({**row, "error": "ZeroDivisionError"}) == LOST
    nothing = {"e_p_m": None, "e_q_deg": None, "e_alpha_deg": None}
    missed = {**row, "caught": False, "catch_t_s": None, "rms": {**row["rms"], "post": nothing}}
    missed["impedance_error"] = {"position_n": None, "arm_nm": None}
    assert flight_cost(missed) == pytest.approx(MISSED + 0.003 + 0.02 + 0.015)
    assert flight_cost({**missed, "catch_t_s": 6.5}) == flight_cost(missed), "a reported catch that was none is a miss"
    empty = {**missed, "payload_kg": 0.0}
    assert terms_of(empty)["rms.post.e_p_m"] == 0.01, (
        "without a payload the whole flight counts as that after the catch"
    )
    assert cost_of([0.0] * 7 + [1.0]) == pytest.approx(0.5 * 0.125 + 0.5 * 0.5), "the worst quarter counts half"


def test_laboratories_of_search_and_judgement_are_apart_and_keep_what_the_user_sets() -> None:
    config = load_flight(CATCH)
    seeds: list[int] = []
    for seed in (1, 2):
        draws = draws_of(config.mission, config.vehicle, ("world.payload_kg=0.1",), seed, 20, 30)
        flights = [kind.flight({}, number) for kind in draws for number in range(kind.count)]
        seeds += [flight["world"]["seed"] for flight in flights]
        assert all("payload_kg" not in flight["world"] for flight in flights)
        assert [flight["until_mission_s"] for flight in flights] == [pytest.approx(11.5, abs=0.1)] * 20 + [None] * 30
    assert len(set(seeds)) == 100
    hover = load_flight(HOVER)
    training, _ = draws_of(hover.mission, hover.vehicle, (), 1, 1, 1)
    assert set(training.flight({}, 0)["world"]) == {"seed"}


# -- the search --------------------------------------------------------------------------------------------------------


def bowl(point: Point, laboratory: int) -> float:
    """A cost with its minimum at 0.7 on every axis, in a slightly different place in each laboratory."""
    return 0.01 + math.fsum((x - 0.7 - 0.02 * math.sin(laboratory)) ** 2 for x in point)


def test_a_search_finds_the_minimum_and_spares_flights_of_the_worse_half() -> None:
    flown: list[tuple[Point, int]] = []

    def evaluate(points: Sequence[Point], laboratories: Sequence[int]) -> list[list[float]]:
        flown.extend((point, number) for point in points for number in laboratories)
        return [[bowl(point, number) for number in laboratories] for point in points]

    start = (0.2, 0.4, 0.9, 0.5)
    search = Search(start, draws=8, budget=150, seed=3, evaluate=evaluate)
    search.run(start)
    assert len(search.evaluations) == 150 and search.start.point == start
    assert search.best.point == pytest.approx((0.7,) * 4, abs=0.03)
    assert len(flown) == len(set(flown)) < 0.6 * 8 * 150
    assert {len(one.costs) for one in search.evaluations} == {2, 4, 8}
    by_generation: dict[int, list[Evaluation]] = {}
    for one in search.evaluations:
        by_generation.setdefault(one.generation, []).append(one)
    ahead = sorted(by_generation[1], key=lambda one: -len(one.costs))
    assert [len(one.costs) for one in ahead] == [8] * 2 + [4] * 2 + [2] * 4
    assert rungs_of(1) == [1] and rungs_of(3) == [1, 2, 3] and survivors_of(11, 3) == [11, 6, 3]


class MadeUp:
    """Stands for the process that flies: the cost is that of `bowl` on the gains, and a flight can be the last one."""

    flown = 0
    last = 10**9
    worse = False

    def __init__(self, job: Message, log: Path) -> None:
        self._stopped = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None: ...

    def ask_to_stop(self) -> None:
        self._stopped = True

    def fly(self, flights: Sequence[Message]) -> Iterator[Message]:
        for index, flight in reversed(list(enumerate(flights))):
            if MadeUp.flown == MadeUp.last:
                signal_stop()
            if self._stopped:
                return
            MadeUp.flown += 1
            gains, world = flight["controller"], flight["world"]
            error_m = 0.01 + 0.1 * abs(math.log(gains["lambda_gain"][0] / 6.0)) + 1e-4 * (world["seed"] % 10)
            if MadeUp.worse and flight["until_mission_s"] is None:
                error_m = 0.1 + gains["lambda_gain"][0] / 60.0
            row = compare_row(
                {**gains, "controller": "", "payload_kg": world["payload_kg"], "seed": world["seed"]}, error_m
            )
            yield {"index": index, "row": row, "wall_s": 0.1, "cpu_s": 1.0, "at_once": 4}


def signal_stop() -> None:
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.campaigns.tune.flights.CampaignProcess", MadeUp)
    for key, value in (("flown", 0), ("last", 10**9), ("worse", False)):
        monkeypatch.setattr(MadeUp, key, value)


TUNE = ("tune", "--mission", str(CATCH), "--preset", "paper", "--laboratories", "4", "--held-out", "5", "--json")


@pytest.mark.usefixtures("made_up")
def test_an_interrupted_search_goes_on_and_ends_with_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.campaigns.tune.plots.write_pictures", lambda result, out: [])
    own = "vehicle.airframe.payload_max_kg=0.3"
    words = (*TUNE, "--budget", "12", "--set", own, "controller.load_leakage=0.1")
    assert run_here(*words, "--out", "whole").code == EXIT_OK
    flights = MadeUp.flown
    monkeypatch.setattr(MadeUp, "flown", 0)
    for last in (3, 20):
        monkeypatch.setattr(MadeUp, "last", last)
        ended = run_here(*words, "--out", "parts")
        assert (ended.code, ended.out) == (EXIT_ABORTED, "")
        assert ended.err_lines == ["companion tune: interrupted; the same command with --out parts goes on from there"]
        assert not Path("parts/result.json").exists()
        with open("parts/flights.jsonl", "a", encoding="utf-8") as file:
            file.write('{"flight": "cut off by a power fail')
    monkeypatch.setattr(MadeUp, "last", 10**9)
    ended = run_here(*words, "--out", "parts")
    assert ended.code == EXIT_OK and MadeUp.flown == flights, "no flight is flown twice"
    whole, parts = (json.loads(Path(name, "result.json").read_text()) for name in ("whole", "parts"))
    for key in ("candidates", "held_out", "gains", "evaluations"):
        assert parts[key] == whole[key]
    printed = json.loads(ended.out)
    assert printed["evaluations"] == 12 and printed["file"] == "parts/controller.yaml" and printed["better"]
    assert printed["held_out"]["cost_after"] < printed["held_out"]["cost_before"]
    assert printed["held_out"]["change_95"][1] < 0.0
    assert printed["fly"] == f"companion fly {CATCH} --sitl --world lab --set {own} --controller parts/controller.yaml"
    text = Path("parts/controller.yaml").read_text()
    for wanted in (
        "seed 1",
        "tarot650_2r.yaml",
        "laboratories 1010000 to 1010003",
        "laboratories 500010000 to 500010004, held out",
    ):
        assert wanted in text
    found = load_flight(CATCH, None, "parts/controller.yaml").controller
    assert isinstance(found, AdaptiveConfig) and found.preset == "paper_tuned"
    assert found.lambda_gain[0] == pytest.approx(printed["gains"][1]["found"])
    refused = run_here(*words, "--out", "parts", "--seed", "2")
    assert refused.code == EXIT_BAD_INPUT
    assert refused.err_lines == [
        "companion tune: --out parts: holds another search: seed was 1, is 2; choose another folder"
    ]


@pytest.mark.usefixtures("made_up")
def test_a_full_disk_costs_no_flight_of_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MadeUp, "last", 3)
    assert run_here(*TUNE, "--out", "out").code == EXIT_ABORTED
    before = Path("out/flights.jsonl").read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/flights.jsonl")

    monkeypatch.setattr(Path, "replace", full)
    ended = run_here(*TUNE, "--out", "out")
    assert ended.code == EXIT_LOST
    assert ended.err_lines == ["companion tune: out/flights.jsonl: cannot be written: No space left on device"]
    assert Path("out/flights.jsonl").read_bytes() == before


@pytest.mark.usefixtures("made_up")
def test_a_result_that_cannot_be_printed_is_written_all_the_same(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main([*TUNE, "--budget", "10", "--out", "out"]) == EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "companion tune: standard output cannot be written: No space left on device"
    assert Path("out/result.json").exists()


@pytest.mark.usefixtures("made_up")
def test_gains_that_are_not_better_elsewhere_are_not_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MadeUp, "worse", True)
    monkeypatch.setattr(AdaptiveConfig, "tuned_gains", AdaptiveConfig.tuned_gains[1:3])
    ended = run_here(*TUNE, "--budget", "25", "--out", "out")
    assert ended.code == EXIT_REFUSED
    found = json.loads(ended.out)
    assert found["training"]["cost_after"] < found["training"]["cost_before"]
    assert found["held_out"]["cost_after"] >= found["held_out"]["cost_before"]
    assert found["file"] is None and not Path("out/controller.yaml").exists()
    page = Path("out/page.html").read_text()
    assert "the gains are not surely better, so no controller file was written" in page
    assert page.count("data:image/png") == 2


@pytest.mark.usefixtures("made_up")
def test_a_plan_counts_flights_and_writes_nothing(tmp_path: Path) -> None:
    found = json.loads(run_here(*TUNE, "--budget", "100", "--plan").out)
    assert (found["cpu_s"], found["at_once"]) == (1.0, 4)
    assert found["durations_s"]["100"] < found["durations_s"]["10"] < found["duration_s"] < found["flights"] / 3
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--budget", "0"), "expected a whole number from 1"),
        (("--controller", "nofile.yaml"), "nofile.yaml: no such file"),
        (
            ("--controller", str(ROOT / "configs/controllers/csc_tuned.yaml"), "--preset", "paper"),
            'has the gains "tuned"',
        ),
        (("--set", "world.seed=2"), "--set world.seed: the search sets this key; use --seed"),
        (("--set", "controller.phi=[1]"), "controller.phi"),
        (("--out", ""), "expected the name of a folder, got an empty one"),
    ],
)
def test_bad_input_is_one_line_and_nothing_flies(words: tuple[str, ...], why: str, tmp_path: Path) -> None:
    ended = run_here("tune", "--mission", str(CATCH), *words)
    assert ended.code == EXIT_BAD_INPUT and ended.out == ""
    assert len(ended.err_lines) == 1 and why in ended.err, ended.err
    assert list(tmp_path.iterdir()) == []


def test_a_law_that_declares_no_gains_cannot_be_tuned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AdaptiveConfig, "tuned_gains", ())
    ended = run_here("tune", "--mission", str(CATCH))
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1 and "expected a law that declares two or more gains to tune, found 0" in ended.err


def test_a_real_search_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.campaigns.tune.plots.write_pictures", lambda result, out: [])
    words = ("--preset", "paper", "--budget", "2", "--laboratories", "1", "--held-out", "1", "--jobs", "1")
    low = set_options(
        **{"mission.phases[0].height_m": 0.5, "mission.phases[0].duration_s": 1.5, "mission.phases[1].duration_s": 1.0}
    )
    ended = run_here("tune", "--mission", str(HOVER), *words, *low, "--out", "out")
    assert ended.code in (EXIT_OK, EXIT_REFUSED), ended.err
    assert "Held-out laboratories" in ended.out and ended.out.endswith("report  out/page.html\n")
    names = {"flights.jsonl", "result.json", "page.html"}
    assert {path.name for path in Path("out").iterdir()} - {"controller.yaml"} == names
    result = json.loads(Path("out/result.json").read_text())
    assert result["held_out"]["completed_before"] == 1 and len(result["candidates"]) == 2
    assert result["candidates"][0]["costs"] != result["candidates"][1]["costs"]
