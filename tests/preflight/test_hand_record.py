"""The record of passed hand tests: what it holds for, where it lies, and what becomes of a damaged one."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from companion.config.loader import load_flight
from companion.model.check_row import Row
from companion.preflight.hand_test.record import (
    Passed,
    RecordError,
    Setup,
    load,
    on_record,
    record_path,
    save,
    with_passed,
)
from tests.support import CATCH

SETUP = Setup(vehicle="tarot650-2r", server="192.168.1.10", rigid_body_id=1, up_axis="z", natnet_version="4.1")
AT = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
ROWS = [Row(id="hand.forward", title="hand test: forward", ok=True, read="felt 0.29 m forward")]


def one() -> list[Passed]:
    return with_passed([], SETUP, AT, ROWS)


def test_the_set_up_is_that_of_the_vehicle_file_and_the_server() -> None:
    assert Setup.of(load_flight(CATCH).vehicle, "4.1") == SETUP


def test_a_passed_test_counts_for_its_own_set_up() -> None:
    assert on_record(SETUP, one()) == ("passed on 2026-03-04T05:06:07+00:00", "")
    assert on_record(SETUP, []) == ("", "")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"server": "10.0.0.2"}, "server changed from 192.168.1.10 to 10.0.0.2"),
        ({"rigid_body_id": 2}, "rigid_body_id changed from 1 to 2"),
        ({"up_axis": "y"}, "up_axis changed from z to y"),
        ({"natnet_version": "3.0"}, "natnet_version changed from 4.1 to 3.0"),
    ],
)
def test_what_has_changed_since_then_is_reported(change: dict[str, Any], told: str) -> None:
    passed, changed = on_record(replace(SETUP, **change), one())
    assert not passed
    assert changed == f"passed on 2026-03-04T05:06:07+00:00, but since then {told}"


def test_another_vehicle_has_no_part_in_it() -> None:
    assert on_record(replace(SETUP, vehicle="other"), one()) == ("", "")


def test_it_comes_back_from_its_file_and_a_newer_one_takes_its_place(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "hand-tests.json"
    assert load(path) == []
    other = replace(SETUP, vehicle="other")
    tests = with_passed(one(), other, AT, ROWS)
    save(path, tests)
    assert load(path) == tests
    later = with_passed(load(path), SETUP, AT.replace(year=2027), ROWS)
    save(path, later)
    assert len(load(path)) == 2
    assert on_record(SETUP, load(path))[0].startswith("passed on 2027")
    assert on_record(other, load(path))[0].startswith("passed on 2026")
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"schema_version": 2, "passed": []}', '{"schema_version": 1, "passed": [{"setup": {}, "at": ""}]}'],
)  # fmt: skip
def test_a_damaged_record_is_one_clear_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "hand-tests.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RecordError, match=r"hand-tests\.json: .*remove the file") as told:
        load(path)
    assert "\n" not in str(told.value)


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(RecordError, match="cannot be written"):
        save(tmp_path / "file" / "hand-tests.json", one())
    with pytest.raises(RecordError, match="cannot be read"):
        load(tmp_path / "file" / "hand-tests.json")


def test_it_lies_in_the_user_s_state_folder() -> None:
    assert record_path({"XDG_STATE_HOME": "/var/state"}) == Path("/var/state/companion/hand-tests.json")
    home = Path.home() / ".local/state/companion/hand-tests.json"
    assert record_path({}) == record_path({"XDG_STATE_HOME": ""}) == record_path({"XDG_STATE_HOME": "rel"}) == home
