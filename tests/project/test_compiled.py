"""The compiled build computes the same bits as plain Python, in whole flights. It takes minutes to make, so `make test` does not."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.support import CATCH, HOVER, LOW_HOVER, ROOT, USUAL, set_options
from tools import compiled
from tools.compiled import BUILD, INTERPRETED, is_current, sources

modules = cache(compiled.modules)

FLIGHT = """
import hashlib, sys
from companion.runtime.compiled import COMPILED
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
mission, law, preset, world, vehicle, *overrides = sys.argv[1:]
config = load_sitl(mission, vehicle or None, law, preset, overrides, world=world)
result = FastFlight(config).run(300.0)
flown = repr((result.inputs, result.outputs, result.snapshots, result.after))
print(COMPILED, len(result.outputs), result.outputs[-1].outcome.value, hashlib.sha256(flown.encode()).hexdigest())
"""
FLIGHTS = [
    ("catch", "adaptive", "recommended", "lab", ""),
    ("catch", "psc", "tuned", "ideal", ""),
    ("catch", "csc", "tuned", "robustness", "", "world.seed=7", "world.payload_kg=0.3"),
    ("hover", "adaptive", "paper", "lab", ""),
    ("circuit", "adaptive", "recommended", "lab", ""),
    ("hover", "adaptive", "recommended", "lab", "tarot650_4r"),
    ("hover", "adaptive", "recommended", "lab", "hexa_2r"),
    ("press", "adaptive", "recommended", "wall", ""),
    ("press", "adaptive", "recommended", "wall", "", "vehicle.force_source=observer", "world.seed=2"),
    ("slide", "adaptive", "recommended", "wall", "", "mission.phases[4].displacement_m=[0.0,-0.2]"),
    ("intercept", "adaptive", "recommended", "careless", ""),
    ("probe", "adaptive", "recommended", "wall", "", "mission.phases[3].rows=2", "mission.phases[3].columns=2"),
]
CAMPAIGNS = [
    ("robustness", str(CATCH), "--draws", "4", "--seed", "5", "--jobs", "1", "--json"),
    ("faults", str(CATCH), "--phases", "catch", "--jobs", "1", "--json"),
    ("faults", "--phases", "press", "--jobs", "1", "--json"),
]
"""The faults take the branches that a healthy flight does not."""


def run_by(path: Path, *arguments: str, cwd: Path = ROOT) -> str:
    """Run Python with modules from this folder. Return what it prints."""
    done = subprocess.run(
        [sys.executable, "-P", *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(path)},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout


@pytest.mark.skipif(not is_current(), reason="no compiled build of this source: make compile")
@pytest.mark.parametrize("flight", FLIGHTS, ids=" ".join)
def test_a_compiled_flight_is_bit_for_bit_the_interpreted_one(flight: tuple[str, ...]) -> None:
    compiled, interpreted = (run_by(path, "-c", FLIGHT, *flight).split() for path in (BUILD, ROOT))
    assert compiled[0] == "True"
    assert interpreted[0] == "False"
    assert compiled[1:] == interpreted[1:]
    assert interpreted[2] == "completed"


@pytest.mark.skipif(not is_current(), reason="no compiled build of this source: make compile")
@pytest.mark.parametrize("campaign", CAMPAIGNS, ids=" ".join)
def test_a_compiled_campaign_gives_the_rows_of_the_interpreted_one(tmp_path: Path, campaign: tuple[str, ...]) -> None:
    compiled, interpreted = (
        json.loads(run_by(path, "-m", "companion", *campaign, cwd=tmp_path))["rows"] for path in (BUILD, ROOT)
    )
    assert len(compiled) > 3
    assert compiled == interpreted


@pytest.mark.skipif(not is_current(), reason="no compiled build of this source: make compile")
def test_the_compiled_build_flies_over_wires(tmp_path: Path) -> None:
    flight = ("fly", str(HOVER), "--sitl", "--speed", "max", "--no-report", "--out", "out")
    settings = set_options(**USUAL, **LOW_HOVER)
    run_by(BUILD, "-m", "companion", *flight, *settings, cwd=tmp_path)
    summary = json.loads((tmp_path / "out/summary.json").read_bytes())
    assert summary["outcome"] == "completed"


def test_records_that_another_process_decodes_are_not_compiled() -> None:
    assert not {"companion/model/launcher_messages.py", "companion/model/types.py", "companion/model/verdict.py"} & set(
        modules()
    )


def test_the_list_of_modules_names_only_files_that_exist() -> None:
    assert set(modules()) >= {"companion/core/flight_core.py", "sitl/fast/loop.py", "sitl/world/effects/net.py"}
    assert all((ROOT / name).exists() for name in INTERPRETED)
    assert Path("companion/config/files/controllers/psc_tuned.yaml") in sources(), "settings, which the wheel contains"


@cache
def nodes() -> list[tuple[str, ast.AST]]:
    """Return the syntax of the compiled modules, each node with its file."""
    trees = ((name, ast.parse((ROOT / name).read_text(encoding="utf-8"))) for name in modules())
    return [(name, node) for name, tree in trees for node in ast.walk(tree)]


def test_no_tuple_of_floats_is_final() -> None:
    """mypyc 2.4 compiles some reads of such a constant to a NameError: `if (value.f0 != -113.0 && PyErr_Occurred())` is inverted."""
    final = [
        f"{name}:{node.lineno}"
        for name, node in nodes()
        if isinstance(node, ast.AnnAssign) and "Final" in ast.unparse(node.annotation)
        if isinstance(node.value, ast.Tuple) and any(is_float(element) for element in node.value.elts)
    ]
    assert final == []


def test_no_sum_is_added_to_a_sum() -> None:
    """mypyc takes `sum(a) + sum(b)` of floats for an int: a TypeError in flight."""
    added = [
        f"{name}:{node.lineno}"
        for name, node in nodes()
        if isinstance(node, ast.BinOp) and is_sum(node.left) and is_sum(node.right)
    ]
    assert added == []


def is_sum(node: ast.expr) -> bool:
    """Return whether the expression is a sum that starts at the int 0, or an arithmetic expression that contains one."""
    if isinstance(node, ast.BinOp):
        return is_sum(node.left) or is_sum(node.right)
    return isinstance(node, ast.Call) and ast.unparse(node.func) == "sum" and len(node.args) == 1


def is_float(node: ast.expr) -> bool:
    """Return whether the expression is the literal of a float, with or without a sign."""
    return isinstance(getattr(node, "operand", node), ast.Constant) and "." in ast.unparse(node)
