"""`python -m tests.stages [STAGE ...]`: run the stages of `make test`, all of them, and sum them up.

A stage that fails does not stop the others. Tests that compute, and the check of types, run beside tests that wait and fly, with the
lowest priority (`tests.low_priority`). The last line counts tests; each check (format, lint, imports, types) counts as one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.at_a_time import AT_A_TIME, at_a_time, core_is_taken, is_taken_within, real_time
from tests.low_priority import EQUAL, LOW, OURS, PLACE
from tests.marked import TESTS, files_of

_BIN = Path(sys.executable).parent
_PYTEST = (sys.executable, "-m", "pytest")
_INTERRUPTED = 130
_LINE_MAX = 120
_TALLY, _OUTPUT = "tally.json", "output"


@dataclass(frozen=True, slots=True)
class Stage:
    """One command."""

    name: str
    command: tuple[str, ...]
    tests: bool
    """Whether the command is pytest, which lists its results."""
    beside: bool = False
    """Whether it runs beside the stages after it, on what they leave of the processors. Its output follows theirs."""


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one stage."""

    stage: Stage
    ok: bool
    duration_s: float
    passed: int
    failed: int
    failed_tests: tuple[str, ...] = ()
    """Node ids. Empty if the stage failed as a whole."""
    skipped: Mapping[str, int] = field(default_factory=dict)
    """Number of tests by reason."""


def _files_of(mark: str) -> Iterable[str]:
    return (str(path.relative_to(TESTS.parent)) for path in files_of(mark))


STAGES = (
    Stage("format", (str(_BIN / "ruff"), "format", "--check", "."), tests=False),
    Stage("lint", (str(_BIN / "ruff"), "check", "."), tests=False),
    Stage("imports", (str(_BIN / "lint-imports"), "--no-cache"), tests=False),
    Stage(
        "computing",
        (
            *(*_PYTEST, "-p", "tests.low_priority", "-n", "2", "--dist", "loadfile", "-o", "timeout=600"),
            *("-m", "not flight and not waits"),
        ),
        tests=True,
        beside=True,
    ),
    Stage("types", (str(_BIN / "mypy"),), tests=False, beside=True),
    Stage("waiting", (*_PYTEST, "--dist", "loadgroup", "-m", "waits", *_files_of("waits")), tests=True),
    Stage("flights", (*_PYTEST, "--dist", "loadgroup", "-m", "flight and not alone", *_files_of("flight")), tests=True),
    Stage("alone", (*_PYTEST, "-m", "alone", *_files_of("alone")), tests=True),
)
"""In turn: what checks the text, what computes, what waits for real processes, what flies."""


def _shown(words: Iterable[str]) -> str:
    """Return the command as one types it here, in the project's folder."""
    here = f"{Path.cwd()}/"
    return shlex.join(word.removeprefix(here) for word in words)


@dataclass(frozen=True, slots=True)
class Running:
    """A stage that was started."""

    stage: Stage
    process: subprocess.Popen[bytes]
    begun_s: float
    folder: Path
    """Its own. Holds `tally.json` when pytest has ended, and the output of a stage that runs beside others in `output`."""


def start(stage: Stage, folder: Path, *, beside: bool = False) -> Running:
    """Start one stage; its output goes where ours goes, or into a file if it runs beside others."""
    words = _shown(stage.command)
    note = " (beside the next)" if beside else ""
    print(f"\n=== {stage.name}{note}: {words if len(words) < _LINE_MAX else f'{words[:_LINE_MAX]} ...'}", flush=True)
    own = folder / stage.name
    own.mkdir()
    command = stage.command
    if stage.tests:
        together = ("-n", str(at_a_time(stage.name))) if stage.name in AT_A_TIME else ()
        command += (*together, "-p", "tests.tally", "--tally", str(own / _TALLY), "--durations=10")
    begun_s = time.monotonic()
    ours = os.environ.get(PLACE) == OURS
    if not beside:
        return Running(stage, subprocess.Popen(command, start_new_session=ours and not stage.beside), begun_s, own)
    with (own / _OUTPUT).open("wb") as output:
        command = (sys.executable, "-m", "tests.low_priority", *command)
        apart: dict[str, Any] = {"process_group": 0} if ours else {"start_new_session": True}
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, **apart)
        return Running(stage, process, begun_s, own)


def finish(running: Running) -> Result:
    """Wait for the stage's end, print its output if that went into a file, and return what came of it."""
    stage = running.stage
    code = _wait(running.process)
    duration_s = time.monotonic() - running.begun_s
    output, tally = running.folder / _OUTPUT, running.folder / _TALLY
    if output.exists():
        print(f"\n=== {stage.name}:\n{output.read_text(encoding='utf-8', errors='replace')}", flush=True)
    if not tally.exists():
        return Result(stage=stage, ok=code == 0, duration_s=duration_s, passed=int(code == 0), failed=int(code != 0))
    counts = json.loads(tally.read_text(encoding="utf-8"))
    failed = max(len(counts["failed"]), int(code != 0))
    return Result(
        stage=stage,
        ok=code == 0,
        duration_s=duration_s,
        passed=counts["passed"],
        failed=failed,
        failed_tests=tuple(counts["failed"]),
        skipped=counts["skipped"],
    )


def _wait(process: subprocess.Popen[bytes]) -> int:
    """Return the exit code. After Ctrl-C, which the stage gets as well, it has time to end in order: it has processes of its own."""
    try:
        return process.wait()
    except KeyboardInterrupt:
        with contextlib.suppress(ProcessLookupError):  # it leads no group, and Ctrl-C reached it
            os.killpg(process.pid, signal.SIGINT)
        process.wait()
        raise


def summary(results: Sequence[Result]) -> str:
    """Sum up: a line for each stage, the reasons of skipped tests, each failure with the command that repeats it, the total."""
    lines = [f"\n{'stage':<10} {'result':<7} {'passed':>7} {'failed':>7} {'skipped':>7} {'seconds':>8}"]
    for one in results:
        counts = (one.passed, one.failed, sum(one.skipped.values())) if one.stage.tests else ("", "", "")
        words = " ".join(f"{count:>7}" for count in counts)
        lines.append(f"{one.stage.name:<10} {'passed' if one.ok else 'FAILED':<7} {words} {one.duration_s:>8.1f}")
    reasons: Counter[str] = Counter()
    for one in results:
        reasons.update(one.skipped)
    lines += [f"skipped: {count} x {reason}" for reason, count in reasons.most_common()]
    again = [line for one in results if not one.ok for line in _again(one)]
    if again:
        lines += ["failed; run one again:", *(f"  {line}" for line in again)]
    passed, failed = sum(one.passed for one in results), sum(one.failed for one in results)
    return "\n".join([*lines, f"{passed} passed, {failed} failed, {reasons.total()} skipped"])


def _again(result: Result) -> Iterable[str]:
    if result.stage.tests and result.failed_tests:
        return (_shown((*_PYTEST, "-n0", test)) for test in result.failed_tests)
    if result.stage.tests:
        return [_shown((sys.executable, "-m", "tests.stages", result.stage.name))]
    return [_shown(result.stage.command)]


def run_all(stages: Sequence[Stage]) -> int:
    """Run the stages and print the summary; returns the exit code."""
    results: list[Result] = []
    beside: list[Running] = []
    interrupted = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            for stage in stages:
                if stage.beside and stage is not stages[-1]:
                    beside.append(start(stage, folder, beside=True))
                else:
                    results.append(finish(start(stage, folder)))
            while beside:
                results.append(finish(beside[0]))
                del beside[0]
        except KeyboardInterrupt:
            interrupted = True
            for running in beside:  # in process groups of their own, which Ctrl-C does not reach
                with contextlib.suppress(ProcessLookupError):  # it has ended
                    os.killpg(running.process.pid, signal.SIGINT)
                running.process.wait()
            print("\ninterrupted; the stages below had ended")
    print(summary(results), flush=True)
    if interrupted:
        return _INTERRUPTED
    return int(not all(result.ok for result in results))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [stage.name for stage in STAGES]
    parser.add_argument("stages", nargs="*", metavar="STAGE", help=f"of {', '.join(names)}; all if none is named")
    wanted = parser.parse_args(arguments).stages or names
    unknown = [name for name in wanted if name not in names]
    if unknown:
        parser.error(f"no stage {unknown[0]!r}; there are {', '.join(names)}")
    if real_time() and core_is_taken():
        os.environ[PLACE] = OURS if is_taken_within(os.getsid(0), above=LOW) else EQUAL
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored if a shell started us in the background
    return run_all([stage for stage in STAGES if stage.name in wanted])


if __name__ == "__main__":
    sys.exit(main())
