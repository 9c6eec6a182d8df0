"""`python -m tests.explore [MINUTES]`: draw property tests and damaged input at random, for whoever changes a parser.

Every property test and every wire under damaged input (`tests/fuzz`) draws a thousand examples, in rounds with a new seed. Whatever
is found fails, with what repeats it. Exit 0: nothing found; 1: something; 2: invalid option.

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


def explore(minutes: float) -> int:
    """Explore for about so many minutes; returns the exit code."""
    end_s = time.monotonic() + 60.0 * minutes
    codes: list[int] = []
    while not codes or time.monotonic() < end_s:
        codes.append(properties(secrets.randbelow(2**32), end_s))
    print(f"\n{len(codes)} rounds: {'something was found, see above' if any(codes) else 'nothing found'}")
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
