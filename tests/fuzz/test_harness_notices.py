"""The fuzzing harness detects a faulty driver, and repeats an input."""

from __future__ import annotations

import ctypes
import os
import time
from random import Random
from typing import ClassVar, Self

import pytest

from benchmarks.fuzz import main, save
from benchmarks.fuzzing.campaign import Finding, Target, Wrong, feed_watched, generator, one_line, run
from benchmarks.fuzzing.mutate import mutated
from benchmarks.fuzzing.targets import NAMES, target_class


class Broken(Target):
    """A target that fails as its input says."""

    name: ClassVar[str] = "broken"

    def __init__(self, failing: bytes) -> None:
        self._failing = failing
        self.hoard: list[bytearray] = []
        self.files: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for file in self.files:
            os.close(file)

    def make(self, rng: Random) -> bytes:
        return self._failing if rng.random() < 0.5 else b""

    def feed(self, data: bytes) -> None:
        if data == b"raise":
            raise KeyError("armed")
        if data == b"wrong":
            raise Wrong("not understood")
        if data == b"hang":
            while True:
                try:
                    self._spin()
                except Exception:  # as a bus thread that outlives everything does
                    continue
        if data == b"hoard":
            self.hoard.append(bytearray(os.urandom(1 << 20)))
        if data == b"files":
            self.files.append(os.dup(0))

    def _spin(self) -> None:
        ctypes.c_int(1)


@pytest.mark.parametrize(
    ("failing", "text"), [(b"raise", "KeyError: 'armed'"), (b"wrong", "not understood")], ids=["exception", "wrong"]
)
def test_a_failure_is_found_with_its_index_and_input(failing: bytes, text: str) -> None:
    with Broken(failing) as target:
        stretch = run(target, 1, 0, 20)
        first = stretch.findings[0]
        assert text in first.text
        assert first.data == failing
        assert first.index is not None
        assert target.make(generator("broken", 1, first.index)) == failing


def test_a_call_that_does_not_return_is_found() -> None:
    with Broken(b"hang") as target:
        found = feed_watched(target, b"hang", cpu_limit_s=0.2)
    assert found is not None
    assert found.startswith("does not return: busy for 0.2 s")


@pytest.mark.parametrize(("failing", "text"), [(b"hoard", "memory grew"), (b"files", "open files grew")])
def test_what_piles_up_is_found(failing: bytes, text: str) -> None:
    with Broken(failing) as target:
        findings = run(target, 1, 0, 600).findings
    assert [finding.index for finding in findings] == [None]
    assert findings[0].text.startswith(text)


def test_a_run_ends_at_its_deadline() -> None:
    with Broken(b"") as target:
        assert run(target, 1, 0, 10**9, until_s=time.monotonic() + 0.2).inputs < 10**9
        assert run(target, 1, 0, 10**9, until_s=time.monotonic()).inputs == 0


def test_a_target_that_bears_everything_has_no_findings() -> None:
    with Broken(b"") as target:
        stretch = run(target, 1, 0, 600)
    assert stretch.findings == ()
    assert stretch.inputs == 600


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_and_index_make_the_same_input(name: str) -> None:
    one, other = target_class(name)(), target_class(name)()
    inputs = [one.make(generator(name, 3, index)) for index in range(200)]
    assert [other.make(generator(name, 3, index)) for index in reversed(range(200))][::-1] == inputs
    assert len(set(inputs)) > 150
    assert inputs != [one.make(generator(name, 4, index)) for index in range(200)]


def test_damage_keeps_to_its_size_and_is_damage() -> None:
    valid = [b"0123456789" * 5, b"abc" * 20]
    damaged = [mutated(Random(seed), valid, 80) for seed in range(500)]
    assert max(map(len, damaged[20:])) <= 400
    assert sum(data in valid for data in damaged) < 100


@pytest.mark.parametrize("text", ["", "two\nlines", "\x1b[2Jcleared", "half \ud800"])
def test_a_text_that_is_no_line_is_wrong(text: str) -> None:
    with pytest.raises(Wrong):
        one_line(text, "this")


def test_a_finding_is_saved_under_its_name(tmp_path: os.PathLike[str]) -> None:
    from pathlib import Path

    folder = Path(tmp_path)
    path = save(Finding(target="mavlink-wire", seed=1, index=93, text="text", data=b"\x00\x01"), folder)
    assert path == folder / "mavlink-wire-1-93.bin"
    assert path.read_bytes() == b"\x00\x01"
    assert save(Finding("natnet", 1, None, "memory grew"), folder) is None


def test_the_command_prints_a_table_and_ends_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["force", "--inputs", "300", "--jobs", "2"]) == 0
    out = capsys.readouterr().out
    assert "force" in out
    assert "300" in out


@pytest.mark.parametrize("options", [["nothing"], ["--inputs", "0"], ["--index", "1"]])
def test_bad_options_end_with_2(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(options)
    assert ended.value.code == 2
    assert "error:" in capsys.readouterr().err
