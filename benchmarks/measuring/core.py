"""One tick of the flight core, beside raw MuJoCo on the same computer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from benchmarks.fast_loop import core_us, flight_us, law_us, raw_step_us
from benchmarks.measuring.latency import Latency
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import TICK_S
from sitl.world.world import PHYSICS_DT_S
from tests.support import CATCH

REPEATS = 5


def measure(say: Callable[[str], None], repeats: int = REPEATS) -> dict[str, Any]:
    """Of the catch mission in the fast closed loop.

    Raises:
        BenchmarkError: the flight did not complete.
    """
    say("flights in the fast closed loop")
    tick_us, flight, result = flight_us(load_sitl(CATCH), repeats)
    say("core, law, raw MuJoCo")
    law, _ = law_us(flight.config, result.inputs, repeats)
    raw_us = raw_step_us(flight.config, flight.plant.world, result, repeats)
    return {
        "core_ms": asdict(Latency.of(1e-6 * taken_us for taken_us in core_us(flight.config, result.inputs))),
        "tick_us": tick_us,
        "law_us": law,
        "raw_step_us": raw_us,
        "raw_tick_us": raw_us * TICK_S / PHYSICS_DT_S,
    }
