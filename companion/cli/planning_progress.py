"""Progress bar for planning and checking a mission; shown in a terminal if this takes long."""

from __future__ import annotations

import sys
import time
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from companion.runtime.clock import Clock
from companion.runtime.console import console_on

SHOW_AFTER_S = 1.0
"""Time after which the bar appears."""


class PlanningProgress:
    """Progress callback for `companion.mission.check.check_mission`.

    Args:
        console: console of the bar; None for standard error. Without a terminal there is no bar.
        now_s: clock, s.
    """

    def __init__(self, console: Console | None = None, now_s: Clock = time.monotonic) -> None:
        self._now_s = now_s
        self._start_s = now_s()
        console = console or console_on(sys.stderr)
        self._visible = console.is_terminal
        self._shown = False
        self._progress = Progress(
            TextColumn("planning"),
            BarColumn(bar_width=32),
            TextColumn("{task.percentage:>3.0f} %"),
            console=console,
            transient=True,
        )
        self._task = self._progress.add_task("planning", total=1.0)

    def __enter__(self) -> Self:
        self._start_s = self._now_s()
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            self._progress.stop()

    def __call__(self, share: float) -> None:
        """Show the completed fraction, 0 to 1."""
        if not self._visible or self._now_s() - self._start_s < SHOW_AFTER_S:
            return
        self._progress.update(self._task, completed=share)
        if not self._shown:
            self._shown = True
            self._progress.start()
