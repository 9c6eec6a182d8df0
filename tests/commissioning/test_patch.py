"""A patch changes what it says and nothing else: comments, order, the places of other values; refusals are one line."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.cli.main import make_parser
from companion.commissioning import patch
from companion.commissioning.patch import propose
from companion.commissioning.tool import ARM, SENSORS, Report, Session, Tool, run_tool
from companion.commissioning.yaml_edit import edited
from companion.config.document import ConfigError, Data, Origin
from companion.config.loader import load_vehicle
from companion.config.yaml_strict import parse_value, read_document
from companion.model.exit_codes import EXIT_REFUSED
from companion.preflight.checks import Check
from tests.support import ROOT

SHIPPED = ROOT / "configs/vehicles/tarot650_2r.yaml"


def test_only_a_tool_that_writes_the_vehicle_file_refuses_the_shipped_one() -> None:
    with pytest.raises(ConfigError, match=r"^companion arm: --write: tarot650_2r is part of the installation"):
        Session(make_parser().parse_args(["arm", "friction", "--write"]), ARM)
    writes_a_parameter = Session(make_parser().parse_args(["latency", "--write"]), SENSORS)
    assert writes_a_parameter.vehicle.name == "tarot650-2r"


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    return Path(shutil.copy(SHIPPED, tmp_path / "mine.yaml"))


def parsed(text: str) -> Data:
    return parse_value(text, Origin("text"))


def test_a_patch_shows_what_it_replaces_and_writes_only_that(mine: Path) -> None:
    before = mine.read_text(encoding="utf-8").splitlines()
    patch = propose(mine, {("arm", "joints", 0, "sign"): -1, ("arm", "joints", 1, "zero_count"): 3101})
    lines = {change.key: change.origin.line for change in patch.changes if change.origin is not None}
    told = [line.split("#")[0].split() for line in patch.text.splitlines()]
    assert told[:2] == [["---", str(mine)], ["+++", str(mine)]]
    assert any(line[0] == "@@" and line[1].startswith(f"-{lines['arm.joints[0].sign'] - 1},") for line in told)
    assert {first: rest[-1] for first, *rest in told if "sign:" in rest} == {"-": "1", "+": "-1"}
    assert mine.read_text(encoding="utf-8").splitlines() == before, "nothing is written unasked"

    backup = patch.write()
    assert backup.read_text(encoding="utf-8").splitlines() == before
    after = mine.read_text(encoding="utf-8").splitlines()
    differ = [number for number, (a, b) in enumerate(zip(before, after, strict=True), 1) if a != b]
    assert differ == sorted(lines.values())
    comment = [line for line in after if "present position (register 132)" in line]
    assert comment == [line for line in before if "present position (register 132)" in line]
    joints = load_vehicle(mine).arm.joints
    assert (joints[0].sign, joints[1].zero_count) == (-1, 3101)

    assert not propose(mine, {("arm", "joints", 0, "sign"): -1})
    again = propose(mine, {("arm", "joints", 0, "sign"): 1}).write()
    assert again != backup and again.exists() and backup.exists()


def test_what_the_file_leaves_to_its_default_is_added_to_its_block(mine: Path) -> None:
    patch = propose(mine, {("arm", "joint_friction_nm"): 0.08, ("ground", "mqtt", "commands"): False})
    patch.write()
    vehicle = load_vehicle(mine)
    assert vehicle.arm.joint_friction_nm == 0.08
    assert vehicle.ground.mqtt is not None and vehicle.ground.mqtt.commands is False
    lines = mine.read_text(encoding="utf-8").splitlines()
    [before] = [number for number, line in enumerate(lines) if line.startswith("  joint_armature_kg_m2: ")]
    assert lines[before + 1] == "  joint_friction_nm: 0.08"


@pytest.mark.parametrize(
    ("location", "value", "words"),
    [
        (("arm", "joints", 0, "sign"), 0, "arm.joints[0].sign"),
        (("arm", "joints", 1, "servo_id"), 1, "joint 1 has the servo id 1 too"),
        (("arm", "jonits"), 1, "unknown key"),
        (("arm", "joints", 2, "sign"), 1, "there is no such key"),
        (("arm", "joints"), [], "a different structure"),
    ],
)
def test_a_patch_that_makes_the_file_invalid_is_refused(
    mine: Path, location: tuple[str | int, ...], value: Data, words: str
) -> None:
    before = mine.read_bytes()
    with pytest.raises(ConfigError) as caught:
        propose(mine, {location: value})
    assert words in str(caught.value) and str(mine) in str(caught.value)
    assert len(caught.value.lines) == 1
    assert mine.read_bytes() == before and list(mine.parent.iterdir()) == [mine]


def without_arm(text: str) -> str:
    """Return the vehicle file without arm, tool and force sensor."""
    data = yaml.safe_load(text)
    devices = {**data["devices"], "arm": None, "force": None}
    return yaml.safe_dump({**data, "arm": None, "tool": None, "devices": devices})


@pytest.mark.parametrize(
    "change",
    [
        without_arm,
        lambda text: text.replace("tether:\n", "tether:\n  react_time_s: 0.3\n", 1),
        lambda text: f"# a\u2028b\u0085c: [\n{text}",
    ],
    ids=["without an arm", "with a key of version 0.1.0", "with a line separator of YAML 1.1 in a comment"],
)
def test_every_file_that_can_be_loaded_can_be_changed(mine: Path, change: Callable[[str], str]) -> None:
    mine.write_text(change(mine.read_text(encoding="utf-8")), encoding="utf-8")
    load_vehicle(mine)
    propose(mine, {("devices", "mocap", "rigid_body_id"): 7}).write()
    assert load_vehicle(mine).devices.mocap.rigid_body_id == 7


@pytest.mark.parametrize(
    ("value", "told"), [(7, "cannot be written: Read-only file system"), (-1, "(after the proposed change)")]
)
def test_what_was_measured_is_printed_even_if_the_file_cannot_be_changed(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], value: int, told: str
) -> None:
    def write_whole(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(patch, "write_whole", write_whole)
    report = Report(text=["measured"], changes={("devices", "mocap", "rigid_body_id"): value})
    arguments = make_parser().parse_args(["mocap", "check", "--vehicle", str(mine), "--write", "--yes"])
    with pytest.raises(ConfigError, match=re.escape(told)):
        run_tool(Tool("mocap check", SENSORS, lambda _: None, lambda *_: report), arguments)
    printed = capsys.readouterr().out
    assert printed.startswith("measured\n") and "add --write" not in printed
    assert ("+    rigid_body_id: 7" in printed) is (value == 7)


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_what_was_measured_is_printed_before_the_question_whether_to_write_it(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: tuple[str, ...]
) -> None:
    read: list[str] = []

    class Keyboard:
        """A user who reads what is on the screen before answering no."""

        def isatty(self) -> bool:
            return True

        def readline(self, *_: object) -> str:
            read.append("".join(capsys.readouterr()))
            return "n\n"

    monkeypatch.setattr("sys.stdin", Keyboard())
    rows = [Check("mocap.body", "body", why="").row(True, "is number 7", "", "")]
    report = Report(
        rows, text=["measured"], changes={("devices", "mocap", "rigid_body_id"): 7}, advice=["measure again"]
    )
    arguments = make_parser().parse_args(["mocap", "check", "--vehicle", str(mine), "--write", *options])
    assert run_tool(Tool("mocap check", SENSORS, lambda _: None, lambda *_: report), arguments) == EXIT_REFUSED
    [shown] = read
    assert all(text in shown for text in ("measured", "is number 7", "measure again", "+    rigid_body_id: 7", "[y/N]"))
    assert ("is number 7" in capsys.readouterr().out) is bool(options), "printed once, and in the JSON"


def test_a_file_that_was_changed_meanwhile_is_not_written(mine: Path) -> None:
    patch = propose(mine, {("arm", "joints", 0, "sign"): -1})
    mine.write_bytes(mine.read_bytes() + b"# somebody else\n")
    before = mine.read_bytes()
    with pytest.raises(ConfigError, match="has changed since it was read"):
        patch.write()
    assert mine.read_bytes() == before and list(mine.parent.iterdir()) == [mine]


def test_byte_order_mark_line_ends_and_mode_stay(mine: Path) -> None:
    mine.write_bytes(b"\xef\xbb\xbf" + mine.read_bytes().replace(b"\n", b"\r\n"))
    mine.chmod(0o640)
    before = mine.read_bytes()
    propose(mine, {("arm", "joints", 0, "sign"): -1, ("arm", "joint_friction_nm"): 0.05}).write()
    after = mine.read_bytes()
    assert after.startswith(b"\xef\xbb\xbf") and after.count(b"\n") == after.count(b"\r\n") == before.count(b"\n") + 1
    assert mine.stat().st_mode & 0o777 == 0o640


def test_a_symbolic_link_is_kept(mine: Path) -> None:
    link = mine.with_name("link.yaml")
    link.symlink_to(mine.name)
    propose(link, {("arm", "joints", 0, "sign"): -1}).write()
    assert link.is_symlink() and load_vehicle(mine).arm.joints[0].sign == -1


@pytest.mark.parametrize(
    ("text", "location", "value", "expected"),
    [
        ("a: 1", ("b",), 2, "a: 1\nb: 2\n"),
        ("a: {b: 1}  # c\n", ("a", "d"), 2, "a: {b: 1, d: 2}  # c\n"),
        ("a: {}\n", ("a", "b", "c"), 2, "a: {b: {c: 2}}\n"),
        ("a:\n  b: 1\n\n# end\n", ("a", "c"), "x y", 'a:\n  b: 1\n  c: "x y"\n\n# end\n'),
        ("a:   # nothing yet\nb: 1\n", ("a",), 5, "a: 5  # nothing yet\nb: 1\n"),
        ("a: 10  # ten\n", ("a",), 1000, "a: 1000  # ten\n"),
        ("a: 1000  # thousand\n", ("a",), 10, "a: 10    # thousand\n"),
        ("a:\n- 1  # one\n- 2\nb: 0\n", ("a",), [3, 4], "a:\n- 3  # one\n- 4\nb: 0\n"),
        ("a: |\n  text\nb: 1\n", ("a",), "on", "a: on\nb: 1\n"),
        (
            "a:\n  - b:\n      c: 1\n    d: 2\n",
            ("a", 0, "b", "e"),
            True,
            "a:\n  - b:\n      c: 1\n      e: true\n    d: 2\n",
        ),
    ],
)
def test_the_place_of_an_edited_value(text: str, location: tuple[str | int, ...], value: Data, expected: str) -> None:
    assert edited(text, {location: value}) == expected


@example("\x85")
@settings(max_examples=50)
@given(st.recursive(st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
                    lambda inner: st.lists(inner, max_size=3), max_leaves=5))  # fmt: skip
def test_an_edited_value_is_read_back(value: Data) -> None:
    assert parsed(edited("a: 0  # c\nb: [1]\n", {("a",): value})) == {"a": value, "b": [1]}


def test_every_special_character_is_read_back() -> None:
    """Alone, first, in the middle and last; NEL, LS, PS, BOM, NBSP, DEL and C1 too, which YAML 1.1 folds, breaks or strips."""
    for first in (0, 0x100, 0x2000):
        characters = [chr(code) for code in range(first, first + 0x100)]
        values: list[Data] = [text for c in characters for text in (c, f"{c}ab", f"a{c}b", f"ab{c}")]
        assert parsed(edited("a: 0  # c\nb: [1]\n", {("a",): values})) == {"a": values, "b": [1]}
        keys: Data = dict.fromkeys((f"a{c}" for c in characters), 1)
        assert parsed(edited("a: 0\n", {("a",): keys})) == {"a": keys}
    for c in "\ufeff\ufffd\U0001f600\U0010ffff":
        assert parsed(edited("a: 0\n", {("a",): f"{c}ab{c}"})) == {"a": f"{c}ab{c}"}


def test_a_new_key_is_quoted_where_it_must_be() -> None:
    assert parsed(edited("a: {}\n", {("a", "x: y"): 1, ("\x85",): 2})) == {"a": {"x: y": 1}, "\x85": 2}


def test_every_third_value_of_the_shipped_file_can_be_replaced() -> None:
    text, shipped = SHIPPED.read_text(encoding="utf-8"), read_document(SHIPPED)
    for location in [at for at in shipped.values if at and not isinstance(shipped.get(at), dict | list)][::3]:
        document = read_document(SHIPPED)
        document.data = parsed(text)  # type: ignore[assignment]
        document.replace(location, 123456, Origin("test"))
        assert parsed(edited(text, {location: 123456})) == document.data, location
