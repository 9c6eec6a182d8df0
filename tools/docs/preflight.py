"""Writes the tables of docs/internals/preflight.md from the checks: `python -m tools.docs.preflight docs/internals/preflight.md`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from companion.preflight import arm, estimator, force, frames, machine, mission, mocap, px4, tether
from companion.preflight.checks import Check
from tools.docs.tables import write_page

ROOMS: dict[str, Sequence[Check]] = {
    "px4": (*px4.CHECKS, *estimator.CHECKS),
    "mocap": mocap.CHECKS,
    "frames": frames.CHECKS,
    "arm": arm.CHECKS,
    "force": force.CHECKS,
    "tether": tether.CHECKS,
    "mission": mission.CHECKS,
    "machine": machine.CHECKS,
}


def checks_table(checks: Sequence[Check]) -> str:
    """Return a table with one row per check."""
    lines = ["| row | quantity | expected | consequence of a failure |", "|---|---|---|---|"]
    for check in checks:
        consequence = f"{check.why}{' (warns only)' if check.warns else ''}"
        lines.append(f"| `{check.id}` | {check.title} | {check.wanted} | {consequence} |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """Return the tables by name."""
    return {name: checks_table(checks) for name, checks in ROOMS.items()}


def main(argv: list[str] | None = None) -> int:
    """Write the tables into a page; return the exit code."""
    parser = argparse.ArgumentParser(prog="tools.docs.preflight", description=__doc__)
    parser.add_argument("page", type=Path)
    return write_page(parser.parse_args(argv).page, tables())


if __name__ == "__main__":
    sys.exit(main())
