"""An estimate for a Raspberry Pi: CPU time measured here, multiplied by how much slower the Pi runs programs with published times.

Programs of the pyperformance suite run here with the Python of the flight. Their times on a Raspberry Pi 5 are published, and so are
the times of one set of compiled programs on a Raspberry Pi 5 and a Raspberry Pi 4. Each program has its own ratio; the spread of the
ratios is the uncertainty, because the companion is one more program. Nothing runs on a Pi.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from tests.support import ROOT

PACKAGES = ("pyperformance==1.14.0", "pyperf==2.10.0")
FOLDER = ROOT / "build" / "pyperformance"
"""Folder into which pip unpacks the programs at the first run."""
CLOCK = FOLDER / "sitecustomize.py"
"""Makes the programs measure their CPU time, which other processes disturb less; written last."""
_PIP_DEADLINE_S, _PROGRAM_DEADLINE_S = 120.0, 60.0

PI5_S: Mapping[str, float] = {
    "chaos": 0.0802, "float": 0.109, "go": 0.155, "hexiom": 0.00843, "nbody": 0.143,
    "nqueens": 0.120, "raytrace": 0.380, "richards": 0.0627, "spectral_norm": 0.145,
}  # fmt: skip
"""Mean time of each program on a Raspberry Pi 5 (2.4 GHz), s, Python 3.15.0a1+ at 421a475 built with -O3, profile and link-time
optimisation and without JIT: https://github.com/savannahostrowski/pyperf_bench, results/bm-20251025-3.15.0a1+-421a475 (blueberry).
They are the programs of pure Python with objects and floating-point numbers, as the companion is.
"""
PI4_PER_PI5 = (
    2.04, 2.01, 2.18, 2.15, 2.20, 3.53, 1.93, 2.52, 2.11, 2.27, 2.52, 2.00, 2.22, 1.93, 2.29, 1.41, 2.15, 2.21, 2.24, 2.00, 2.29,
    2.00, 2.19, 2.24, 1.85,
)  # fmt: skip
"""Time on a Raspberry Pi 4 (1.8 GHz) divided by the time on a Raspberry Pi 5, of 25 C++ programs built by one compiler:
https://github.com/lurk101/AoC-2023-cplusplus, README.md.
"""
PI4_CLOCKS_GHZ = (1.5, 1.8)
"""Clock of the Raspberry Pi 4: early boards, and boards since 2021 (BCM2711 C0, `arm_boost=1`)."""
NBODY_STEP_PI4_S = 158.263 / 5e6
"""Time of one step of N-body in Python on a Raspberry Pi 4 at 1.5 GHz, before Python 3.11:
https://chaitanyamehta.github.io/projects/performance-analysis-of-programming-languages.
"""
NBODY_STEPS = 20_000
"""Steps of one run of pyperformance's nbody, the same program."""
NBODY_BEFORE_3_11 = 142.0 / 93.1
"""Time of nbody with Python 3.10.4 divided by the time with 3.11.0: https://github.com/faster-cpython/benchmarking-public,
results/bm-20221024-3.11.0-deaf509 (linux x86_64).
"""
DEVIATIONS = 2.0
"""Half of the range in standard deviations: the range holds 19 programs of 20."""


class NotMeasured(Exception):
    """The reason why the programs were not measured, in one line."""


@dataclass(frozen=True, slots=True)
class Slower:
    """How many times slower a computer is: the geometric mean over programs, and their range."""

    mean: float
    log_deviation: float
    """Standard deviation of the logarithm of the programs' ratios."""

    @classmethod
    def of(cls, ratios: Iterable[float]) -> Slower:
        """Return the mean and the deviation of at least two ratios."""
        logs = [math.log(ratio) for ratio in ratios]
        return cls(math.exp(mean(logs)), stdev(logs))

    def times(self, other: Slower) -> Slower:
        """Return the factor of two independent steps, one after the other."""
        return Slower(self.mean * other.mean, math.hypot(self.log_deviation, other.log_deviation))

    def scaled(self, factor: float) -> Slower:
        """Return the factor at another clock."""
        return Slower(self.mean * factor, self.log_deviation)

    @property
    def low(self) -> float:
        """Lower end of the range."""
        return self.mean * math.exp(-DEVIATIONS * self.log_deviation)

    @property
    def high(self) -> float:
        """Upper end of the range."""
        return self.mean * math.exp(DEVIATIONS * self.log_deviation)


def slower(here_s: Mapping[str, float]) -> dict[str, Slower]:
    """Return how much slower each Pi is than the computer on which the programs took `here_s`."""
    pi5 = Slower.of(PI5_S[name] / here_s[name] for name in PI5_S)
    pi4 = pi5.times(Slower.of(PI4_PER_PI5))
    boards = {f"Pi 4, {clock:g} GHz": pi4.scaled(max(PI4_CLOCKS_GHZ) / clock) for clock in PI4_CLOCKS_GHZ}
    return {**boards, "Pi 5, 2.4 GHz": pi5}


def nbody_check(here_s: Mapping[str, float]) -> tuple[float, float]:
    """Return the estimated and the published time of a step of N-body on a Pi 4 at 1.5 GHz before Python 3.11, us."""
    estimate_s = here_s["nbody"] / NBODY_STEPS * slower(here_s)["Pi 4, 1.5 GHz"].mean * NBODY_BEFORE_3_11
    return 1e6 * estimate_s, 1e6 * NBODY_STEP_PI4_S


def measure(say: Callable[[str], None]) -> dict[str, Any]:
    """Run the programs here; return the shortest CPU time of each, s.

    Raises:
        NotMeasured: the programs cannot be installed, or one failed.
    """
    _install()
    here_s = {}
    for name in PI5_S:
        say(name)
        here_s[name] = _run(name)
    return {"here_s": here_s}


def _install() -> None:
    if CLOCK.exists():
        return
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    options = ("--quiet", "--no-deps", "--upgrade", "--target", str(FOLDER))
    try:
        subprocess.run([*pip, "install", *options, *PACKAGES], capture_output=True, timeout=_PIP_DEADLINE_S, check=True)
    except (OSError, subprocess.SubprocessError):
        raise NotMeasured(f"needs pip install --target {FOLDER} {' '.join(PACKAGES)}, which failed") from None
    CLOCK.write_text("import time\n\ntime.perf_counter = time.process_time\n", encoding="utf-8")


def _run(name: str) -> float:
    program = FOLDER / "pyperformance/data-files/benchmarks" / f"bm_{name}" / "run_benchmark.py"
    with tempfile.TemporaryDirectory() as folder:
        results = Path(folder, "results.json")
        options = ("--processes", "3", "--values", "3", "--warmups", "1", "--min-time", "0.05", "--quiet")
        command = [sys.executable, str(program), *options, "--inherit-environ", "PYTHONPATH", "-o", str(results)]
        try:
            subprocess.run(
                command,
                env={**os.environ, "PYTHONPATH": str(FOLDER)},
                capture_output=True,
                timeout=_PROGRAM_DEADLINE_S,
                check=True,
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise NotMeasured(f"pyperformance's {name} failed: {error}") from None
        return shortest_s(results.read_text(encoding="utf-8"))


def shortest_s(results: str) -> float:
    """Return the shortest time in the results of pyperf: the least disturbed one.

    Raises:
        NotMeasured: the results hold no time.
    """
    runs = [run for benchmark in json.loads(results)["benchmarks"] for run in benchmark["runs"]]
    values = [float(value) for run in runs for value in run.get("values", ())]
    if not values:
        raise NotMeasured("pyperf measured no time")
    return min(values)
