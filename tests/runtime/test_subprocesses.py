"""The folder for temporary files of a flight: made anew, and the only thing that is removed."""

from __future__ import annotations

from pathlib import Path

from companion.runtime.subprocesses import scratch_folder, write_text


def test_a_folder_that_was_there_before_is_not_removed(tmp_path: Path) -> None:
    """`companion fly --out ~` must not cost the user's own ~/tmp."""
    mine = tmp_path / "tmp/mine.txt"
    mine.parent.mkdir()
    mine.write_text("mine", encoding="utf-8")
    with scratch_folder(tmp_path) as scratch:
        assert scratch.is_dir() and scratch != mine.parent
        (scratch / "left").mkdir()
    assert mine.read_text(encoding="utf-8") == "mine"
    assert list(tmp_path.iterdir()) == [mine.parent]


def test_a_file_of_the_flights_folder_is_never_seen_half_written(tmp_path: Path) -> None:
    """Scripts take the number of a process from there."""
    path = tmp_path / "flight.pid"
    write_text(path, "123")
    with path.open(encoding="utf-8") as before:
        write_text(path, "4567")
        assert before.read() == "123"
    assert path.read_text(encoding="utf-8") == "4567"
    assert list(tmp_path.iterdir()) == [path]
