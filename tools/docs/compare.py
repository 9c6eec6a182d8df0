"""The tables of docs/compare.md from a comparison: `python -m tools.docs.compare docs/compare.md compare.json`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tools.docs.tables import flown_by, write_results

ABLATION_KG = 0.2
"""The payload of the table of what each option is worth."""
_LAWS = ("payload", "law/preset", "e_p before, m", "e_p after, m", "e_q after, deg", "e_alpha after, deg", "arm dI, N m",
         "final e_z, m")  # fmt: skip
_TAKEN_AWAY = (
    "taken away",
    "e_p before, m",
    "e_p after, m",
    "e_alpha after, deg",
    "arm dI, N m",
    "torque activity, N m",
)


def laws_markdown(aggregate: Sequence[dict[str, Any]]) -> str:
    """One line per payload and preset, mean of the seeds; what something was taken away from is not among them."""
    lines = _head(_LAWS)
    for cell in aggregate:
        if _taken_away(cell) is None:
            mean, before, after = _mean(cell)
            lines.append(
                f"| {cell['payload_kg']:g} kg | {cell['controller']}/{cell['preset']} | {before['e_p_m']:.4f} | {after['e_p_m']:.4f} "
                f"| {after['e_q_deg']:.2f} | {after['e_alpha_deg']:.1f} | {mean['impedance_error']['arm_nm']:.3f} "
                f"| {mean['final_abs_e_z_m']:.3f} |"
            )
    return "\n".join(lines)


def ablation_markdown(aggregate: Sequence[dict[str, Any]]) -> str:
    """One line per thing that was taken away, mean of the seeds at `ABLATION_KG`."""
    lines = _head(_TAKEN_AWAY)
    for cell in aggregate:
        name = _taken_away(cell)
        if name is not None and cell["payload_kg"] == ABLATION_KG:
            mean, before, after = _mean(cell)
            lines.append(
                f"| {name} | {before['e_p_m']:.4f} | {after['e_p_m']:.4f} | {after['e_alpha_deg']:.1f} "
                f"| {mean['impedance_error']['arm_nm']:.3f} | {mean['torque_activity_nm']:.3f} |"
            )
    return "\n".join(lines)


def _head(names: Sequence[str]) -> list[str]:
    return [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]


def _taken_away(cell: dict[str, Any]) -> str | None:
    _, dash, name = cell["preset"].partition(" - ")
    return name if dash else None


def _mean(cell: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    mean = cell["mean"]
    return mean, mean["rms"]["pre"], mean["rms"]["post"]


def main(argv: list[str] | None = None) -> int:
    """Write the tables into a page."""
    parser = argparse.ArgumentParser(prog="tools.docs.compare")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, help="compare.json of companion compare --ablation")
    arguments = parser.parse_args(argv)
    return write_results(arguments.page, arguments.results, tables)


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Return both tables, each with the command and the commit of its figures."""
    aggregate, below = results["aggregate"], flown_by(results)
    return {"laws": laws_markdown(aggregate) + "\n" + below, "ablation": ablation_markdown(aggregate) + "\n" + below}


if __name__ == "__main__":
    sys.exit(main())
