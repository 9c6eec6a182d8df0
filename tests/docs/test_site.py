"""The site builds without a warning and loads nothing from a network; reference, safety case and troubleshooting match the code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from companion.cli.schema import KINDS
from companion.model.types import SafetyAction
from companion.model.units import unit_of
from companion.safety.rule import Rule
from companion.safety.rules import RULES
from docs.site_hooks import COMMIT
from tests.support import DEADLINE_S
from tools.docs.reference import page

ROOT = Path(__file__).parents[2]
CASE, TROUBLE = ROOT / "docs/internals/safety-case.md", ROOT / "docs/troubleshooting.md"
LANDS = {SafetyAction.LAND, SafetyAction.AUTOPILOT_LAND, SafetyAction.TERMINATE}


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def lands(rule: Rule) -> bool:
    return bool(LANDS & {rule.ground, rule.air})


def rows() -> list[list[str]]:
    """Cells of every row of the safety case's tables of hazards."""
    found = []
    header = "| hazard | how it begins | monitor | action | test | what remains |"
    for table in text_of(CASE).split(header)[1:]:
        for line in table.strip().splitlines()[1:]:
            if not line.startswith("|"):
                break
            found.append([cell.strip() for cell in line.strip()[1:-1].split("|")])
    return found


@cache
def functions_of(file: str) -> frozenset[str]:
    return frozenset(
        node.name
        for node in ast.walk(ast.parse(text_of(ROOT / file)))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    )


# -- the site ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    return out


def test_every_page_of_docs_is_in_it(site: Path) -> None:
    for source in (ROOT / "docs").rglob("*.md"):
        assert (site / source.relative_to(ROOT / "docs").with_suffix(".html")).is_file(), source.name


def test_it_loads_nothing_from_a_network(site: Path) -> None:
    loads = r"""<(?:script|img|iframe|source)[^>]*\ssrc=["']?(?:https?:)?//|<link[^>]*\shref=["']?(?:https?:)?//"""
    for file in site.rglob("*.html"):
        assert re.search(loads, text_of(file)) is None, file.name
    for file in site.rglob("*.css"):
        assert re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", text_of(file)) is None, file.name
    assert (site / "search/search_index.json").is_file()


def test_figures_say_how_far_they_are_behind_the_code(site: Path) -> None:
    found = re.findall(r"at commit (\w+)(?: \((\d+) later commits)?", text_of(site / "internals/robustness.html"))
    assert found
    for commit, later in found:
        command = ["git", "rev-list", "--count", f"{commit}..HEAD", "--", "companion/control", "sitl"]
        counted = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert int(later or 0) >= int(counted.stdout or 0)


@pytest.mark.parametrize(
    ("text", "commits"),
    [
        ("flown at commit 8f25a11a.", ["8f25a11a"]),
        ("flown\nat commit\n1c535d28, seed 301", ["1c535d28"]),
        ("(169 of 200 at c9ff310e, compiled)", ["c9ff310e"]),
        ("commits a4b62edf and `e858b80e`", ["a4b62edf", "e858b80e"]),
        ("commit 12345678", ["12345678"]),
        ("2000000 baud in 57600000 flights of a facade", []),
    ],
)
def test_a_commit_is_found_in_every_form_that_pages_use(text: str, commits: list[str]) -> None:
    assert COMMIT.findall(text) == commits


# -- the reference -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_reference_is_what_the_models_say(kind: str) -> None:
    """Made by `python -m tools.docs.reference docs/internals/reference`."""
    assert text_of(ROOT / f"docs/internals/reference/{kind}.md") == page(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_every_key_of_every_section_is_in_it(kind: str) -> None:
    schema = KINDS[kind]().json_schema()
    told = set(re.findall(r"^\| `(\w+)` \|", page(kind), flags=re.M))
    models = [schema, *schema.get("$defs", {}).values()]
    assert told == {key for model in models for key in model.get("properties", {})}


@pytest.mark.parametrize(
    ("key", "expected"),
    [
        ("mass_kg", "kg"),
        ("inertia_kg_m2", "kg m^2"),
        ("jerk_max_m_s3", "m/s^3"),
        ("torque_per_amp_nm_a", "N m/A"),
        ("thrust_slew_max_per_s", "1/s"),
        ("zero_count", "counts"),
        ("moment_max_kg_m", "kg m"),
        ("stiffness_n_m", "N/m"),
        ("row_weights_s", None),
        ("phases", None),
        ("s", None),
    ],
)
def test_units_are_reported_by_the_name(key: str, expected: str | None) -> None:
    assert unit_of(key) == expected


# -- the safety case ---------------------------------------------------------------------------------------------------


def test_every_rule_that_it_names_exists_and_every_rule_that_lands_is_in_it() -> None:
    # In a cell of the monitors: an id, a command's name, or an event that no rule brings about.
    named = {name for row in rows() for name in re.findall(r"`(\w+)`", row[2])}
    known = {rule.id for rule in RULES}
    assert named - known == {"guardian_took_over", "disarm_refused"}
    assert {rule.id for rule in RULES if lands(rule)} <= named


def test_every_test_that_it_names_exists() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text_of(CASE))
    assert [f"{file}::{name}" for file, name in named if name not in functions_of(file)] == []


def test_every_hazard_has_all_that_belongs_to_it() -> None:
    assert len(rows()) > 30
    for row in rows():
        assert len(row) == 6, row[0]
        assert all(row[:5]), row[0]
        assert "::test_" in row[4], row[0]


# -- troubleshooting ---------------------------------------------------------------------------------------------------


def test_whatever_lands_is_among_the_symptoms() -> None:
    told = set(re.findall(r"`(\w+)`", text_of(TROUBLE)))
    assert {rule.id for rule in RULES if lands(rule)} <= told


def test_every_event_of_the_sequence_that_ends_a_flight_is_among_the_symptoms() -> None:
    safety = text_of(ROOT / "docs/internals/safety.md")
    table = safety.partition("| id | when |")[2].partition("\n## ")[0]
    ends = set(re.findall(r"^\| `(\w+)` \|.*(?:refused|lands)", table, flags=re.M))
    assert {"arming_refused", "no_touchdown"} <= ends <= set(re.findall(r"`(\w+)`", text_of(TROUBLE)))


def test_every_row_of_the_preflight_is_among_the_symptoms() -> None:
    listed = set(re.findall(r"^\| `(\w+\.\w+)` \|", text_of(ROOT / "docs/internals/preflight.md"), flags=re.M))
    assert len(listed) > 50
    assert listed <= set(re.findall(r"`(\w+\.\w+)`", text_of(TROUBLE)))
