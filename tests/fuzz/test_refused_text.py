"""Rejected YAML is reported with the correct place, in one readable line."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config.document import LINE_MAX, ConfigError, Origin
from companion.config.loader import load_vehicle
from companion.config.yaml_strict import parse_value, read_document


@pytest.mark.parametrize(
    ("text", "place"),
    [('a: 1\nb: "\\uD800"\n', "f.yaml:2:4: b: an escape"), ('a: 1\n"\\uDFFF": 2\n', "f.yaml:2:1: an escape")],
)
def test_half_a_character_is_refused_where_it_stands(tmp_path: Path, text: str, place: str) -> None:
    path = tmp_path / "f.yaml"
    path.write_text(text, encoding="utf-8")
    problems = read_document(path, "f.yaml").problems
    assert [str(problem).startswith(place) for problem in problems] == [True]


def test_a_pair_of_halves_is_the_character(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text('a: "\\U0001F600"\n', encoding="utf-8")
    document = read_document(path)
    assert document.data == {"a": "\U0001f600"}
    assert document.problems == []


@pytest.mark.parametrize("text", ['a: "\\U0011FFFF"\n', "%YAML 1." + "9" * 5000 + "\n---\na: 1\n"])
def test_what_pyyaml_cannot_convert_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "f.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        read_document(path, "f.yaml")
    assert caught.value.lines[0].startswith("f.yaml:1:")
    assert len(caught.value.lines[0]) <= LINE_MAX


def test_an_option_that_cannot_be_converted_is_refused_by_its_name() -> None:
    with pytest.raises(ConfigError, match=r"^--set world\.x: not YAML"):
        parse_value('"\\UFFFFFFFF"', Origin("--set world.x"))


def test_keys_and_values_cannot_steer_the_terminal_or_flood_it(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_text('"name\\e[2J\\n": 1\nairframe: {mass_kg: "' + "9" * 5000 + '"}\n', encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_vehicle(path)
    assert all(line.isprintable() and len(line) <= LINE_MAX for line in caught.value.lines)
    assert any("name\\x1b[2J\\n" in line for line in caught.value.lines)


def test_a_line_that_fits_is_left_as_it_is() -> None:
    lines = ["f.yaml:1:1: Größe: expected a number, got ü"]
    assert list(ConfigError(lines).lines) == lines
