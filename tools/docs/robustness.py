"""Writes the results of a campaign into its page: `python -m tools.docs.robustness docs/internals/robustness.md robustness.json`."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from companion.campaigns.robustness.draws import graded
from tools.docs.tables import flown_by, write_results


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


def main(argv: list[str] | None = None) -> int:
    """Write the results into a page; return the exit code."""
    parser = argparse.ArgumentParser(prog="tools.docs.robustness")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, help="robustness.json of companion robustness")
    arguments = parser.parse_args(argv)
    return write_results(arguments.page, arguments.results, lambda results: {"result": result_markdown(results)})


if __name__ == "__main__":
    sys.exit(main())
