"""Progress bars for the user, and single keys read from a terminal."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn


class Bars:
    """Live progress bars, each followed by a text; without a terminal only the lines of `say` are printed."""

    def __init__(self, console: Console, names: Sequence[str]) -> None:
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
        """Fill each bar to its fraction, 0 to 1, and show the text that follows it."""
        for task, share, text in zip(self._tasks, shares, seen, strict=True):
            self._progress.update(task, completed=max(0.0, min(1.0, share)), seen=text)

    def say(self, text: str, style: str = "") -> None:
        """Print a line above the bars, unless it repeats the last one."""
        if text and text != self._said:
            styled = f"[{style}]{escape(text)}[/]" if style else escape(text)
            self._progress.console.print(f"  {styled}", highlight=False, soft_wrap=True)
        self._said = text


@contextlib.contextmanager
def raw_keys() -> Iterator[int | None]:
    """Yield the descriptor from which keys are read as they are pressed; None if standard input is not a terminal."""
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
    """Return the keys pressed since the last call, without waiting."""
    if descriptor is None or not select.select([descriptor], [], [], 0.0)[0]:
        return ""
    return os.read(descriptor, 64).decode(errors="replace")
