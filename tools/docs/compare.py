"""Writes the tables of docs/compare.md: `python -m tools.docs.compare docs/compare.md compare.json`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.campaigns.compare.grid import LESS, is_ablation
from tools.docs.tables import flown_by, markdown, write_results

ABLATION_KG = 0.2
"""Payload of the table of ablations."""
_LAWS = ("payload", "law/preset", "e_p before, m", "e_p after, m", "e_q after, deg", "e_alpha after, deg", "arm dI, N m",
         "final e_z, m")  # fmt: skip
_ABLATIONS = (
    "taken away",
    "e_p before, m",
    "e_p after, m",
    "e_alpha after, deg",
    "arm dI, N m",
    "torque activity, N m",
)


def laws_markdown(aggregate: Sequence[dict[str, Any]]) -> str:
    """Return one line per payload and preset, without the ablations: means over the seeds."""
    rows = []
    for cell in aggregate:
        if not is_ablation(cell["preset"]):
            mean, before, after = _mean(cell)
            rows.append((
                f"{cell['payload_kg']:g} kg", f"{cell['controller']}/{cell['preset']}", f"{before['e_p_m']:.4f}",
                f"{after['e_p_m']:.4f}", f"{after['e_q_deg']:.2f}", f"{after['e_alpha_deg']:.1f}",
                f"{mean['impedance_error']['arm_nm']:.3f}", f"{mean['final_abs_e_z_m']:.3f}",
            ))  # fmt: skip
    return markdown(_LAWS, rows)


def ablation_markdown(aggregate: Sequence[dict[str, Any]]) -> str:
    """Return one line per ablation with `ABLATION_KG`: means over the seeds."""
    rows = []
    for cell in aggregate:
        if is_ablation(cell["preset"]) and cell["payload_kg"] == ABLATION_KG:
            mean, before, after = _mean(cell)
            rows.append((
                cell["preset"].partition(LESS)[2], f"{before['e_p_m']:.4f}", f"{after['e_p_m']:.4f}", f"{after['e_alpha_deg']:.1f}",
                f"{mean['impedance_error']['arm_nm']:.3f}", f"{mean['torque_activity_nm']:.3f}",
            ))  # fmt: skip
    return markdown(_ABLATIONS, rows)


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
