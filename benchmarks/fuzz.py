"""Feeds damaged input to every wire of the companion and reports what fails.

    python -m benchmarks.fuzz                                     # every target, 1,000,000 inputs each
    python -m benchmarks.fuzz natnet yaml --inputs 20000 --jobs 2
    python -m benchmarks.fuzz --minutes 5 --seed 7                # every target, as many inputs as there is time for
    python -m benchmarks.fuzz natnet --seed 1 --index 4711        # one input again

Exit 0: nothing found; 1: findings, each saved as a file that `tests/fuzz` feeds from then on; 2: bad options.
"""

from __future__ import annotations

import argparse
import logging
import math
import multiprocessing
import sys
import time
from collections.abc import Sequence
from ctypes import c_longlong
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from benchmarks.fuzzing.campaign import Finding, Stretch, feed_watched, generator, run
from benchmarks.fuzzing.targets import NAMES, target_class
from benchmarks.report import print_table

REGRESSIONS = Path(__file__).parents[1] / "tests" / "regressions" / "fuzz"
_STUCK_S = 180.0
"""Time without progress after which a process is killed: a call outside of Python hangs."""
_POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one target."""

    target: str
    inputs: int
    duration_s: float
    slowest_s: float
    memory_bytes: tuple[int, int]
    findings: tuple[Finding, ...]


class Worker:
    """A process that feeds a range of inputs; its present index stays readable if it dies."""

    def __init__(self, name: str, seed: int, first: int, last: int, until_s: float) -> None:
        self.name, self.seed, self.first = name, seed, first
        context = multiprocessing.get_context("spawn")
        self.index: Any = RawValue(c_longlong, first)
        self.result, sender = context.Pipe(duplex=False)
        self.process = context.Process(target=_work, args=(name, seed, first, last, until_s, self.index, sender))
        self.process.start()
        sender.close()
        self._seen, self._seen_s = first, time.monotonic()

    def stretch(self) -> Stretch | None:
        """Return its result once it is done, dead or hung, else None."""
        if self.result.poll():
            try:
                stretch: Stretch = self.result.recv()
            except EOFError:
                self.process.join()
                return self._lost(f"the process died, exit code {self.process.exitcode}")
            self.process.join()
            return stretch
        if self.index.value != self._seen:
            self._seen, self._seen_s = self.index.value, time.monotonic()
        elif time.monotonic() - self._seen_s > _STUCK_S:
            self.process.kill()
            self.process.join()
            return self._lost(f"stuck for {_STUCK_S:g} s, killed")
        return None

    def _lost(self, text: str) -> Stretch:
        index = int(self.index.value)
        data = target_class(self.name)().make(generator(self.name, self.seed, index))
        finding = Finding(target=self.name, seed=self.seed, index=index, text=text, data=data)
        return Stretch(
            inputs=index - self.first,
            duration_s=0.0,
            slowest_s=0.0,
            slowest_index=index,
            memory_bytes=(0, 0),
            findings=(finding,),
        )


def _work(name: str, seed: int, first: int, last: int, until_s: float, index: Any, sender: Connection) -> None:
    logging.getLogger("companion").setLevel(logging.CRITICAL + 1)  # the edges say what they refuse, a million times

    def tell(now: int) -> None:
        index.value = now

    with target_class(name)() as target:
        stretch = run(target, seed, first, last, tell, until_s)
    sender.send(stretch)


def fuzz(name: str, inputs: int, seed: int, jobs: int, progress: Progress, until_s: float = math.inf) -> Row:
    """Fuzz one target in several processes, until a deadline on the monotonic clock."""
    total = max(jobs, round(inputs * target_class(name).share))
    bounds = [total * k // jobs for k in range(jobs + 1)]
    start_s = time.monotonic()
    bar = progress.add_task(name, total=total)
    workers = [Worker(name, seed, bounds[k], bounds[k + 1], until_s) for k in range(jobs)]
    stretches: dict[int, Stretch] = {}
    try:
        while len(stretches) < jobs:
            time.sleep(_POLL_S)
            for k, worker in enumerate(workers):
                if k not in stretches and (stretch := worker.stretch()) is not None:
                    stretches[k] = stretch
            progress.update(bar, completed=sum(int(worker.index.value) - worker.first for worker in workers))
    finally:
        for worker in workers:
            if worker.process.is_alive():
                worker.process.terminate()
            worker.process.join()
    done = [stretches[k] for k in range(jobs)]
    progress.update(bar, completed=total)
    return Row(
        target=name,
        inputs=sum(stretch.inputs for stretch in done),
        duration_s=time.monotonic() - start_s,
        slowest_s=max(stretch.slowest_s for stretch in done),
        memory_bytes=max((stretch.memory_bytes for stretch in done), key=lambda memory: memory[1] - memory[0]),
        findings=tuple(finding for stretch in done for finding in stretch.findings),
    )


def save(finding: Finding, folder: Path = REGRESSIONS) -> Path | None:
    """Save the input as a file and return its path, or None if the finding does not belong to one input."""
    if finding.index is None:
        return None
    path = folder / f"{finding.target}-{finding.seed}-{finding.index}.bin"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_bytes(finding.data)
    return path


def cells(row: Row) -> dict[str, str]:
    """Return the row of the report."""
    warm_mib, end_mib = (size / 2**20 for size in row.memory_bytes)
    return {
        "target": row.target,
        "inputs": f"{row.inputs:,}",
        "duration s": f"{row.duration_s:.0f}",
        "us/input": f"{1e6 * row.duration_s / max(1, row.inputs):.0f}",
        "slowest ms": f"{1e3 * row.slowest_s:.0f}",
        "memory MiB 10 % -> end": f"{warm_mib:.1f} -> {end_mib:.1f}",
        "findings": str(len(row.findings)),
    }


def again(name: str, seed: int, index: int) -> int:
    """Feed one input and print the finding."""
    with target_class(name)() as target:
        data = target.make(generator(name, seed, index))
        found = feed_watched(target, data)
    print(f"{len(data)} bytes: {data[:200]!r}")
    print(found or "nothing found")
    return int(found is not None)


def _fuzz_all(names: Sequence[str], options: argparse.Namespace, progress: Progress) -> list[Row]:
    end_s = time.monotonic() + 60.0 * options.minutes
    rows = []
    for done, name in enumerate(names):
        now_s = time.monotonic()
        until_s = now_s + max(0.0, end_s - now_s) / (len(names) - done)
        rows.append(fuzz(name, options.inputs, options.seed, options.jobs, progress, until_s))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"all, or of {', '.join(NAMES)}")
    parser.add_argument(
        "--inputs", type=int, default=1_000_000, help="for each target; the -wire ones take a share of it"
    )
    parser.add_argument("--minutes", type=float, default=math.inf, help="for all targets together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--index", type=int, help="feed this one input of one target only")
    options = parser.parse_args(arguments)
    wanted = list(NAMES) if options.targets in ([], ["all"]) else options.targets
    unknown = [name for name in wanted if name not in NAMES]
    if unknown:
        parser.error(f"no target {unknown[0]!r}; there are all, {', '.join(NAMES)}")
    if not options.minutes > 0.0:
        parser.error("--minutes is more than 0")
    if options.inputs < 1 or options.jobs < 1 or options.seed < 0 or (options.index is not None and options.index < 0):
        parser.error("--inputs and --jobs are 1 or more, --seed and --index 0 or more")
    if options.index is not None:
        if len(wanted) != 1:
            parser.error("--index wants one target")
        return again(wanted[0], options.seed, options.index)
    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        rows = _fuzz_all(wanted, options, progress)
    console = Console(width=None if sys.stdout.isatty() else 120)
    print_table("", list(map(cells, rows)), console)
    found = [finding for row in rows for finding in row.findings]
    for finding in found:
        path = save(finding)
        print(f"{finding}" + (f"\n    saved as {path}" if path is not None else ""))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
