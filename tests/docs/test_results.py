"""The figures of the docs carry the command and the commit that they come from."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from companion.analysis import plot_style
from companion.campaigns.robustness import plots as robustness_plots
from companion.campaigns.runner import Row
from companion.cli.main import main
from tests.campaigns.made_up import compare_row, draw_row, fault_row, fly_made_up
from tests.support import CATCH
from tools.docs import compare as compare_doc
from tools.docs import faults as faults_doc
from tools.docs import robustness as robustness_doc
from tools.docs.tables import flown_by

RUNS = {
    "compare": ["--mission", str(CATCH), "--payloads", "0.2", "--seeds", "1", "--model-error", "0,0.2", "--ablation"],
    "robustness": [str(CATCH), "--draws", "2"],
    "faults": [str(CATCH), "--kinds", "force_loss", "--phases", "line"],
}
FLIGHT: dict[str, Any] = {"controller": "adaptive", "preset": "paper", "payload_kg": 0.2, "seed": 1}
ROWS: dict[str, Callable[[dict[str, Any]], Row]] = {
    "compare": compare_row,
    "robustness": lambda flight: draw_row(flight["number"], 0.02),
    "faults": fault_row,
}
PAGES = {
    "compare": (
        ("published", "extras", "differences", "model error", "adaptation", "ablation", "told"),
        compare_doc.main,
    ),
    "robustness": (("result",), robustness_doc.main),
    "faults": (("kinds", "campaign"), faults_doc.main),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_campaign_notes_its_command_and_the_page_prints_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (plot_style, robustness_plots):  # nobody looks at the plots
        monkeypatch.setattr(module, "write_png", lambda figure, path: path.write_bytes(b"drawn"))
    fly_made_up(monkeypatch, ROWS[name])
    words = [name, *RUNS[name], "--out", str(tmp_path)]
    assert main(words) == 0
    file = tmp_path / f"{name}.json"
    results = json.loads(file.read_text(encoding="utf-8"))
    command = shlex.join(["companion", *words])
    assert results["settings"]["command"] == command
    tables, write = PAGES[name]
    page = tmp_path / "page.md"
    page.write_text(
        "".join(f"<!-- table: {table} -->\nthe old one\n<!-- end: {table} -->\n" for table in tables), encoding="utf-8"
    )
    assert write([str(page), str(file)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "the old one" not in text
    shown = re.sub(r" --out \S+", "", command)
    assert text.count(f"Flown by `{shown}` at commit {results['versions']['git'][:10]}") == (
        5 if name == "compare" else 1
    )


def test_a_file_that_names_no_command_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "compare.json"
    file.write_text(
        json.dumps({"rows": [compare_row(FLIGHT)], "settings": {"world": "lab"}, "versions": {}}), encoding="utf-8"
    )
    assert compare_doc.main(["page.md", str(file)]) == 2
    assert capsys.readouterr().err == f"{file}: key 'command' is missing\n"


def test_changes_beyond_the_commit_are_named() -> None:
    results: dict[str, Any] = {"settings": {"command": "companion compare"}, "versions": {"git": 40 * "a" + "-dirty"}}
    assert flown_by(results).strip() == "Flown by `companion compare` at commit aaaaaaaaaa with changes."


def compared(world: str = "lab", first_seed: int = 1) -> dict[str, Any]:
    """A compare.json of three laws with the adaptation on and off, in three laboratories."""
    after_m = {
        ("adaptive", "paper"): 0.2,
        ("adaptive", "paper - adaptation off"): 0.4,
        ("psc", "tuned"): 0.1,
        ("csc", "tuned"): None,
    }
    rows = [
        compare_row({**FLIGHT, "controller": law, "preset": preset, "seed": seed}, e_p_m)
        for (law, preset), e_p_m in after_m.items()
        for seed in range(first_seed, first_seed + 3)
    ]
    command = f"companion compare --first-seed {first_seed}"
    return {"rows": rows, "settings": {"world": world, "command": command}, "versions": {"git": 40 * "a"}}


def test_baselines_and_soft_laws_have_tables_of_their_own() -> None:
    results = compared()
    for law, preset in (("pid", "tuned"), ("examples/compare/psc_soft.yaml", "soft")):
        results["rows"] += [compare_row({**FLIGHT, "controller": law, "preset": preset, "seed": 1}, 0.3)]
    made = compare_doc.tables([results])
    assert "| pid/tuned |" in made["baselines"]
    assert "| psc_soft/soft |" in made["soft"]
    assert "pid" not in made["published"] and "soft" not in made["baselines"]


def test_the_page_says_how_the_laboratory_differs_from_the_paper() -> None:
    made = compare_doc.tables([compared(first_seed=1), compared(first_seed=4)])
    assert "0.200 m at 0.2 kg (printed: 0.165, ratio 1.2)" in made["differences"]
    assert "* CSC (csc/tuned) after the catch: failed at 0.2 kg (printed: 0.293)." in made["differences"]
    assert "at 0.2 kg: PSC, proposed, CSC (printed: proposed, PSC, CSC)" in made["differences"]
    assert "| csc/tuned | 0 of 6 (6 crashed) | 0.010 (0.010) | – |" in made["published"]
    assert "| 1.0 / 3.0 | 0.091 / 0.165 |" in made["published"], "attitude, then the printed position errors"
    assert "6 laboratories (seeds 1 to 6), 18 flights" in made["published"]
    assert made["published"].count("Flown by") == 2
    assert "| adaptive/paper | 0.2 kg | 0 % | 0.400 | 0.200 | -50 % | 6 of 6 | 0.03 |" in made["adaptation"]
    assert made.keys().isdisjoint(("model error", "extras")), "not flown: the page keeps its tables"


def test_campaigns_of_a_team_are_compared_with_the_first_draw_by_draw(tmp_path: Path) -> None:
    """The draws of the second one are in another order, one of its flights was not completed, and its draw 9 has no pair."""

    def campaign(factor: float, numbers: Sequence[int], command: str) -> dict[str, Any]:
        rows = [
            {
                "number": number, "outcome": "completed", "bar_p_rms_m": factor * (0.02 + 0.001 * number), "bar_tilt_rms_deg": 1.0,
                "internal_force_rms_n": factor, "share": 0.5 if number else 0.56, "share_wanted": 0.5,
            }
            for number in numbers
        ]  # fmt: skip
        return {"rows": rows, "settings": {"command": command, "team": "carry"}, "versions": {"git": "0123456789ab"}}

    shipped, stiff = (
        campaign(1.0, range(8), "companion one"),
        campaign(2.0, [7, 6, 5, 4, 3, 2, 1, 9, 0], "companion two"),
    )
    stiff["rows"][-1] |= {"outcome": "crashed", "bar_p_rms_m": None}
    page, files = tmp_path / "page.md", {name: tmp_path / f"{name}.json" for name in ("shipped", "stiff")}
    for file, results in zip(files.values(), (shipped, stiff), strict=True):
        file.write_text(json.dumps(results), encoding="utf-8")
    page.write_text("<!-- table: carry -->\nthe old one\n<!-- end: carry -->\n", encoding="utf-8")
    assert robustness_doc.main([str(page), str(files["shipped"]), "--beside", "stiff", str(files["stiff"])]) == 0
    _, _, _, first, second, *_ = page.read_text(encoding="utf-8").splitlines()
    assert first == "| as shipped | 8: 8 completed | 23.5 / 26.6 | 1.00 / 1.00 | 1.00 / 1.00 | 7 of 8 |"
    assert second == (
        "| stiff | 9: 8 completed, 1 crashed | 49.0 / 56.6; 2.00 (2.00 to 2.00) | 1.00 / 1.00; 1.00 (1.00 to 1.00) "
        "| 2.00 / 2.00; 2.00 (2.00 to 2.00) | 8 of 8 |"
    )
