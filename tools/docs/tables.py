"""Writes generated tables into pages of the docs, between `<!-- table: NAME -->` and `<!-- end: NAME -->`."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any


def written(text: str, tables: Mapping[str, str]) -> str:
    """Return the page with these tables inserted.

    Raises:
        ValueError: the page has no marks for one of the tables.
    """
    for name, table in tables.items():
        begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->\n"
        head, found, rest = text.partition(begin)
        _, closed, tail = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"the marks of the table '{name}' are missing: expected {begin.strip()} and {end.strip()}")
        text = f"{head}{begin}{table}\n{end}{tail}"
    return text


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(head)}", *lines[1:]])


def write_page(page: Path, tables: Mapping[str, str]) -> int:
    """Write the tables into the page; return an exit code and print the reason for a failure on standard error."""
    try:
        page.write_text(written(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
    except (OSError, ValueError) as error:
        print(f"{page}: {error}", file=sys.stderr)
        return 2
    return 0


def write_generated(program: str, tables: Mapping[str, str]) -> int:
    """Write tables that are made from the code into the page that the command line names; return an exit code."""
    parser = argparse.ArgumentParser(prog=program, description="Write the tables of a page from the code.")
    parser.add_argument("page", type=Path)
    return write_page(parser.parse_args().page, tables)


def flown_by(results: Mapping[str, Any]) -> str:
    """Return the line below a table that states the command and the commit with which its figures were produced.

    Args:
        results: content of the JSON file from `companion compare`, `robustness` or `faults`.

    Raises:
        KeyError: the file was written by a version that did not record its command.
    """
    commit = results["versions"].get("git", "unknown")
    dirty = " with changes" if commit.endswith("-dirty") else ""
    command = re.sub(r" --(out|jobs) \S+", "", results["settings"]["command"])
    return f"\nFlown by `{command}` at commit {commit.removesuffix('-dirty')[:10]}{dirty}."


def write_results(page: Path, file: Path, tables_of: Callable[[dict[str, Any]], Mapping[str, str]]) -> int:
    """Write the tables made from a results file into the page.

    Args:
        page: page with marked locations of the tables.
        file: JSON of a campaign.
        tables_of: returns the tables by name; may raise KeyError or ValueError.

    Returns:
        An exit code. The reason for a failure is printed on standard error.
    """
    try:
        tables = tables_of(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError) as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        print(f"{file}: {reason}", file=sys.stderr)
        return 2
    return write_page(page, tables)
