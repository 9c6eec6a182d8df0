"""Files appear whole or not at all."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from companion.runtime.files import write_whole


def test_a_reader_keeps_the_old_content_while_the_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "flight.pid"
    write_whole(path, b"123")
    with path.open("rb") as before:
        write_whole(path, b"4567", durable=True)
        assert before.read() == b"123"
    assert path.read_bytes() == b"4567"
    assert list(tmp_path.iterdir()) == [path]


def test_an_existing_file_is_not_replaced_when_that_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "operators.yaml"
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        write_whole(path, b"other", replace=False)
    assert path.read_bytes() == b"mine"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_written_leaves_no_part_behind(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError):
        write_whole(tmp_path / "folder", b"data")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_permissions_are_those_asked_for(tmp_path: Path) -> None:
    write_whole(tmp_path / "key", b"secret", mode=0o600)
    assert stat.S_IMODE((tmp_path / "key").stat().st_mode) == 0o600
