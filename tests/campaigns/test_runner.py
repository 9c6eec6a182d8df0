"""The runner of all campaigns: files, output and exit codes, with flights that are made up."""

from __future__ import annotations

import base64
import csv
import json
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from companion.analysis.flat import flat
from companion.campaigns.process import CampaignError
from companion.campaigns.robustness.cases import read_cases
from companion.config.controller import preset_file
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK
from tests.campaigns.made_up import compare_row, draw_row, fault_row, fly_made_up
from tests.support import CATCH, HOVER, run_here

EVIL = "<script>alert('$x$')</script>"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


class Page(HTMLParser):
    """Rejects tags that are not closed in their order; collects text, tags and pictures."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.pictures: list[bytes] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            source = dict(attrs)["src"] or ""
            self.pictures.append(base64.b64decode(source.removeprefix("data:image/png;base64,"), validate=True))
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


COMPARE = ("compare", "--mission", str(CATCH), "--payloads", "0.2", "--controllers", "adaptive", "--out", "out")


def test_files_of_a_comparison_hold_what_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    def row(flight: dict[str, Any]) -> dict[str, Any]:
        return compare_row(flight, None if flight["preset"] == "paper" else 0.05, error=EVIL)

    fly_made_up(monkeypatch, row)
    ended = run_here(*COMPARE, "--presets", "paper,recommended", "--seeds", "2", "--first-seed", "7", "--json")
    assert (ended.code, ended.err) == (EXIT_OK, ""), "a crash is a result"
    table = json.loads(ended.out)
    assert list(table) == ["rows", "aggregate"]
    assert [(r["preset"], r["seed"]) for r in table["rows"]] == [
        (preset, seed) for preset in ("paper", "recommended") for seed in (7, 8)
    ]
    whole = json.loads(Path("out/compare.json").read_text(encoding="utf-8"))
    assert {key: whole[key] for key in table} == table
    assert whole["settings"]["payloads_kg"] == [0.2] and whole["settings"]["seeds"] == [7, 8]
    assert {"companion", "python", "numpy", "mujoco"} <= set(whole["versions"])
    with open("out/compare.csv", newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert lines == [{key: "" if v is None else str(v) for key, v in flat(row)} for row in table["rows"]]
    pictures = {"errors.png"}
    assert {path.name for path in Path("out").iterdir()} == {"compare.json", "compare.csv", "compare.html"} | pictures
    page = Page(Path("out/compare.html"))
    assert sorted(page.pictures) == sorted(Path("out", name).read_bytes() for name in pictures)
    assert all(picture.startswith(b"\x89PNG") for picture in page.pictures)
    for wanted in ("0.0500 (0.0500)", "0.1654", "crashed 2 of 2", "adaptive/paper"):
        assert wanted in page.text
    assert EVIL in page.text and "script" not in page.tags


@pytest.mark.usefixtures("undrawn")
def test_the_terminal_shows_tables_and_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    fly_made_up(monkeypatch, lambda flight: compare_row(flight, None))
    ended = run_here(*COMPARE, "--seeds", "1")
    line = next(line for line in ended.out.splitlines() if "adaptive/paper" in line)
    assert re.search(r"0\.0906 .*crashed 1 of 1 +0\.1654", line)
    assert ended.out.endswith("report  out/compare.html\n")


def test_a_campaign_that_breaks_off_keeps_what_was_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    error = CampaignError("a worker process died")
    fly_made_up(monkeypatch, lambda flight: fault_row(flight) if flight["size"] != 85.0 else None, error)
    ended = run_here("faults", str(CATCH), "--kinds", "servo_hot", "--phases", "line", "--out", "out", "--json")
    assert ended.code == EXIT_LOST
    assert ended.err_lines == ["companion faults: a worker process died", "companion faults: 1 of 2 flights were flown"]
    assert [row["size"] for row in json.loads(ended.out)["rows"]] == [70.0]
    assert json.loads(Path("out/faults.json").read_text())["notes"] == [
        "a worker process died", "1 of 2 flights were flown"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "code"),
    [(CampaignError("no such phase", bad_input=True), EXIT_BAD_INPUT), (CampaignError("died"), EXIT_LOST), (None, EXIT_ABORTED)],
)  # fmt: skip
def test_a_campaign_without_a_flight_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, error: CampaignError | None, code: int, tmp_path: Path
) -> None:
    fly_made_up(monkeypatch, lambda flight: None, error)
    ended = run_here("faults", str(CATCH), "--kinds", "gust", "--phases", "line")
    assert ended.code == code
    assert ended.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_bad_flight_with_a_fault_is_shown_and_is_exit_code_5(monkeypatch: pytest.MonkeyPatch) -> None:
    def row(flight: dict[str, Any]) -> dict[str, Any]:
        bad = flight["phase"] == "return"
        return fault_row(flight, outcome="crashed", problems=["crashed"], error=EVIL) if bad else fault_row(flight)

    fly_made_up(monkeypatch, row)
    words = ("faults", str(CATCH), "--kinds", "tether_cut", "--phases", "line,return", "--out", "out")
    ended = run_here(*words)
    assert ended.code == EXIT_LOST
    assert f"tether_cut in return: crashed; {EVIL}" in ended.out
    found = json.loads(Path("out/faults.json").read_text())
    assert (found["summary"]["bad"], found["summary"]["outcomes"]) == (1, {"landed": 1, "crashed": 1})
    with open("out/faults.csv", encoding="utf-8") as file:
        assert [(line["outcome"], line["problems"]) for line in csv.DictReader(file)] == [
            ("landed", ""), ("crashed", "crashed")
        ]  # fmt: skip
    page = Page(Path("out/faults.html"))
    assert "1 of 2 flights violated a safety requirement." in page.text
    assert page.tags.count("tr") == (1 + 1) + (1 + 2), "the bad one, then both"
    assert "script" not in page.tags


def test_a_flight_over_wires_that_is_refused_is_lost_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    program = Path("python")
    program.write_text('#!/bin/sh\necho refused: "$@" >&2\nexit 2\n', encoding="utf-8")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program.resolve()))
    words = ("faults", str(CATCH), "--wires", "--kinds", "kill_guardian,kill_recorder", "--preset", "paper")
    ended = run_here(*words, "--jobs", "2", "--out", "out", "--json")
    assert ended.code == EXIT_LOST, ended.err
    found = json.loads(ended.out)
    assert [(row["fault"], row["outcome"]) for row in found["rows"]] == [
        ("kill_recorder", "lost"),
        ("kill_guardian", "lost"),
    ]
    for row in found["rows"]:
        assert (
            f'fly {CATCH} --preset paper --world ideal --sitl --speed max --set world.faults=[{{"kind": "{row["fault"]}"'
            in row["error"]
        )
    assert len(json.loads(Path("out/faults.json").read_text())["wall_s"]) == 2


def test_draws_are_written_as_table_and_cases_and_a_crash_is_exit_code_5(monkeypatch: pytest.MonkeyPatch) -> None:
    def row(flight: dict[str, Any]) -> dict[str, Any]:
        n = flight["number"]
        return draw_row(n, *((None, "crashed") if n == 14 else (0.01 + 0.001 * n,)), payload_kg=0.1 + 0.01 * n)

    fly_made_up(monkeypatch, row)
    ended = run_here("robustness", str(CATCH), "--draws", "12", "--first", "3", "--out", "out", "--keep", "kept.yaml")
    assert ended.code == EXIT_LOST
    assert "12 worlds: 11 completed, 1 crashed; 12 caught, 0 missed the net; 0 false catches, 0 undetected" in ended.out
    assert "payload, kg +1.00" in ended.out
    assert "--preset recommended --world robustness --set world.payload_kg=" in ended.out
    names = {"draws.csv", "robustness.json", "robustness.html", "worst.yaml", "distribution.png"}
    assert {path.name for path in Path("out").iterdir()} == names
    assert Path("kept.yaml").read_text().count("- name:") == 10
    assert "These are the worst of draws 3 to 14, seed 1." in Path("out/worst.yaml").read_text()
    with open("out/draws.csv", newline="", encoding="utf-8") as file:
        read = list(csv.DictReader(file))
    assert len(read) == 12
    assert float(read[3]["payload_kg"]) == pytest.approx(0.16)
    assert float(read[3]["throw_from_deg"]) == pytest.approx(173.48, abs=0.01)
    assert (read[11]["outcome"], read[11]["e_p_m"], read[11]["events"]) == ("crashed", "", "takeoff touchdown")
    page = Page(Path("out/robustness.html"))
    assert page.pictures == [Path("out/distribution.png").read_bytes()]
    assert "1 flights crashed or were lost." in page.text
    summary = json.loads(Path("out/robustness.json").read_text())["summary"]
    assert summary["thirds"][0]["flights"] == 4 and set(summary["thirds"][0]["e_p_m"]) == {"p50", "p95", "max"}


def test_the_controller_file_of_a_mission_is_named_where_its_flights_are_to_be_flown_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gains = preset_file("psc", "tuned").read_text(encoding="utf-8")
    Path("mine.yaml").write_text(gains.replace("preset: tuned", "preset: mine"), encoding="utf-8")
    text = CATCH.read_text(encoding="utf-8").replace("{law: adaptive, preset: recommended}", "{file: mine.yaml}")
    text = re.sub("(?m)^vehicle: .*", "vehicle: tarot650_2r", text)
    Path("catch.yaml").write_text(text, encoding="utf-8")
    fly_made_up(monkeypatch, lambda flight: draw_row(flight["number"] or 0, 0.02))
    ended = run_here("robustness", "catch.yaml", "--draws", "1", "--out", "out")
    assert "companion fly catch.yaml --sitl --controller mine.yaml --preset mine" in ended.out
    assert run_here("robustness", "--cases", "out/worst.yaml", "--plan").code == EXIT_OK


@pytest.mark.usefixtures("undrawn")
def test_a_file_of_cases_loses_none_that_was_not_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    results = {"draw 0": 0.02, "draw 1": 0.03, "draw_0": 0.01, "draw_1": None}

    def row(flight: dict[str, Any]) -> dict[str, Any] | None:
        error_m, number = results[flight["name"]], int(flight["name"][-1])
        found = draw_row(number, error_m)
        return None if error_m is None else {**found, "name": flight["name"], "number": flight["number"]}

    fly_made_up(monkeypatch, row)
    assert run_here("robustness", str(CATCH), "--draws", "2", "--out", "a", "--keep", "kept.yaml").code == EXIT_OK
    before = Path("kept.yaml").read_text(encoding="utf-8")
    again = ("--cases", "kept.yaml", "--keep", "kept.yaml")
    for words in ((str(CATCH), "--keep", "kept.yaml"), (*again, "--case", "draw_0"), ("--keep", "a/draws.csv/k.yaml")):
        refused = run_here("robustness", *words)
        assert refused.code == EXIT_BAD_INPUT and "--keep" in refused.err_lines[0] and len(refused.err_lines) == 1
    assert run_here("robustness", *again, "--out", "b").code == EXIT_ABORTED
    assert Path("kept.yaml").read_text(encoding="utf-8") == before
    results["draw_1"] = 0.02
    assert run_here("robustness", *again, "--out", "c").code == EXIT_OK
    assert [case.kept.e_p_m for case in read_cases(Path("kept.yaml")).cases] == [0.02, 0.01]


@pytest.mark.parametrize(
    ("words", "useless"),
    [
        (("robustness", "--cases", "kept.yaml", "--draws", "5"), "--draws"),
        (("robustness", "--cases=kept.yaml", "--first=3", "--seed", "1"), "--seed, --first"),
        (("robustness", "--draws", "5", "--plan", "--keep", "kept.yaml"), "--keep"),
        (("compare", "--plan", "--out", "here"), "--out"),
        (("compare", "--scheduler", "tcp://x", "--jobs", "2"), "--jobs"),
        (("tune", "--plan", "--out", "here"), "--out"),
        (("tune", "--scheduler", "tcp://x", "--jobs", "2"), "--jobs"),
        (("faults", "--list", "--kinds", "servo_loss"), "--kinds"),
        (("faults", "--list", "--wires"), "--wires"),
        (("faults", "--wires", "--scheduler", "tcp://x"), "--scheduler"),
    ],
    ids=str,
)
def test_an_option_without_effect_is_refused(words: tuple[str, ...], useless: str) -> None:
    ended = run_here(*words)
    assert ended.code == EXIT_BAD_INPUT
    [line] = ended.err_lines
    assert line.startswith(f"companion {words[0]}: {useless}") and ": has no effect with --" in line


def test_a_case_of_a_team_is_refused() -> None:
    ended = run_here("robustness", "carry", "--case", "draw 1")
    assert ended.code == EXIT_BAD_INPUT
    assert ended.err_lines == ["companion robustness: --case needs --cases FILE, the file that contains the case"]


CASES = "mission: a.yaml\ncontroller: adaptive\npreset: paper\ncases: []\n"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("compare", "--controllers", "foo"), r"^companion compare: --controllers foo: no such controller; available: adaptive"),
        (("compare", "--controllers", "csc", "--ablation"), r"^companion compare: --ablation: .*adaptive/recommended"),
        (("compare", "--controllers", "mine.yaml", "--presets", "foo"), r"--presets: expected a control law in --contr"),
        (("compare", "--controllers", "mine.yaml", "--ablation"), r"--ablation: expected a control law in --controllers, "),
        (("compare", "--controllers", "nameless.yaml"), r"^nameless\.yaml:\d+:\d+: preset: missing; expected text$"),
        (("compare", "--presets", "foo"), r"^companion compare: --presets foo: no such preset"),
        (("compare", "--payloads", "0.1,x"), r"^companion compare: .*--payloads: .*kg.*'0\.1,x'"),
        (("compare", "--seeds", "0"), r"^companion compare: .*--seeds: .*from 1"),
        (("compare", "--set", "world.seed=2"), r"^companion compare: --set world\.seed: .*--seeds"),
        (("compare", "--mission", "nofile.yaml"), r"^nofile\.yaml: no such file$"),
        (("compare", "--out", "taken"), r"^companion compare: --out taken: already contains compare\.json"),
        (("faults", "--kinds", "mocap_los"), r"there is no kind of fault 'mocap_los'; did you mean 'mocap_loss'\?"),
        (("faults", "--phases", "lunch"), r"there is no phase 'lunch'"),
        (("faults", "--set", "world.faults=[]"), r"the campaign sets this key; use --kinds and --phases"),
        (("faults", "--wires", "--kinds", "gust"), r"no fault with --wires has kind gust and phase any"),
        (("faults", "--kinds", "gust,tool_broken"), r"tool_broken need a mission with a contact, got other kinds"),
        (("robustness", "--case", "heavy"), r"--case needs --cases FILE"),
        (("robustness", "--cases", "empty.yaml"), r"empty\.yaml: cases: expected at least one case"),
        (("compare", "--first-seed", "1000000"), r"expected a whole number from 1 to 900000"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_flies(tmp_path: Path, words: tuple[str, ...], why: str) -> None:
    Path("taken").mkdir()
    Path("taken/compare.json").write_text("{}", encoding="utf-8")
    Path("empty.yaml").write_text(CASES, encoding="utf-8")
    gains = preset_file("psc", "tuned").read_text(encoding="utf-8")
    Path("nameless.yaml").write_text(gains.replace("preset: tuned\n", ""), encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    mission = ("--mission", str(CATCH)) if words[0] == "compare" else () if "--cases" in words else (str(CATCH),)
    ended = run_here(words[0], *mission, *words[1:])
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1 and re.search(why, ended.err), ended.err
    assert ended.out == ""
    assert sorted(tmp_path.rglob("*")) == before


def test_a_mission_that_cannot_be_flown_so_is_refused_by_the_campaign(tmp_path: Path) -> None:
    ended = run_here("faults", str(HOVER), "--kinds", "gust", "--phases", "return")
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1 and "mission 'hover' has no phase 'return'" in ended.err
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("campaign", ["compare", "robustness", "faults"])
def test_a_campaign_refuses_a_mission_that_a_flight_refuses(tmp_path: Path, campaign: str) -> None:
    ended = run_here(
        campaign, *(() if campaign == "compare" else (str(CATCH),)), "--set", "mission.phases[2].to_m=[1.9, 0, 1]"
    )
    assert ended.code == EXIT_BAD_INPUT
    assert any("phase 'catch' leaves the room" in line for line in ended.err_lines)
    assert not any(tmp_path.iterdir())
