"""The grid, what its rows add up to, and what is written of it; then `companion compare` itself."""

from __future__ import annotations

import base64
import csv
import json
import math
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from typing import Any

import pytest
from rich.console import Console

from companion.campaigns.compare import (
    ABLATED,
    ABLATIONS,
    Row,
    aggregate,
    flat,
    flights_of,
    variants_of,
)
from companion.campaigns.compare_table import print_tables
from companion.campaigns.printed import TABLE, printed
from companion.config.controller import PRESETS
from companion.config.loader import load_flight
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from tests.support import CATCH, DEADLINE_S, SHORT_CATCH, Ended, Sandbox, run_here, sandbox_in

AVAILABLE = {"adaptive": ("paper", "recommended"), "csc": ("tuned",), "psc": ("tuned",)}
CRASHING = "world.throw_velocity_m_s=[-40, 0, -40]"


def row(seed: int, e_p_m: float | None, **changes: Any) -> Row:
    """A made-up flight of adaptive/paper with 0.2 kg; e_p_m None: it crashed after the catch."""
    ended = e_p_m is None
    post = {"e_p_m": e_p_m, "e_q_deg": None if ended else 3.0, "e_alpha_deg": None if ended else 2.0}
    return {
        "controller": "adaptive",
        "preset": "paper",
        "payload_kg": 0.2,
        "seed": seed,
        "outcome": "crashed" if ended else "completed",
        "error": None,
        "catch_t_s": 6.5,
        "rms": {"pre": {"e_p_m": 0.01, "e_q_deg": 1.0, "e_alpha_deg": 1.0}, "post": post},
        "impedance_error": {"position_n": None if ended else 1.0, "arm_nm": None if ended else 0.1},
        "final_e_z_m": None if ended else (-0.02 if seed % 2 else 0.01),
        "peak_e_p_m": None if ended else 0.1,
        "torque_activity_nm": None if ended else 0.03,
        **changes,
    }


# -- the grid ----------------------------------------------------------------------------------------------------------


def labels(controllers: tuple[str, ...] = (), presets: tuple[str, ...] = (), ablation: bool = False) -> list[str]:
    return [variant.label for variant in variants_of(AVAILABLE, controllers, presets, ablation)]


def test_all_laws_fly_all_their_presets_unless_asked_otherwise() -> None:
    assert labels() == ["adaptive/paper", "adaptive/recommended", "csc/tuned", "psc/tuned"]
    assert labels(controllers=("psc", "adaptive")) == ["psc/tuned", "adaptive/paper", "adaptive/recommended"]


def test_presets_are_chosen_where_a_law_has_them() -> None:
    assert labels(presets=("recommended",)) == ["adaptive/recommended", "csc/tuned", "psc/tuned"]
    assert labels(presets=("tuned",)) == ["adaptive/paper", "adaptive/recommended", "csc/tuned", "psc/tuned"]


def test_what_is_taken_away_stands_below_what_it_is_taken_from() -> None:
    found = labels(ablation=True)
    at = found.index("/".join(ABLATED))
    assert found[at + 1 : at + 1 + len(ABLATIONS)] == [f"{'/'.join(ABLATED)} - {what}" for what in ABLATIONS]
    assert "adaptive/recommended" in labels(presets=("paper",), ablation=True), "nothing to see it beside"


@pytest.mark.parametrize(
    ("controllers", "presets", "ablation", "why"),
    [
        (("foo",), (), False, "--controllers foo: .*adaptive, csc, psc"),
        (("csc",), ("paper",), False, "--presets paper: .*available: tuned"),
        (("csc",), (), True, "--ablation: .*adaptive/recommended"),
    ],
)
def test_what_is_not_there_is_refused(
    controllers: tuple[str, ...], presets: tuple[str, ...], ablation: bool, why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        labels(controllers, presets, ablation)


def test_every_ablation_changes_the_configuration_and_is_accepted() -> None:
    law, preset = ABLATED
    whole = load_flight(CATCH, None, law, preset).controller
    seen = [load_flight(CATCH, None, law, preset, overrides).controller for overrides in ABLATIONS.values()]
    for what, less in zip(ABLATIONS, seen, strict=True):
        assert less != whole, what
    assert len({less.model_dump_json() for less in seen}) == len(seen)


def test_the_grid_is_in_the_order_of_the_table() -> None:
    variants = variants_of(AVAILABLE, ("adaptive",), (), False)
    flights = flights_of(variants, (0.3, 0.1), (1, 2))
    assert [(f.payload_kg, f.variant, f.seed) for f in flights] == [
        (payload, variant, seed) for payload in (0.3, 0.1) for variant in (0, 1) for seed in (1, 2)
    ]


# -- what it adds up to ------------------------------------------------------------------------------------------------


def test_mean_and_deviation_over_seeds() -> None:
    values = [0.1, 0.2, 0.4]
    (cell,) = aggregate([row(seed, value) for seed, value in enumerate(values, 1)])
    spread = cell.figures["rms.post.e_p_m"]
    assert spread is not None and spread.std is not None
    assert spread.mean == pytest.approx(sum(values) / 3, rel=1e-15)
    assert spread.std == pytest.approx(math.sqrt(sum((v - spread.mean) ** 2 for v in values) / 2), rel=1e-12)
    height = cell.figures["final_abs_e_z_m"]
    assert height is not None
    assert height.mean == pytest.approx((0.02 + 0.01 + 0.02) / 3), "errors of either sign must not cancel"
    assert cell.failures == {} and cell.failure_text == ""


def test_a_crash_is_counted_and_its_errors_are_not_averaged() -> None:
    (cell,) = aggregate([row(1, 0.1), row(2, None), row(3, 0.3), row(4, None), row(5, 0.2)])
    assert cell.failure_text == "crashed 2 of 5"
    post, pre = cell.figures["rms.post.e_p_m"], cell.figures["rms.pre.e_p_m"]
    assert post is not None and post.mean == pytest.approx(0.2)
    assert pre is not None and pre.mean == pytest.approx(0.01)
    assert cell.jsonable()["completed"] == 3


def test_a_payload_that_was_not_caught_is_told() -> None:
    missed = row(1, 0.1, catch_t_s=None)
    (cell,) = aggregate([missed])
    assert cell.failure_text == "missed 1 of 1"
    (nothing_thrown,) = aggregate([{**missed, "payload_kg": 0.0}])
    assert nothing_thrown.failures == {}


def test_one_seed_has_no_deviation() -> None:
    (cell,) = aggregate([row(1, 0.1)])
    spread = cell.figures["rms.post.e_p_m"]
    assert spread is not None and spread.std is None


def test_printed_values_are_the_papers() -> None:
    assert len(TABLE) == 9
    crashed = [key for key, flight in TABLE.items() if flight.post is None]
    assert crashed == [("csc", 0.3)]
    proposed = printed("adaptive", 0.2)
    assert proposed is not None and proposed.post is not None
    assert (proposed.pre.e_p_m, proposed.post.e_p_m, proposed.post.e_q_deg) == (0.0906, 0.1654, 3.1190)
    assert printed("adaptive", 0.25) is None
    for law in ("csc", "psc", "adaptive"):
        posts = [flight.post.e_p_m for (of, _), flight in TABLE.items() if of == law and flight.post is not None]
        assert posts == sorted(posts), "heavier payloads are worse, for every law of the paper"


@pytest.mark.parametrize("columns", [70, 100, 132, 200])
def test_no_figure_of_the_table_is_cut_off(columns: int) -> None:
    rows = [row(seed, 0.1234) for seed in (1, 2)] + [row(seed, None, payload_kg=0.3) for seed in (1, 2)]
    console = Console(width=columns)
    with console.capture() as shown:
        print_tables(aggregate(rows), console)
    text = shown.get()
    assert "…" not in text
    for wanted in ("0.1234", "0.1654", "0.0906", "crashed 2 of 2", "0.2 kg", "adaptive/paper"):
        assert wanted in text
    assert console.width == columns


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Sandbox]:
    with sandbox_in(tmp_path_factory.mktemp("compare")) as sandbox:
        yield sandbox


TINY = ("compare", "--mission", SHORT_CATCH, "--payloads", "0.2", "--seeds", "1", "--controllers", "adaptive")
CATCH_T_S = {"paper": 2.8, "recommended": 2.45}
"""Measured in this mission."""


@pytest.fixture(scope="module")
def flown(place: Sandbox) -> Ended:
    """Two presets, one payload, one seed."""
    ended = place.run(*TINY, "--jobs", "2", "--json", "--out", "two")
    assert ended.code == EXIT_OK, ended.err
    return ended


def test_json_is_rows_and_aggregate_and_nothing_else(flown: Ended, place: Sandbox) -> None:
    place.assert_nobody_left(DEADLINE_S)
    table = json.loads(flown.out)
    assert list(table) == ["rows", "aggregate"]
    assert flown.err == ""
    presets = PRESETS["adaptive"]
    assert [(r["controller"], r["preset"], r["payload_kg"], r["seed"]) for r in table["rows"]] == [
        ("adaptive", preset, 0.2, 1) for preset in presets
    ]
    for found in table["rows"]:
        assert found["outcome"] == "completed"
        assert 0.0 < found["rms"]["pre"]["e_p_m"] < 0.3
        assert 0.0 < found["rms"]["post"]["e_p_m"] < 0.6
        assert found["peak_e_p_m"] >= found["rms"]["post"]["e_p_m"]
        assert 0.0 < found["impedance_error"]["arm_nm"] < 1.0
        assert 0.0 < found["torque_activity_nm"] < 1.0
        assert found["catch_t_s"] == pytest.approx(CATCH_T_S[found["preset"]], abs=0.05)
    for cell, found in zip(table["aggregate"], table["rows"], strict=True):
        assert cell["mean"]["rms"] == found["rms"]
        assert cell["std"]["rms"]["post"]["e_p_m"] is None
        assert cell["printed"]["post"] == {"e_p_m": 0.1654, "e_q_deg": 3.1190}


def test_files_hold_what_was_printed(flown: Ended, place: Sandbox) -> None:
    table, out = json.loads(flown.out), place.cwd / "two"
    whole = json.loads((out / "compare.json").read_text(encoding="utf-8"))
    assert {key: whole[key] for key in table} == table
    assert whole["settings"]["payloads_kg"] == [0.2] and whole["settings"]["seeds"] == [1]
    assert {"companion", "python", "numpy", "mujoco"} <= set(whole["versions"])
    with open(out / "compare.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    for line, found in zip(lines, table["rows"], strict=True):
        assert line == {name: "" if value is None else str(value) for name, value in flat(found)}
    assert {path.name for path in out.iterdir()} == {
        *("compare.json", "compare.csv", "compare.html", "errors.png", "tracking_0.2kg.png")
    }
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")


class _Page(HTMLParser):
    """Refuses tags that are not closed in their order; collects text and pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.pictures: list[bytes] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            source = dict(attrs)["src"] or ""
            self.pictures.append(base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True))
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_whole_and_needs_no_other_file(flown: Ended, place: Sandbox) -> None:
    out = place.cwd / "two"
    page = _Page()
    page.feed((out / "compare.html").read_text(encoding="utf-8"))
    page.close()
    assert page.open == []
    assert sorted(page.pictures) == sorted(picture.read_bytes() for picture in out.glob("*.png"))
    for cell in json.loads(flown.out)["aggregate"]:
        assert f"{cell['mean']['rms']['post']['e_p_m']:.4f}" in page.text
    assert "0.1654" in page.text


def test_the_table_shows_ours_and_the_papers_and_a_crash_as_one(place: Sandbox) -> None:
    arguments = ("--mission", CATCH, "--presets", "recommended", "--jobs", "1", "--set", CRASHING, "--out", "crash")
    ended = place.run(*TINY, *arguments)
    assert ended.code == EXIT_OK, "a crash is a result"
    assert ended.err == ""
    (line,) = [line for line in ended.out.splitlines() if "adaptive/recommended" in line and "0.0906" in line]
    assert re.search(r"0\.0906 .*crashed 1 of 1 +0\.1654", line)
    (found,) = json.loads((place.cwd / "crash/compare.json").read_text(encoding="utf-8"))["rows"]
    assert found["outcome"] == "crashed"
    assert found["rms"]["pre"]["e_p_m"] < 0.3
    assert set(found["rms"]["post"].values()) == {None}
    assert found["peak_e_p_m"] is None and found["final_e_z_m"] is None
    page = (place.cwd / "crash/compare.html").read_text(encoding="utf-8")
    assert "crashed 1 of 1" in page


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--controllers", "foo"), r"^companion compare: --controllers foo: no such controller; available: adaptive"),
        (("--presets", "foo"), r"^companion compare: --presets foo: no such preset"),
        (("--payloads", "0.1,x"), r"^companion compare: .*--payloads: .*kg.*'0\.1,x'"),
        (("--payloads", "nan"), r"^companion compare: .*--payloads"),
        (("--seeds", "0"), r"^companion compare: .*--seeds: .*from 1"),
        (("--jobs", "-1"), r"^companion compare: .*--jobs"),
        (("--set", "world.seed=2"), r"^companion compare: --set world\.seed: .*--seeds"),
        (("--set", "controller.rho_maxx=2"), r"^--set controller\.rho_maxx: unknown key"),
        (("--mission", "nofile.yaml"), r"^nofile\.yaml: no such file$"),
        (("--out", ""), r"^companion compare: --out .*empty"),
        (("--out", "taken"), r"^companion compare: --out taken: there is a compare\.json already"),
    ],
)
def test_bad_input_is_one_line_and_nothing_flies(
    place: Sandbox, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], why: str
) -> None:
    taken = place.cwd / "taken"
    taken.mkdir(exist_ok=True)
    (taken / "compare.json").write_text("{}", encoding="utf-8")
    before = sorted(place.cwd.iterdir())
    monkeypatch.chdir(place.cwd)
    ended = run_here("compare", "--mission", CATCH, *arguments)
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1 and re.search(why, ended.err), ended.err
    assert ended.out == ""
    assert sorted(place.cwd.iterdir()) == before
