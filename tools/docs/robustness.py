"""Writes the results of campaigns into their page: `python -m tools.docs.robustness docs/internals/robustness.md robustness.json`.

Results of a team file are written with those of other campaigns beside them: `--beside stiff FILE`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.campaigns.compare.aggregate import median_95
from companion.campaigns.robustness.draws import graded
from companion.campaigns.runner import Row
from companion.model.types import Outcome
from tools.docs.tables import flown_by, markdown, write_results

SHARE_OFF = 0.1
"""Largest relative difference of a vehicle's share of the weight from the wanted one that counts as met."""


def result_markdown(results: dict[str, Any]) -> str:
    """Return the number of flights by outcome and the distribution of the position error after the catch as text."""
    rows, settings, summary = results["rows"], results["settings"], results["summary"]
    errors_mm = [1000.0 * row["e_p_m"] for row in graded(rows)]
    outcomes = ", ".join(
        f"{count} {outcome}" for outcome, count in Counter(row["outcome"] for row in rows).most_common()
    )
    p50, p95, largest = (f"{value:.1f} mm" for value in np.percentile(errors_mm, [50, 95, 100]))
    model_errors = ", ".join(f"{100 * error:g} %" for error in sorted({row["model_error"] for row in rows}))
    return (
        f"{len(rows)} draws of the world `{settings['world']}`, seed {settings['seed']}, model error {model_errors}, "
        f"`{settings['controller']}/{settings['preset']}`: {outcomes}; "
        f"{summary['caught']} payloads were caught, {summary['missed']} missed the net.\n"
        f"RMS of the position error after the catch: p50 {p50}, p95 {p95}, largest {largest}.\n{flown_by(results)}"
    )


def carry_markdown(campaigns: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the figures of the bar for each campaign of a team, by name; those of the others with their ratio to the first."""
    first = next(iter(campaigns.values()))
    lines = []
    for name, results in campaigns.items():
        rows: Sequence[Row] = results["rows"]
        done = completed(rows)
        counts = Counter(row["outcome"] for row in rows)
        met = sum(abs(row["share"] / row["share_wanted"] - 1.0) <= SHARE_OFF for row in done)
        ended = f"{len(rows)}: {', '.join(f'{count} {outcome}' for outcome, count in counts.most_common())}"
        figures = [_figure(key, scale, form, first["rows"], rows) for key, scale, form in CARRY_FIGURES]
        lines.append((name, ended, *figures, f"{met} of {len(done)}"))
    head = ("", "flights", "error of its centre, mm", "tilt, deg", "force that stretches it, N", "share met")
    return markdown(head, lines) + "\n" + "\n".join(flown_by(results) for results in campaigns.values())


CARRY_FIGURES = (("bar_p_rms_m", 1e3, ".1f"), ("bar_tilt_rms_deg", 1.0, ".2f"), ("internal_force_rms_n", 1.0, ".2f"))


def completed(rows: Sequence[Row]) -> list[Row]:
    """Return the completed flights."""
    return [row for row in rows if row["outcome"] == Outcome.COMPLETED.value]


def _figure(key: str, scale: float, form: str, first: Sequence[Row], rows: Sequence[Row]) -> str:
    """Return p50 and p95 of a figure and, for another campaign than the first, the median ratio to it with its 95 % interval."""
    p50, p95 = (f"{scale * value:{form}}" for value in np.percentile([row[key] for row in completed(rows)], [50, 95]))
    base = {row["number"]: row[key] for row in completed(first)}
    found = median_95([row[key] / base[row["number"]] for row in completed(rows) if row["number"] in base])
    if rows is first or found is None:
        return f"{p50} / {p95}"
    middle, low, high = found
    return f"{p50} / {p95}; {middle:.2f} ({low:.2f} to {high:.2f})"


def main(argv: list[str] | None = None) -> int:
    """Write the results into a page; return the exit code."""
    parser = argparse.ArgumentParser(prog="tools.docs.robustness")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, help="robustness.json of companion robustness")
    parser.add_argument(
        "--name", default="as shipped", help="name of these results of a team file (default: as shipped)"
    )
    parser.add_argument(
        "--beside", nargs=2, action="append", default=[], metavar=("NAME", "FILE"), help="results compared with them"
    )
    arguments = parser.parse_args(argv)

    def tables_of(results: dict[str, Any]) -> dict[str, str]:
        if "team" not in results["settings"]:
            return {"result": result_markdown(results)}
        others = {name: json.loads(Path(file).read_text(encoding="utf-8")) for name, file in arguments.beside}
        return {"carry": carry_markdown({arguments.name: results, **others})}

    return write_results(arguments.page, arguments.results, tables_of)


if __name__ == "__main__":
    sys.exit(main())
