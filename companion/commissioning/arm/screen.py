"""What the arm's tools show at a terminal, and the keys that they take there."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator, Mapping, Sequence
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from companion.model.rows import Level, Row
from companion.runtime.console import console_on

_STYLES = {"ok": "green", "WARN": "yellow", "FAIL": "bold red"}


def people_console(json: bool) -> Console:
    """Where people are told: standard output, or standard error when that is for a script."""
    console = console_on(sys.stderr if json else sys.stdout)
    if not console.is_terminal:
        console.width = max(console.width, 132)
    return console


def say(console: Console, text: str, style: str = "") -> None:
    """One line, as it is."""
    console.print(Text(text, style=style), soft_wrap=True)


def show_rows(console: Console, rows: Sequence[Row], quiet_groups: Mapping[str, str]) -> None:
    """What was found, what would be right, what to do.

    Args:
        console: where.
        rows: one each.
        quiet_groups: beginnings of ids, each with a title: of these rows only those that are not ok are shown one by one.
    """
    table = Table.grid(padding=(0, 2, 0, 0))
    for _ in range(4):
        table.add_column(overflow="fold")
    quiet: dict[str, int] = {}
    for row in rows:
        group = row.id.rpartition(".")[0]
        if row.ok and group in quiet_groups:
            quiet[group] = quiet.get(group, 0) + 1
            continue
        mark = "ok" if row.ok else "WARN" if row.level is Level.WARN else "FAIL"
        table.add_row(Text(mark, style=_STYLES[mark]), Text(row.title), Text(row.read), Text(row.wanted, style="dim"))
    for group, count in quiet.items():
        title = quiet_groups[group]
        every = "all" if not any(not row.ok and row.id.startswith(f"{group}.") for row in rows) else "the other"
        table.add_row(
            Text("ok", style=_STYLES["ok"]), Text(title), Text(f"{every} {count} are as they must be"), Text("")
        )
    console.print(table)
    for row in rows:
        if not row.ok:
            say(console, f"{row.title}: {row.read}", "bold")
            say(console, f"  -> {row.fix}")
            say(console, f"     {row.why}", "dim")


class Bars:
    """Two live bars, or one line whenever something new is asked for where there is no terminal."""

    def __init__(self, console: Console, names: Sequence[str]) -> None:
        self._console = console
        self._said = ""
        self._progress = Progress(
            TextColumn("  {task.description:<10}"),
            BarColumn(bar_width=30),
            TextColumn("{task.fields[seen]}", markup=False),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._tasks = [self._progress.add_task(name, total=1.0, seen="") for name in names]

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, shares: Sequence[float], seen: Sequence[str]) -> None:
        """How full each bar is, 0 to 1, and what stands behind it."""
        for task, share, text in zip(self._tasks, shares, seen, strict=True):
            self._progress.update(task, completed=max(0.0, min(1.0, share)), seen=text)

    def say(self, text: str, style: str = "") -> None:
        """A line above the bars, unless it is what was said last."""
        if text and text != self._said:
            styled = f"[{style}]{escape(text)}[/]" if style else escape(text)
            self._progress.console.print(f"  {styled}", highlight=False, soft_wrap=True)
        self._said = text


@contextlib.contextmanager
def raw_keys() -> Iterator[int | None]:
    """Keys as they are pressed: the descriptor to read them from; None: standard input is no terminal."""
    if sys.stdin is None or not sys.stdin.isatty():
        yield None
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor, termios.TCSANOW)
    try:
        yield descriptor
    finally:
        termios.tcsetattr(descriptor, termios.TCSANOW, before)


def pressed(descriptor: int | None) -> str:
    """What was pressed meanwhile; empty: nothing."""
    if descriptor is None or not select.select([descriptor], [], [], 0.0)[0]:
        return ""
    return os.read(descriptor, 64).decode(errors="replace")


def ask(console: Console, question: str) -> bool | None:
    """Yes or no, at a terminal; None: nobody can be asked."""
    if sys.stdin is None or not sys.stdin.isatty():
        return None
    say(console, f"{question} [y/N]", "bold")
    return sys.stdin.readline().strip().lower() in ("y", "yes")
