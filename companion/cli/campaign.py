"""What the commands that fly campaigns have in common: folder, progress, Ctrl-C, exit code."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib.metadata
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion.campaigns.process import CampaignError
from companion.config.document import ConfigError
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK
from companion.runtime.console import tell, terminal_console

PIPED_WIDTH = 132
"""Columns of a table that no terminal limits."""

_Result = TypeVar("_Result")


def count(text: str) -> int:
    """A number of flights, seeds or processes, for argparse."""
    if not text.isdecimal() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"expected a number from 1 to 10000, got '{text}'")
    return int(text)


def wide_console(width: int = PIPED_WIDTH) -> Console:
    """The terminal; into a pipe, tables as wide as they like."""
    console = terminal_console()
    if not console.is_terminal:
        console.width = max(console.width, width)
    return console


def why_unusable(folder: Path, result: str) -> str | None:
    """Make the folder; None if results can be left in it, `result` the file by which one in use is known."""
    try:
        if folder.exists() and not folder.is_dir():
            return "is a file; choose a folder"
        if (folder / result).exists():
            return f"there is a {result} already; choose another folder"
        folder.mkdir(parents=True, exist_ok=True)
        # Only trying tells: root may write where the permissions say no, and nobody may in some file systems.
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return f"{error.strerror}; choose a folder that can be written to"


@dataclass(frozen=True, slots=True)
class Place:
    """Where a campaign leaves its files."""

    folder: Path
    chosen: bool
    """By the user; else it is ours to remove if nothing came of it."""

    @classmethod
    def of(cls, command: str, asked: str | None, parent: str, result: str) -> Place:
        """The folder that was asked for, or a new one under `parent`; made.

        Raises:
            ConfigError: it cannot be had.
        """
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = Path(asked) if asked is not None else Path(parent) / stamp
        problem = "expected the name of a folder, got an empty one" if asked == "" else why_unusable(folder, result)
        if problem is not None:
            raise ConfigError([f"companion {command}: --out {folder}: {problem}"])
        return cls(folder, asked is not None)

    def leave_empty(self) -> None:
        """Nothing came of it: take the folder away again, if nothing is in it."""
        with contextlib.suppress(OSError):
            self.folder.rmdir()
            if not self.chosen:
                self.folder.parent.rmdir()


@dataclass
class Flown(Generic[_Result]):
    """What came of a campaign: results by their position in it."""

    results: dict[int, _Result] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """Why it is not complete."""
    code: int = EXIT_OK

    @property
    def rows(self) -> list[_Result]:
        """In the order of the campaign."""
        return [self.results[index] for index in sorted(self.results)]

    def tell_notes(self, command: str) -> None:
        """To the terminal."""
        for note in self.notes:
            tell(f"companion {command}: {note}")


def fly(
    results: Iterable[tuple[int, _Result]],
    whole: int,
    stop: Callable[[], None],
    describe: Callable[[Flown[_Result], _Result], str],
) -> Flown[_Result]:
    """Take the results as they come, with a progress bar; Ctrl-C ends it, and what was flown until then is kept.

    Args:
        results: position and result of each flight, in any order.
        whole: how many there should be.
        stop: asks for the end of `results`; safe in a signal handler.
        describe: a few words beside the bar, after the newest result.
    """
    flown: Flown[_Result] = Flown()
    console = Console(stderr=True)
    progress = Progress(
        TextColumn("flying"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.description}[/]"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with _interrupts(stop), progress:
        task = progress.add_task("", total=whole)
        try:
            for index, result in results:
                flown.results[index] = result
                progress.update(task, advance=1, description=describe(flown, result))
        except CampaignError as error:
            flown.notes.append(str(error))
            flown.code = EXIT_BAD_INPUT if error.bad_input else EXIT_LOST
    if len(flown.results) < whole and flown.code != EXIT_BAD_INPUT:
        if not flown.notes:
            flown.notes.append("interrupted")
            flown.code = EXIT_ABORTED
        flown.notes.append(f"{len(flown.results)} of {whole} flights were flown")
    return flown


@contextlib.contextmanager
def _interrupts(stop: Callable[[], None]) -> Iterator[None]:
    """While inside: Ctrl-C and SIGTERM end the campaign."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.signal(number, lambda *_: stop()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def versions() -> dict[str, str]:
    """Of the packages that a campaign's figures depend on."""
    from companion.recorder.versions import versions as of_flight

    found = of_flight()
    for package in ("mujoco", "joblib", "distributed"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found
