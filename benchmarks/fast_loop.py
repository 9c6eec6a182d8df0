"""The fast closed loop beside raw MuJoCo and RotorPy, measured in one run.

    python benchmarks/fast_loop.py                            # the table
    python benchmarks/fast_loop.py --json FILE                # the same figures for a script
    python benchmarks/fast_loop.py --rotorpy-python PYTHON    # RotorPy lives in another environment
    python benchmarks/fast_loop.py --no-workers --no-rotorpy  # one core, this program alone

Everything on one core is CPU time of the process, median of `--flights` repeats: what else the machine does takes time from the wall
clock, not from these figures (shared caches and hyperthreads still do; see the reference loop). Two workers beside one are wall time.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
from rich.console import Console
from rich.table import Table

from companion.config.document import ConfigError
from companion.control.types import PlantState, Wrench
from companion.core.flight_core import FlightCore
from companion.model.types import Inputs, Outcome, Reference
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns import compare
from sitl.fast.loop import TICK_S, FastFlight, FastResult
from sitl.world.world import PHYSICS_DT_S, World

_HERE = Path(__file__).parent
_MISSION = _HERE.parent / "configs" / "missions" / "catch.yaml"
_ROTORPY_DEADLINE_S = 300.0
_RAW_STARTS, _RAW_STEPS = 100, 50
_REFERENCE_TURNS = 1000
_WORKER_FLIGHTS, _WORKER_ROUNDS = 4, 3

LawCall = tuple[float, PlantState, Reference, float]


class BenchmarkError(Exception):
    """A part cannot be measured; one line."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    key: str
    what: str
    value: float | None
    unit: str
    ratio: str = ""
    """What the value means beside another row."""
    target: str = ""
    note: str = ""


class _Watched:
    """A law that notes what it is asked."""

    def __init__(self, law: Any, calls: list[LawCall]) -> None:
        self._law = law
        self._calls = calls

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        """As the law's."""
        self._calls.append((dt_s, state, reference, vertical_scale))
        wrench: Wrench = self._law.step(dt_s, state, reference, vertical_scale)
        return wrench


@contextmanager
def _cpu_us(into: list[float], count: int) -> Iterator[None]:
    start = time.process_time()
    yield
    into.append((time.process_time() - start) / count * 1e6)


def flight_us(config: SitlConfig, repeats: int) -> tuple[float, FastFlight, FastResult]:
    """CPU time per tick of whole flights, construction left out, and the last of them.

    Raises:
        BenchmarkError: a flight did not complete.
    """
    FastFlight(config).run(limit_s=2.0)  # imports and caches
    times: list[float] = []
    for _ in range(repeats):
        flight = FastFlight(config)
        start = time.process_time()
        result = flight.run()
        times.append((time.process_time() - start) / len(result.inputs) * 1e6)
    if result.outputs[-1].outcome is not Outcome.COMPLETED:
        raise BenchmarkError(f"the flight ended as {result.outputs[-1].outcome}, expected one that completes")
    return median(times), flight, result


def raw_step_us(config: SitlConfig, world: World, result: FastResult, repeats: int) -> float:
    """`mj_step` alone on the flight's own model, from states all along the flight, no Python between the steps."""
    model, data = world.model, mujoco.MjData(world.model)
    snapshots = result.snapshots[:: max(1, len(result.snapshots) // _RAW_STARTS)]
    hover_n = world.hover_command * config.vehicle.airframe.thrust_max_n / 4.0
    times = []
    for _ in range(repeats):
        used_s = 0.0
        for snapshot in snapshots:
            data.qpos[:], data.qvel[:] = snapshot.q, snapshot.v
            data.ctrl[0:4] = hover_n
            start = time.process_time()
            mujoco.mj_step(model, data, _RAW_STEPS)
            used_s += time.process_time() - start
        times.append(used_s / (len(snapshots) * _RAW_STEPS) * 1e6)
    return median(times)


def core_us(config: SitlConfig, inputs: list[Inputs]) -> list[float]:
    """Time of every `FlightCore.step` of a recorded flight, by the wall clock: single steps are too short for the CPU clock."""
    core = FlightCore(config)
    clock = time.perf_counter
    times = []
    for given in inputs:
        start = clock()
        core.step(given)
        times.append((clock() - start) * 1e6)
    return sorted(times)


def law_us(config: SitlConfig, inputs: list[Inputs], repeats: int) -> tuple[float, int]:
    """CPU time per update of the law on the states of a recorded flight, and how many those are."""
    calls: list[LawCall] = []
    core = FlightCore(config)
    core._pilot._controller = _Watched(core._pilot._controller, calls)
    for given in inputs:
        core.step(given)
    times: list[float] = []
    for _ in range(repeats):
        step = FlightCore(config)._pilot._controller.step
        with _cpu_us(times, len(calls)):
            for call in calls:
                step(*call)
    return median(times), len(calls)


def reference_us(repeats: int) -> float:
    """A fixed piece of plain Python, some thousand bytecodes: how fast this machine runs Python now."""
    times: list[float] = []
    for _ in range(repeats):
        with _cpu_us(times, 200):
            for _ in range(200):
                x = 0.0
                for i in range(_REFERENCE_TURNS):
                    x = 0.5 * x + i
    return median(times)


def two_workers(config: SitlConfig) -> tuple[float, float]:
    """Flights per second of wall time by one worker process and by two, grading included, as `companion compare --jobs` flies them."""
    flight = {
        "controller": config.controller.law,
        "preset": config.controller.preset,
        "payload_kg": config.world.payload_kg,
        "seed": config.world.seed,
        "series": False,
    }

    def rate(pool: ProcessPoolExecutor, jobs: int) -> float:
        start = time.perf_counter()
        flights = [pool.submit(compare.fly, config, flight) for _ in range(jobs * _WORKER_FLIGHTS)]
        for done in flights:
            row = done.result()["row"]
            if row["error"] is not None:
                raise BenchmarkError(f"a worker's flight failed: {row['error']}")
        return len(flights) / (time.perf_counter() - start)

    rates: dict[int, list[float]] = {1: [], 2: []}
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawn) as one, ProcessPoolExecutor(2, spawn) as two:
        rate(one, 1)  # workers start and import
        rate(two, 2)
        # In turns, so that whatever else the machine does meets both.
        for _ in range(_WORKER_ROUNDS):
            rates[1].append(rate(one, 1))
            rates[2].append(rate(two, 2))
    return median(rates[1]), median(rates[2])


def rotorpy_s(python: str) -> dict[str, Any] | None:
    """RotorPy's CPU seconds per simulated second; None: it is not installed there.

    Raises:
        BenchmarkError: its run failed.
    """
    try:
        done = subprocess.run(
            [python, str(_HERE / "rotorpy_loop.py")], capture_output=True, text=True, timeout=_ROTORPY_DEADLINE_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BenchmarkError(f"rotorpy in {python}: {error}") from error
    if done.returncode == 3:
        return None
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise BenchmarkError(f"rotorpy in {python} failed: {last[0]}")
    figures: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return figures


def measure(
    config: SitlConfig, repeats: int, workers: bool, rotorpy: str | None, say: Callable[[str], None]
) -> list[Row]:
    """All rows."""
    say("flights on one core")
    tick_us, flight, result = flight_us(config, repeats)
    config, inputs = flight.config, result.inputs
    speed = TICK_S * 1e6 / tick_us
    say("raw MuJoCo, core, law")
    raw_us = raw_step_us(config, flight.plant.world, result, repeats)
    raw_tick_us = raw_us * TICK_S / PHYSICS_DT_S
    steps = core_us(config, inputs)
    law, updates = law_us(config, inputs, repeats)
    reference = reference_us(repeats)
    name = f"{config.controller.law}/{config.controller.preset}"
    rows = [
        Row(
            key="raw_step_us",
            what="raw mj_step, same model",
            value=raw_us,
            unit="us/step",
            ratio=f"{PHYSICS_DT_S * 1e6 / raw_us:.0f} x real time",
        ),
        Row(
            key="tick_us",
            what="FastFlight",
            value=tick_us,
            unit="us/tick",
            ratio=f"{tick_us / raw_tick_us:.1f} x raw MuJoCo",
        ),
        Row(
            key="real_time",
            what="FastFlight, one core",
            value=speed,
            unit="x real time",
            ratio="",
            target=">= 50",
            note=f"{len(inputs)} ticks",
        ),
        Row(
            key="core_p50_us",
            what="FlightCore.step p50",
            value=steps[len(steps) // 2],
            unit="us",
            ratio=f"p99 {steps[len(steps) * 99 // 100]:.0f} us",
        ),
        Row(
            key="law_us",
            what=f"law {name}",
            value=law,
            unit="us/update",
            ratio=f"{law / reference:.2f} x reference",
            target="<= 10",
            note=f"{updates} updates",
        ),
        Row(
            key="reference_us",
            what=f"reference loop, {_REFERENCE_TURNS} turns of x = x / 2 + i",
            value=reference,
            unit="us",
        ),
    ]
    if workers:
        say("two workers beside one")
        one, two = two_workers(config)
        rows.append(Row(key="one_worker", what="one process", value=one, unit="flights/s"))
        rows.append(
            Row(
                key="two_workers",
                what="two workers",
                value=two,
                unit="flights/s",
                ratio=f"{two / one:.2f} x one",
                target=">= 1.8 x",
            )
        )
    if rotorpy is not None:
        say("RotorPy")
        figures = rotorpy_s(rotorpy)
        if figures is None:
            rows.append(
                Row(
                    key="rotorpy_s",
                    what="RotorPy",
                    value=None,
                    unit="",
                    note="rotorpy not installed: pip install rotorpy",
                )
            )
        else:
            rows += _rotorpy_rows(figures, tick_us * 1e-6 / TICK_S)
    return rows


def _rotorpy_rows(figures: dict[str, Any], ours_s: float) -> list[Row]:
    bare, whole = figures["bare_s"], figures["whole_s"]
    note = f"{figures['version']}, {figures['rate_hz']:g} Hz"
    unit = "ms CPU per simulated s"
    return [
        Row(key="ours_s", what="FastFlight", value=ours_s * 1e3, unit=unit),
        Row(
            key="rotorpy_bare_s",
            what="RotorPy: SE3 + dynamics",
            value=bare * 1e3,
            unit=unit,
            ratio=f"{bare / ours_s:.1f} x ours",
            target="",
            note=note,
        ),
        Row(
            key="rotorpy_whole_s",
            what="RotorPy: with its sensors",
            value=whole * 1e3,
            unit=unit,
            ratio=f"{whole / ours_s:.1f} x ours",
            target="",
            note=note,
        ),
    ]


def show(rows: list[Row]) -> None:
    """Print the table."""
    table = Table("", "figure", "unit", "ratio", "target", "note")
    table.columns[1].justify = "right"
    for row in rows:
        value = "-" if row.value is None else f"{row.value:.2f}" if row.value < 10 else f"{row.value:.1f}"
        table.add_row(row.what, value, row.unit, row.ratio, row.target, row.note)
    console = Console()
    # Into a file or a pipe it is not folded at 80 columns.
    console = console if console.is_terminal else Console(width=160)
    console.print(table)


def main(arguments: list[str] | None = None) -> int:
    """Exit 0: measured; 1: a part could not be measured, said in one line; 2: bad input."""
    parser = argparse.ArgumentParser(description="The fast closed loop beside raw MuJoCo and RotorPy.")
    parser.add_argument(
        "--flights", type=int, default=5, help="repeats of everything on one core (default %(default)s)"
    )
    parser.add_argument("--mission", type=Path, default=_MISSION, help="mission to fly (default %(default)s)")
    parser.add_argument("--controller", default="adaptive", help="law (default %(default)s)")
    parser.add_argument("--preset", help="preset of the law (default: the law's own)")
    parser.add_argument("--no-workers", action="store_true", help="leave out two workers beside one")
    parser.add_argument("--no-rotorpy", action="store_true", help="leave out RotorPy")
    parser.add_argument(
        "--rotorpy-python", default=sys.executable, metavar="PYTHON", help="interpreter that has rotorpy"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows there too")
    options = parser.parse_args(arguments)
    if options.flights < 1:
        parser.error("--flights must be at least 1")
    try:
        config = load_sitl(options.mission, controller_law=options.controller, preset=options.preset)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    console = Console(stderr=True)
    rotorpy = None if options.no_rotorpy else options.rotorpy_python
    try:
        rows = measure(
            config, options.flights, not options.no_workers, rotorpy, lambda text: console.print(f"... {text}")
        )
    except BenchmarkError as error:
        print(f"fast_loop: {error}", file=sys.stderr)
        return 1
    show(rows)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
