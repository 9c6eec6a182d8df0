"""YAML that is refused, and what scalars mean."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from companion.config.document import LINE_MAX, ConfigError, Document, Origin
from companion.config.yaml_strict import SIZE_MAX_BYTES, parse_value, read_document


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        ("-.5", -0.5),
        ("1.", 1.0),
        ("0x1F", 31),
        ("0o17", 15),
        ("017", 17),
        ("12:30", "12:30"),
        ("1_000", "1_000"),
        ("on", "on"),
        ("yes", "yes"),
        ("No", "No"),
        ("True", True),
        ("false", False),
        ("~", None),
        ("2024-01-01", "2024-01-01"),
        ("'1'", "1"),
        ("-.inf", -math.inf),
        ("{a: [1, b]}", {"a": [1, "b"]}),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: object) -> None:
    parsed = parse_value(text, Origin("test"))
    assert parsed == value
    assert type(parsed) is type(value)


def read(folder: Path, content: str | bytes) -> Document:
    path = folder / "f.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_document(path, "f.yaml")


BAD = [
    ("a: 1\nb: {c: 1}\na: 2\n", ["f.yaml:3:1: a: duplicate key, already given on line 1; remove one of the two"]),
    ("a:\n\tb: 1\n", ["f.yaml:2:1: not YAML: a tab; indent with spaces"]),
    ("a: [1, 2\n", ["f.yaml:2:1: not YAML: expected ',' or ']', but got '<stream end>' while parsing a flow sequence"]),
    ("a: b: c\n", ["f.yaml:1:5: not YAML: an unexpected ':'; check the line above, the quotes and the indentation"]),
    ("a: 1\nb\n", ["f.yaml:3:1: not YAML: a key without ':'"]),
    ("a: &x [1]\nb: *x\n", ["f.yaml:2:4: not YAML: aliases (*name) are not accepted; write the value out"]),
    (
        "a: !!float 1\n",
        ["f.yaml:1:4: not YAML: tags (tag:yaml.org,2002:float) are not accepted; write the plain value"],
    ),
    ("a: !!python/object:os.system x\n", None),
    ("<<: {a: 1}\n", ["f.yaml:1:1: merge keys (<<) are not accepted; write the keys out"]),
    ("[a]: 1\n", ["f.yaml:1:1: a key must be plain text"]),
    ("a: 1\n---\nb: 1\n", ["f.yaml:2:1: not YAML: a second document (---); only one per file is accepted"]),
    ("a: " + "[" * 5000 + "]" * 5000, ["f.yaml:1:35: not YAML: nested more than 32 levels deep"]),
    ("a: " + "9" * 5000, ["f.yaml:1:4: a: a number with 5000 digits; at most 400 are accepted"]),
    ('a: 1\nb: "\\uD800"\n', ["f.yaml:2:4: b: an escape"]),
    ('a: 1\n"\\uDFFF": 2\n', ["f.yaml:2:1: an escape"]),
    ('a: "\\U0011FFFF"\n', ["f.yaml:1:"]),
    ("%YAML 1." + "9" * 5000 + "\n---\na: 1\n", ["f.yaml:1:"]),
    ("a: \x07\n", ["f.yaml:1:4: not YAML: control character U+0007 is not allowed"]),
    ("a:\n\u00a0 b: 1\n", ["f.yaml:2:1: not YAML: no-break space (U+00A0); write an ordinary space"]),
    ("a:\n  \u3000b: 1\n", ["f.yaml:2:3: not YAML: ideographic space (U+3000); write an ordinary space"]),
    ("- 1\n", ["f.yaml:1:1: expected a mapping (key: value) at the top level, got a list"]),
    ("just text\n", ["f.yaml:1:1: expected a mapping (key: value) at the top level, got a single value"]),
    ("", ["f.yaml: is empty"]),
    ("# nothing\n", ["f.yaml: is empty"]),
]


@pytest.mark.parametrize(("text", "lines"), BAD, ids=range(len(BAD)))
def test_refused_text_is_reported_in_one_line_per_problem(tmp_path: Path, text: str, lines: list[str] | None) -> None:
    try:
        document = read(tmp_path, text)
    except ConfigError as error:
        found = list(error.lines)
    else:
        found = [str(problem) for problem in document.problems]
    assert len(found) == 1
    assert found[0].isprintable() and len(found[0]) <= LINE_MAX
    assert lines is None or found[0].startswith(lines[0])


@pytest.mark.parametrize("character", ["\x85", "\u2028", "\u2029"])
def test_a_separator_of_yaml_1_1_ends_neither_a_comment_nor_a_line(tmp_path: Path, character: str) -> None:
    document = read(tmp_path, f"a: 1  # copied{character}b: 2\nc: 'x{character}y\u00a0'\nc: 3\n")
    assert document.data == {"a": 1, "c": f"x{character}y\u00a0"}
    assert [str(problem.origin) for problem in document.problems] == ["f.yaml:3:1"]


@pytest.mark.parametrize(
    ("name", "refusal"),
    [
        ("none.yaml", r"none\.yaml: no such file$"),
        ("", "is a directory, expected a YAML file$"),
        ("a\0b", "not readable"),
        ("file/x.yaml", "not readable: Not a directory$"),
    ],
)
def test_what_is_no_file_is_refused(tmp_path: Path, name: str, refusal: str) -> None:
    (tmp_path / "file").write_text("a: 1")
    with pytest.raises(ConfigError, match=refusal):
        read_document(tmp_path / name)


def test_not_utf_8(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^f.yaml:2: not UTF-8 \(byte 0xe9\); save the file as UTF-8$"):
        read(tmp_path, b"a: 1\nname: caf\xe9\n")


def test_a_byte_order_mark_and_a_character_in_two_halves_are_accepted(tmp_path: Path) -> None:
    document = read(tmp_path, b'\xef\xbb\xbfa: "\\U0001F600"\n')
    assert (document.data, document.problems) == ({"a": "\U0001f600"}, [])


def test_too_large_a_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^f\.yaml: larger than 256 KiB; expected a configuration file"):
        read(tmp_path, b"#" * (SIZE_MAX_BYTES + 1))


def test_places_of_values_and_keys(tmp_path: Path) -> None:
    document = read(tmp_path, "a:\n  - b: 1\n    c: [2, 3]\n")
    assert str(document.origin(("a", 0, "c", 1))) == "f.yaml:3:12"
    assert str(document.key_origin(("a", 0, "c"))) == "f.yaml:3:5"
    assert str(document.origin(("a", 0, "missing"))) == "f.yaml:2:5"
