"""The folder for temporary files of a flight: made anew, and the only thing that is removed."""

from __future__ import annotations

from pathlib import Path

from companion.runtime.subprocesses import scratch_folder


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
