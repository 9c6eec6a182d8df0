"""The tables of docs/faults.md: `python -m tools.docs.faults docs/faults.md [faults.json]` writes them in their places.

The kinds are as the code has them; the outcomes of a campaign are written if its results are given.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from companion.campaigns.faults_table import kinds_markdown, outcomes_markdown
from tools.docs.tables import flown_by, write_page, write_results


def main(argv: list[str] | None = None) -> int:
    """Write the tables into a page."""
    parser = argparse.ArgumentParser(prog="tools.docs.faults")
    parser.add_argument("page", type=Path)
    parser.add_argument("results", type=Path, nargs="?", help="faults.json of a campaign")
    parser.add_argument("--name", default="campaign", help="of the table that the results go to (default: campaign)")
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
