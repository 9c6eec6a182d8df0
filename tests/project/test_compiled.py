"""The compiled build computes the same bits as plain Python, in whole flights. It takes minutes to make, so `make test` does not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import CATCH, ROOT
from tools.compiled import BUILD, INTERPRETED, is_current, modules

FLIGHT = """
import hashlib, sys
from companion.runtime.compiled import COMPILED
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
mission, law, preset, world = sys.argv[1:]
config = load_sitl(mission, controller_law=law, preset=preset, world=world, overrides=["world.payload_kg=0.2"])
result = FastFlight(config).run()
flown = repr((result.inputs, result.outputs, result.snapshots))
print(COMPILED, len(result.outputs), result.outputs[-1].outcome.value, hashlib.sha256(flown.encode()).hexdigest())
"""
FLIGHTS = [("adaptive", "recommended", "lab"), ("psc", "tuned", "ideal"), ("csc", "tuned", "robustness")]


def flown_by(path: Path, *flight: str) -> list[str]:
    """Fly in a process of its own whose modules come from this folder. Return the words that it prints."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", FLIGHT, str(CATCH), *flight],
        env={**os.environ, "PYTHONPATH": str(path)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout.split()


@pytest.mark.skipif(not is_current(), reason="no compiled build of this source: make compile")
@pytest.mark.parametrize("flight", FLIGHTS, ids=" ".join)
def test_a_compiled_flight_is_bit_for_bit_the_interpreted_one(flight: tuple[str, ...]) -> None:
    compiled, interpreted = flown_by(BUILD, *flight), flown_by(ROOT, *flight)
    assert compiled[0] == "True"
    assert interpreted[0] == "False"
    assert compiled[1:] == interpreted[1:]
    assert interpreted[2] == "completed"


def test_the_list_of_modules_names_only_files_that_exist() -> None:
    assert set(modules()) >= {"companion/core/flight_core.py", "sitl/fast/loop.py", "sitl/world/effects/net.py"}
    assert all((ROOT / name).exists() for name in INTERPRETED)
