"""Writes the tables of docs/internals/preflight.md from the checks: `python -m tools.docs.preflight docs/internals/preflight.md`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from companion.preflight import arm, estimator, force, frames, machine, mission, mocap, px4, tether
from companion.preflight.checks import Check
from tools.docs.tables import markdown, write_generated

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
    rows = ((f"`{c.id}`", c.title, c.wanted, f"{c.why}{' (warns only)' if c.warns else ''}") for c in checks)
    return markdown(("row", "quantity", "expected", "consequence of a failure"), rows)


def tables() -> dict[str, str]:
    """Return the tables by name."""
    return {name: checks_table(checks) for name, checks in ROOMS.items()}


if __name__ == "__main__":
    sys.exit(write_generated("tools.docs.preflight", tables()))
