"""Shared options and output of the measuring commands: tables in the terminal and in Markdown, and the same rows as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from companion.config.document import ConfigError
from companion.recorder.versions import versions
from companion.sitl_config.loader import SitlConfig, load_sitl

LEFT = ("loop", "process")
"""Columns of words; all others hold figures."""


def number(value: float | None, digits: int = 2) -> str:
    """Return a figure as text for a table; None is a dash."""
    return "-" if value is None else f"{value:.{digits}f}"


def print_table(title: str, rows: Sequence[Mapping[str, str]], console: Console, red: Collection[int] = ()) -> None:
    """Print rows of cells by column name; the rows with an index in `red` have not met a limit."""
    table = Table(title=title, title_justify="left")
    for name in rows[0] if rows else ():
        table.add_column(name, justify="left" if name in LEFT else "right")
    for index, row in enumerate(rows):
        table.add_row(*row.values(), style="red" if index in red else "")
    console.print(table)


def write_json(path: Path | None, found: Any) -> None:
    """Write figures as JSON, unless no path was given."""
    if path is not None:
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def table_parser(text: str, **more: Any) -> argparse.ArgumentParser:
    """Return a parser of the options that all tables of flights have."""
    parser = argparse.ArgumentParser(description=text, **more)
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--table", type=Path, help="Markdown file to write; absent: standard output")
    return parser


def add_laws(parser: argparse.ArgumentParser, laws: str, laboratories: int) -> None:
    """Add the options of a comparison of laws, with their defaults."""
    parser.add_argument("--laws", default=laws, help="law/preset, ... (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=laboratories, help="flights per law and step (%(default)s)")


def laws_of(command: str, laws: str, mission: Path) -> dict[str, SitlConfig]:
    """Return the configuration of each of these laws in the laboratory; end the command with code 2 if one cannot be loaded."""
    try:
        return {law: load_sitl(mission, None, *law.split("/", 1), world="lab") for law in laws.split(",")}
    except ConfigError as error:
        print(f"{command}: {error}", file=sys.stderr)
        sys.exit(2)


def commit() -> str:
    """Return the commit that flies, abbreviated."""
    return versions().get("git", "unknown")[:10]


def publish(table: str, command: str, path: Path | None = None) -> None:
    """Write a table and the line that says how it was made; to standard output without a path."""
    text = f"{table}\nFlown by `python -m benchmarks.{command}` at commit {commit()}.\n"
    if path is None:
        print(text, end="")
    else:
        path.write_text(text, encoding="utf-8")
