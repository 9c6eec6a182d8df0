"""Which extra of the package a command needs that a flight-only installation lacks."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable

_WORLD = ("mujoco", "sitl")
_NEEDS = {"sitl": _WORLD, "compare": _WORLD, "robustness": _WORLD, "faults": _WORLD}
"""Command: package, and the extra that brings it. Commands with parts say it themselves (`monitor`, `broker init`)."""


def _here(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def lacking(arguments: argparse.Namespace, here: Callable[[str], bool] = _here) -> str | None:
    """One line: what the command needs and is not installed; None: it has all.

    Args:
        arguments: of the command, parsed.
        here: whether a package can be imported.
    """
    what, needs = f"companion {arguments.command}", _NEEDS.get(arguments.command)
    if needs is None and getattr(arguments, "sitl", None):
        what, needs = f"{what} --sitl", _WORLD
    if needs is None or getattr(arguments, "list", False) or here(needs[0]):
        return None
    package, extra = needs
    return f"{what}: the simulated world needs {package}: pip install 'companion[{extra}]'"
