"""`python -m tests.explore [MINUTES]`: draw property tests and damaged input at random, for whoever changes a parser.

Half of the time goes to the property tests, a thousand examples each, in rounds with a new seed; half to `benchmarks.fuzz`.
Whatever is found fails, with what repeats it. Exit 0: nothing found; 1: something; 2: invalid option.

It is also the pytest plugin that ends a round in time (`-p tests.explore --until SECONDS`).
"""

from __future__ import annotations

import argparse
import os
import secrets
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from random import Random

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--until", type=float, default=float("inf"), help="start no test after this, on the monotonic clock [s]"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Shuffle, so that each test has its turn also where there is never time for all. Every worker shuffles alike."""
    Random(config.getoption("--hypothesis-seed")).shuffle(items)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if time.monotonic() >= item.config.getoption("--until"):
        pytest.skip("no time left")


def properties(seed: int, until_s: float) -> int:
    """Run every property test once; returns pytest's exit code."""
    jobs = len(os.sched_getaffinity(0))
    words = [
        *(sys.executable, "-m", "pytest", "-m", "hypothesis", "-n", str(jobs), "--dist", "worksteal", "--timeout", "0"),
        *("--hypothesis-profile", "explore", "--hypothesis-seed", str(seed)),
    ]
    print(f"\n=== {shlex.join(words)}", flush=True)
    files = [str(path) for path in Path("tests").rglob("test_*.py") if "hypothesis" in path.read_text(encoding="utf-8")]
    more = ("-q", "-r", "fE", "-p", "tests.explore", f"--until={until_s}", *sorted(files))
    return subprocess.run([*words, *more], check=False).returncode


def damaged_input(seed: int, minutes: float) -> int:
    """Run the fuzz campaign; returns its exit code."""
    words = [sys.executable, "-m", "benchmarks.fuzz", "--seed", str(seed), "--minutes", f"{minutes:.2f}"]
    print(f"\n=== {shlex.join(words)}", flush=True)
    return subprocess.run(words, check=False).returncode


def explore(minutes: float) -> int:
    """Explore for about so many minutes; returns the exit code."""
    begun_s = time.monotonic()
    half_s, end_s = begun_s + 30.0 * minutes, begun_s + 60.0 * minutes
    codes: list[int] = []
    while not codes or time.monotonic() < half_s:
        codes.append(properties(secrets.randbelow(2**32), half_s))
    left_min = max(0.1, (end_s - time.monotonic()) / 60.0)
    codes.append(damaged_input(secrets.randbelow(2**32), left_min))
    found = "something was found, see above" if any(codes) else "nothing found"
    print(f"\n{len(codes) - 1} rounds of property tests, one of damaged input: {found}")
    return int(any(codes))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("minutes", nargs="?", type=float, default=10.0)
    minutes = parser.parse_args(arguments).minutes
    if not 0.0 < minutes < float("inf"):
        parser.error("MINUTES is a number greater than 0")
    return explore(minutes)


if __name__ == "__main__":
    sys.exit(main())
