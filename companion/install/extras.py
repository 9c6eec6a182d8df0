"""Optional packages (extras) that some commands need and a flight-only installation lacks."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable

from companion import DISTRIBUTION

_WORLD = (("the simulated world", "mujoco"),)
_NEEDS = {
    "sitl": _WORLD,
    "compare": _WORLD,
    "robustness": _WORLD,
    "faults": _WORLD,
    "tune": (*_WORLD, ("the search", "cma")),
    "identify": (("the fit", "scipy"),),
}
"""What needs which package of the extra `sitl`, by command. `monitor` and `broker init` check their own."""


def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def missing_extra(arguments: argparse.Namespace, here: Callable[[str], bool] = _installed) -> str | None:
    """Return one line if the command needs a package that is not installed, else None."""
    what, needs = f"companion {arguments.command}", _NEEDS.get(arguments.command)
    if needs is None and getattr(arguments, "sitl", None):
        what, needs = f"{what} --sitl", _WORLD
    if needs is None or getattr(arguments, "list", False):
        return None
    missing = [f"{part} needs {package}" for part, package in needs if not here(package)]
    return f"{what}: {missing[0]}: pip install '{DISTRIBUTION}[sitl]'" if missing else None
