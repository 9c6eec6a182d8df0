"""The figures of the docs carry the command and the commit that they come from."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from companion.campaigns import compare_plots, robustness_plots
from companion.cli.main import main
from tests.support import SHORT_CATCH
from tools.docs import compare as compare_doc
from tools.docs import faults as faults_table
from tools.docs import robustness as robustness_doc
from tools.docs.tables import flown_by

COMPARED = "--controllers adaptive --presets recommended --payloads 0.2 --seeds 1 --ablation"
RUNS = {
    "compare": (
        "compare.json",
        ["--mission", str(SHORT_CATCH), *shlex.split(COMPARED)],
    ),
    "robustness": ("robustness.json", [str(SHORT_CATCH), "--draws", "2"]),
    "faults": ("faults.json", [str(SHORT_CATCH), "--kinds", "force_loss", "--phases", "line"]),
}
PAGES = {
    "compare": (("laws", "ablation"), compare_doc.main),
    "robustness": (("result",), robustness_doc.main),
    "faults": (("kinds", "campaign"), faults_table.main),
}


@pytest.mark.parametrize("name", RUNS)
def test_a_campaign_notes_its_command_and_the_page_prints_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (compare_plots, robustness_plots):  # nobody looks at the pictures
        monkeypatch.setattr(module, "write_png", lambda figure, path: path.write_bytes(b"drawn"))
    file, options = RUNS[name]
    words = [name, *options, "--jobs", "1", "--out", str(tmp_path)]
    assert main(words) == 0
    results = json.loads((tmp_path / file).read_text(encoding="utf-8"))
    command = shlex.join(["companion", *words])
    assert results["settings"]["command"] == command
    tables, write = PAGES[name]
    page = tmp_path / "page.md"
    page.write_text(
        "".join(f"<!-- table: {table} -->\nthe old one\n<!-- end: {table} -->\n" for table in tables), encoding="utf-8"
    )
    assert write([str(page), str(tmp_path / file)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "the old one" not in text
    shown = re.sub(r" --out \S+", "", command)
    assert text.count(f"Flown by `{shown}` at commit {results['versions']['git'][:10]}") == (
        2 if name == "compare" else 1
    )


def test_a_file_that_names_no_command_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "compare.json"
    file.write_text(json.dumps({"aggregate": [], "settings": {}, "versions": {}}), encoding="utf-8")
    assert compare_doc.main(["page.md", str(file)]) == 2
    assert capsys.readouterr().err == f"{file}: key 'command' is missing\n"


def test_changes_beyond_the_commit_are_named() -> None:
    results: dict[str, Any] = {"settings": {"command": "companion compare"}, "versions": {"git": 40 * "a" + "-dirty"}}
    assert flown_by(results).strip() == "Flown by `companion compare` at commit aaaaaaaaaa with changes."
