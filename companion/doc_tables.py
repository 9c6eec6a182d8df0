"""Tables of the docs that are made from the code, each in its place: between `<!-- table: NAME -->` and `<!-- end: NAME -->`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path


def written(text: str, tables: Mapping[str, str]) -> str:
    """The page with these tables in their places.

    Raises:
        ValueError: a table's place is not marked in it.
    """
    for name, table in tables.items():
        begin, end = f"<!-- table: {name} -->\n", f"<!-- end: {name} -->\n"
        head, found, rest = text.partition(begin)
        _, closed, tail = rest.partition(end)
        if not found or not closed:
            raise ValueError(f"no place for the table '{name}': expected {begin.strip()} and {end.strip()}")
        text = f"{head}{begin}{table}\n{end}{tail}"
    return text


def write_page(page: Path, tables: Mapping[str, str]) -> int:
    """Write the tables into the page; an exit code, the reason on standard error."""
    try:
        page.write_text(written(page.read_text(encoding="utf-8"), tables), encoding="utf-8")
    except (OSError, ValueError) as error:
        print(f"{page}: {error}", file=sys.stderr)
        return 2
    return 0
