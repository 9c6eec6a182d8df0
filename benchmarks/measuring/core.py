"""Time per tick of the fast closed loop, the flight core and the law, beside raw MuJoCo on the same computer."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import mujoco

from benchmarks.measuring.latency import Latency
from companion.control.types import PlantState, Wrench
from companion.core.flight_core import FlightCore
from companion.model.constants import TICK_PERIOD_S
from companion.model.types import Inputs, Outcome, Reference
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from sitl.plant import Plant
from sitl.world.state import PHYSICS_DT_S
from tests.support import CATCH
from tools.compiled import is_current

REPEATS = 5
NO_LOADS = {"load_rate_xyz": (0.0, 0.0, 0.0), "moment_rate": (0.0,), "friction_rate": (0.0,)}
"""Settings that switch the adaptive loads off."""
_RAW_STARTS, _RAW_STEPS = 100, 50

LawCall = tuple[float, PlantState, Reference, float]


def measure(say: Callable[[str], None], repeats: int = REPEATS, mission: Path = CATCH) -> dict[str, Any]:
    """Fly a mission in the fast closed loop and time its parts; everything but `core_ms` is CPU time, median of the repeats.

    Raises:
        RuntimeError: the flight did not complete.
    """
    say("flights in the fast closed loop")
    tick_us, flight, result = flight_us(load_sitl(mission), repeats)
    plain = flight.config.controller.model_copy(update=NO_LOADS)
    say("core, law, raw MuJoCo")
    raw_us = raw_step_us(flight.config, flight.plant, result, repeats)
    return {
        "core_ms": asdict(Latency.of(core_s(flight.config, result.inputs))),
        "tick_us": tick_us,
        "catches_min": catches_min(tick_us, len(result.inputs)),
        "law_us": law_us(flight.config, result.inputs, repeats),
        "law_without_loads_us": law_us(flight.config.model_copy(update={"controller": plain}), result.inputs, repeats),
        "raw_step_us": raw_us,
        "raw_tick_us": raw_us * TICK_PERIOD_S / PHYSICS_DT_S,
    }


def measure_compiled(say: Callable[[str], None], repeats: int = REPEATS, mission: Path = CATCH) -> dict[str, Any]:
    """Time the core and the tick of the compiled build.

    Raises:
        RuntimeError: there is no compiled build of the present source, or the flight did not complete.
    """
    if not is_current():
        raise RuntimeError("there is no compiled build of the present source; run make compile")
    say("flights in the fast closed loop")
    tick_us, flight, result = flight_us(load_sitl(mission), repeats)
    return {
        "core_ms": asdict(Latency.of(core_s(flight.config, result.inputs))),
        "tick_us": tick_us,
        "catches_min": catches_min(tick_us, len(result.inputs)),
    }


def catches_min(tick_us: float, ticks: int) -> float:
    """Return how long 10,000 flights of so many ticks take on all cores of this computer, if they are free."""
    return 1e4 * ticks * tick_us * 1e-6 / (os.cpu_count() or 1) / 60.0


def flight_us(config: SitlConfig, repeats: int) -> tuple[float, FastFlight, FastResult]:
    """Return the CPU time per tick of whole flights without their construction, and the last flight.

    Raises:
        RuntimeError: a flight did not complete.
    """
    FastFlight(config).run(limit_s=2.0)  # imports and caches
    times_us: list[float] = []
    for _ in range(repeats):
        flight = FastFlight(config)
        begun_s = time.process_time()
        result = flight.run()
        times_us.append((time.process_time() - begun_s) / len(result.inputs) * 1e6)
    if result.outputs[-1].outcome is not Outcome.COMPLETED:
        raise RuntimeError(f"the flight ended as {result.outputs[-1].outcome}, expected one that completes")
    return median(times_us), flight, result


def raw_step_us(config: SitlConfig, plant: Plant, result: FastResult, repeats: int) -> float:
    """Return the CPU time of `mj_step` on the flight's model, in batches from states all along the flight."""
    model = plant.scene.model
    data = mujoco.MjData(model)
    snapshots = result.snapshots[:: max(1, len(result.snapshots) // _RAW_STARTS)]
    hover_n = plant.machine.hover_command * config.vehicle.airframe.thrust_max_n / 4.0
    times_us = []
    for _ in range(repeats):
        used_s = 0.0
        for snapshot in snapshots:
            data.qpos[: len(snapshot.q)], data.qvel[: len(snapshot.v)] = snapshot.q, snapshot.v
            data.ctrl[0:4] = hover_n
            begun_s = time.process_time()
            mujoco.mj_step(model, data, _RAW_STEPS)
            used_s += time.process_time() - begun_s
        times_us.append(used_s / (len(snapshots) * _RAW_STEPS) * 1e6)
    return median(times_us)


def core_s(config: SitlConfig, inputs: list[Inputs]) -> list[float]:
    """Return the wall time of every `FlightCore.step` of a recorded flight; one step is too short for the CPU clock."""
    core = FlightCore(config)
    times_s = []
    for given in inputs:
        begun_s = time.perf_counter()
        core.step(given)
        times_s.append(time.perf_counter() - begun_s)
    return times_s


class _RecordedLaw:
    """A law that records its arguments."""

    def __init__(self, law: Any, calls: list[LawCall]) -> None:
        self._law = law
        self._calls = calls

    def step(self, dt_s: float, state: PlantState, reference: Reference, vertical_scale: float) -> Wrench:
        self._calls.append((dt_s, state, reference, vertical_scale))
        wrench: Wrench = self._law.step(dt_s, state, reference, vertical_scale)
        return wrench


def law_us(config: SitlConfig, inputs: list[Inputs], repeats: int) -> float:
    """Return the CPU time per update of the law on the states of a recorded flight."""
    calls: list[LawCall] = []
    core = FlightCore(config)
    core._control._controller = _RecordedLaw(core._control._controller, calls)
    for given in inputs:
        core.step(given)
    times_us: list[float] = []
    for _ in range(repeats):
        step = FlightCore(config)._control._controller.step
        begun_s = time.process_time()
        for call in calls:
            step(*call)
        times_us.append((time.process_time() - begun_s) / len(calls) * 1e6)
    return median(times_us)
