"""README and docs/ name what exists: files, headings, commands, keys, monitors, events, exit codes, channels."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.analysis.summary import summarise
from companion.cli.main import _normalised, make_parser
from companion.config.base import Model
from companion.config.controller import PRESETS, AdaptiveConfig
from companion.config.loader import load_flight
from companion.config.safety import Safety
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_CODES
from companion.model.types import SafetyAction
from companion.safety import notices
from companion.sitl_config.faults import KINDS
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.team import load_team
from companion.sitl_config.world import Fault, World
from sitl.autopilot.params import Params
from tools.docs.faults import kinds_markdown
from tools.docs.safety import tables as safety_tables
from tools.docs.tables import written

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "benchmarks/README.md", *(ROOT / "docs").rglob("*.md")])
COMMANDS, SAFETY, SITL = ROOT / "docs/commands.md", ROOT / "docs/internals/safety.md", ROOT / "docs/internals/sitl.md"
FAULTS, LABORATORY = ROOT / "docs/internals/faults.md", ROOT / "docs/internals/world.md"
LOG, LAW = ROOT / "docs/internals/log.md", ROOT / "docs/internals/control-law.md"
# What a flight writes, or what a user is reported to make: no files of the repository.
MADE_LATER = {
    "flight.mcap", "flight.log", "flight.pid", "guardian.log", "guardian.pid", "summary.json", "report.html", "config.json",
    "sitl_config.json", "sitl.log", "world.json", "preflight.json", "mine.yaml", "my_vehicle.yaml", "flights/",
    "compare.json", "compare.html", "LAW_PRESET.yaml", "identified_world.yaml", "identified.json", "columns.json",
}  # fmt: skip
EXAMPLES = (ROOT / "examples/law", ROOT / "examples/phase")
"""The folders that the readers of docs/own-law.md and docs/own-phase.md make."""
FOLDERS = ("companion", "sitl", "configs", "tests", "docs", "benchmarks")
KNOWN_NAMES = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")}
_FILE = re.compile(r"(?!/)[\w./-]*(?:\.(?:py|yaml|md|json|toml|txt|html|png|log|pid|mcap)|/)")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S)


def table(page: Path, *header: str) -> list[list[str]]:
    """Cells of the first table whose header row begins with these cells."""
    rows: list[list[str]] = []
    for line in text_of(page).splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]] if line.strip()[:1] == "|" else []
        if rows and not cells:
            break
        if rows or tuple(cells[: len(header)]) == header:
            rows.append(cells)
    assert len(rows) > 2, f"{page.name}: no table {header}"
    return rows[2:]


def codes(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


HAVE_PARTS = {"broker", "px4", "hover", "arm", "mocap", "ft"}
"""Commands whose second word is the name of a part: in running text that is a name, not a whole command."""


def commands() -> Iterator[tuple[str, list[str]]]:
    """Every `companion ...` line of a shell block, and in running text every one with an argument."""
    for page in PAGES:
        shell = "\n".join(re.findall(r"^```sh\n(.*?)^```", text_of(page), flags=re.M | re.S))
        inline = [code for code in codes(prose(page)) if "..." not in code]
        for line in [*shell.splitlines(), *inline]:
            words = shlex.split(line, comments=True) if line.startswith("companion ") else []
            named_only = line in inline and len(words) == 3 and words[1] in HAVE_PARTS
            if len(words) > 2 and not named_only:
                yield page.name, words[1:]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_file_names_exist(page: Path) -> None:
    wrong = []
    for target in re.findall(r"\]\(([^)]+)\)", prose(page)):
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            wrong.append(target)
    for name in codes(prose(page)):
        if not _FILE.fullmatch(name) or name in MADE_LATER or name.startswith("DIR/"):
            continue
        exists = (
            (ROOT / name).exists()
            or any((example / name).exists() for example in EXAMPLES)
            or ("/" not in name and name in KNOWN_NAMES)
        )
        if not exists:
            wrong.append(name)
    assert wrong == []


def test_pages_that_the_program_and_its_files_name_exist() -> None:
    texts = [
        text_of(path)
        for folder in ("companion", "sitl", "tools", "benchmarks", "configs")
        for suffix in ("py", "yaml", "conf", "json")
        for path in (ROOT / folder).rglob(f"*.{suffix}")
    ]
    named = {name for text in texts for name in re.findall(r"(?<![\w./])docs/[\w/-]+\.md", text)}
    assert len(named) > 10
    assert sorted(name for name in named if not (ROOT / name).is_file()) == []


def test_pages_for_users_name_no_commit() -> None:
    """Figures and their commits are in docs/internals."""
    pages = list((ROOT / "docs").glob("*.md"))
    assert len(pages) > 10
    assert [page.name for page in pages if re.search(r"\bcommit [0-9a-f]{7}", text_of(page))] == []


def test_files_to_begin_in_exist_and_hold_the_names_in_brackets() -> None:
    for cells in table(ROOT / "docs/internals/architecture.md", "to change"):
        for path, name in re.findall(r"`(\w+/[^`]+)`(?: \(`(\w+)`\))?", " ".join(cells)):
            assert (ROOT / path).exists() and (not name or re.search(rf"\b{name}\b", text_of(ROOT / path))), (
                path,
                name,
            )


def test_pictures_are_small() -> None:
    pictures = [path for path in (ROOT / "docs").rglob("pictures/*") if path.is_file()]
    assert pictures
    limits = {".png": 200_000, ".svg": 400_000, ".gif": 1_500_000}
    assert [picture.name for picture in pictures if picture.stat().st_size > limits[picture.suffix]] == []


def test_commands_parse_and_their_overrides_are_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    seen, loaded, parser = set(), set(), make_parser()
    for page, words in commands():
        seen.add(words[0])
        arguments, unknown = parser.parse_known_args(_normalised(words))
        assert unknown == [], f"{page}: companion {shlex.join(words)}"
        mission = getattr(arguments, "mission", None)
        # MISSION stands for any; a vehicle file that the user is to write is not there.
        of_flight = hasattr(arguments, "overrides")
        if of_flight and mission and mission.endswith(".yaml") and arguments.vehicle is None:
            law, preset, member = (getattr(arguments, name, None) for name in ("controller", "preset", "member"))
            settings = (mission, law, preset, member, tuple(arguments.overrides))
            if settings not in loaded and member is not None:
                load_team(mission, arguments.overrides, controller_law=law, preset=preset)
            elif settings not in loaded:
                load_sitl(mission, None, law, preset, arguments.overrides)
            loaded.add(settings)
    assert seen >= {"fly", "check", "sitl", "report", "replay", "schema"}


def test_every_command_is_shown() -> None:
    action = next(action for action in make_parser()._actions if action.dest == "command")
    shown = {words[0] for page, words in commands() if page == "commands.md"} | set(
        re.findall(r"^companion (\w+)", text_of(COMMANDS), flags=re.M)
    )
    assert action.choices is not None
    assert set(action.choices) <= shown


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^(\w+):", text_of(ROOT / "Makefile"), flags=re.M))
    told = {target for page in PAGES for target in re.findall(r"^make (\w+)", text_of(page), flags=re.M)}
    assert {"fly", "test"} <= told <= targets


def test_exit_codes_match() -> None:
    told = {outcome: int(row[0]) for row in table(COMMANDS, "exit code") for outcome in codes(row[1])}
    assert told == {outcome.value: code for outcome, code in EXIT_CODES.items()}
    assert [int(row[0]) for row in table(COMMANDS, "exit code") if not codes(row[1])] == [EXIT_BAD_INPUT]


def test_knobs_match() -> None:
    told = {codes(row[0])[0]: json.loads(row[1]) for row in table(SITL, "key", "default")}
    effects = {name for name, field in World.model_fields.items() if isinstance(field.default, Model)}
    assert told == json.loads(World().model_dump_json(exclude=effects))
    assert list(told) == [name for name in World.model_fields if name not in effects]
    switches = {name for row in table(LABORATORY, "effect", "what it does") for name in codes(row[4])}
    assert {f"{name}.on" for name in effects} <= switches


def test_faults_match() -> None:
    """Made by `python -m tools.docs.faults docs/internals/faults.md`."""
    assert written(text_of(FAULTS), {"kinds": kinds_markdown()}) == text_of(FAULTS)
    assert [codes(row[0])[0] for row in table(FAULTS, "kind", "what happens")] == list(KINDS)
    told = [name for row in table(FAULTS, "key", "meaning") for name in codes(row[0])]
    assert told == ["kind", "t_s", "after", "phase", "duration_s", "size", "servo"]
    assert set(told) == set(Fault.model_fields)


def test_the_stubs_parameters_are_counted() -> None:
    assert f"{len(Params())} of PX4's own" in text_of(SITL)


def test_monitors_and_ladder_match() -> None:
    """Made by `python -m tools.docs.safety docs/internals/safety.md`."""
    assert written(text_of(SAFETY), safety_tables()) == text_of(SAFETY)
    named = {key for row in table(SAFETY, "id", "what is found") for cell in row[2:4] for key in codes(cell)}
    told = set(codes(text_of(SAFETY)))
    assert {key for key in Safety.model_fields if key not in named} <= told


def test_every_notice_is_reported_by_the_core_or_a_phase() -> None:
    paths = [path for part in ("core", "phases") for path in sorted((ROOT / "companion" / part).rglob("*.py"))]
    core = "".join(map(text_of, paths))
    names = {name for name, value in vars(notices).items() if isinstance(value, notices.EventDefinition)}
    assert len(names) == len({notice.id for notice in notices.NOTICES}) == len(notices.NOTICES)
    assert names == set(re.findall(r"\bnotices\.([A-Z_]+)\b", core))


def test_ladder_matches() -> None:
    line = next(line for line in text_of(SAFETY).splitlines() if line.startswith("`nominal` ->"))
    assert codes(line.partition(".")[0]) == [action.value for action in SafetyAction]


def test_channels_match() -> None:
    source = "".join(text_of(path) for path in sorted((ROOT / "companion/recorder").glob("*.py")))
    made = {f"/{name}" for name in re.findall(r'(?:Channel|_json_channel)\(f?"/(?:{prefix})?(\w+)"', source)}
    assert {codes(row[0])[0] for row in table(LOG, "channel")} == made
    metadata = set(re.findall(r'metadata\("(\w+)"', source + text_of(ROOT / "companion/flight/main.py")))
    assert {codes(row[0])[0] for row in table(LOG, "metadata")} == metadata


def test_summary_keys_match() -> None:
    def leaves(value: Any, path: str = "") -> Iterator[str]:
        if isinstance(value, dict):
            for key, item in value.items():
                yield from leaves(item, f"{path}.{key}".lstrip("."))
        else:
            yield path

    made = set(leaves(summarise(None, outcome="completed", controller="adaptive", preset="paper")))
    assert {key for row in table(LOG, "key") for key in codes(row[0])} == made


def test_preset_table_matches() -> None:
    laws = {
        preset: load_flight(
            ROOT / "configs/missions/catch.yaml", preset=preset, overrides=["controller.found_for=null"]
        ).controller
        for preset in PRESETS["adaptive"]
    }
    for key, *cells in table(LAW, "key", "paper", "recommended", "model_free"):
        for preset, cell in zip(("paper", "recommended", "model_free"), cells, strict=True):
            law = laws[preset]
            assert isinstance(law, AdaptiveConfig)
            assert cell == preset_text(law, key), f"{key}, {preset}"


def preset_text(law: AdaptiveConfig, key: str) -> str:
    value = getattr(law, codes(key)[0])
    if value is None:
        return "absent"
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, tuple):
        return f"{value:g}"
    rows = value[6:8] if key.endswith("arm") else value if key == "`nu`" else value[0:3]
    return ", ".join(f"{number:g}" for number in rows)
