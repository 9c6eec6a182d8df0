"""Writes the tables of docs/internals/faults.md: `python -m tools.docs.faults docs/internals/faults.md [faults.json]`.

The kinds come from the code. The outcomes are written only if the results of a campaign are given.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.analysis.table import number
from companion.campaigns.faults.campaign import extreme, shown_size, size_meaning
from companion.campaigns.faults.judge import good
from companion.campaigns.runner import Row
from companion.sitl_config.faults import KINDS, PHASES
from tools.docs.tables import flown_by, markdown, write_page, write_results


def kinds_markdown() -> str:
    """Return the table of the kinds of faults."""
    rows = []
    for name, kind in KINDS.items():
        reported_by = ", ".join(f"`{event}`" for event in kind.named_by) or "none: no reaction is needed"
        rows.append(
            (f"`{name}`", kind.what, size_meaning(kind.size, kind.unit), number(kind.default, "g"), reported_by)
        )
    return markdown(("kind", "what happens", "size", "default", "reported by"), rows)


def outcomes_markdown(rows: Sequence[Row]) -> str:
    """Return one line per fault and size: the outcome in each phase with the detection time in s, and the worst values over all
    phases.
    """
    phases = [phase for phase in PHASES if any(row["phase"] == phase for row in rows)]
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["fault"], row["size"], row["duration_s"]), []).append(row)
    lines = []
    for group in groups.values():
        by_phase = {row["phase"]: row for row in reversed(group)}
        worst = (
            number(extreme(group, "worst_tilt_deg", max), ".0f"),
            number(extreme(group, "min_height_m", min), ".2f"),
            number(extreme(group, "min_slack_m", min), ".2f"),
            number(extreme(group, "drift_m", max), ".2f"),
        )
        cells = [_outcome(by_phase[phase]) if phase in by_phase else "" for phase in phases]
        lines.append((f"`{group[0]['fault']}`", shown_size(group[0]), *cells, *worst))
    return markdown(("fault", "size", *phases, "tilt, deg", "height, m", "slack, m", "drift, m"), lines)


def _outcome(row: Row) -> str:
    outcome = row["outcome"] if good(row) else f"**{row['outcome']}**"
    return f"{outcome} {number(row['detected_s'], '.2f')}".strip()


def main(argv: list[str] | None = None) -> int:
    """Write the tables into a page; return the exit code."""
    parser = argparse.ArgumentParser(prog="tools.docs.faults")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, nargs="?", help="faults.json of a campaign")
    parser.add_argument("--name", default="campaign", help="name of the table for the results (default: campaign)")
    arguments = parser.parse_args(argv)
    kinds, name = kinds_markdown(), arguments.name
    if arguments.results is None:
        return write_page(arguments.page, {"kinds": kinds})
    return write_results(
        arguments.page,
        arguments.results,
        lambda results: {"kinds": kinds, name: outcomes_markdown(results["rows"]) + "\n" + flown_by(results)},
    )


if __name__ == "__main__":
    sys.exit(main())
