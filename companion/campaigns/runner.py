"""Runs any campaign: flies it, summarises the results, writes them as CSV, JSON and HTML, and prints them. A `Campaign` defines its
flights and its output.
"""

from __future__ import annotations

import contextlib
import csv
import importlib.metadata
import json
import signal
import sys
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion import DISTRIBUTION
from companion.analysis.flat import flat
from companion.analysis.page import Page, Picture, Section, write_page
from companion.campaigns.process import CampaignError, CampaignProcess, Message
from companion.model.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK
from companion.runtime.console import console_on, print_error
from companion.runtime.subprocesses import signals_call
from companion.sitl_config.loader import SitlConfig

INTERRUPTS = (signal.SIGINT, signal.SIGTERM)
Row = dict[str, Any]
"""The results of one flight as plain data, as `--json` prints it."""


class Flights(Protocol):
    """Flights in progress."""

    def results(self) -> Iterator[Message]:
        """Yield a message with at least `{index, row, wall_s}` as each flight ends, in any order.

        Raises:
            CampaignError: the campaign cannot continue.
        """

    def ask_to_stop(self) -> None:
        """Make `results` end soon. May be called in a signal handler."""


@dataclass(kw_only=True)
class Campaign(ABC):
    """Flights of one campaign and the presentation of its results."""

    name: ClassVar[str]
    """Name of the command and of its result files."""
    csv_name: ClassVar[str]

    configs: Sequence[SitlConfig]
    """Effective configurations; each flight refers to one of them by its position."""
    flights: Sequence[Message]
    """Each flight in the format of `sitl.campaigns`."""
    command: str
    overrides: Sequence[str] = ()
    jobs: int | None = None
    """Number of processes; None for one per core."""
    scheduler: str | None = None
    """Address of a Dask scheduler; None to fly on this computer."""

    @property
    def world(self) -> str:
        """Name of the world in which the campaign flies."""
        return self.configs[0].laboratory.name

    def job(self) -> Message:
        """Return the job for `sitl.campaigns`."""
        return {
            "campaign": self.name,
            "configs": [config.model_dump(mode="json") for config in self.configs],
            "flights": list(self.flights),
            "jobs": self.jobs,
            "scheduler": self.scheduler,
        }

    def start(self, out: Path) -> AbstractContextManager[Flights]:
        """Start the flights; `out` is the folder of the results."""
        return CampaignProcess(self.job(), out / "campaign.log")

    def settings(self) -> dict[str, Any]:
        """Return the settings of the campaign for the results file."""
        sources = self.configs[0].sources
        return {
            "command": self.command,
            "mission": sources.mission,
            "vehicle": sources.vehicle,
            "world": self.world,
            "overrides": list(self.overrides),
        }

    @abstractmethod
    def label(self, row: Row) -> str:
        """Return the label that distinguishes a flight from the others."""

    @abstractmethod
    def summary(self, rows: Sequence[Row]) -> dict[str, Any]:
        """Return the entries of the JSON output other than `rows`."""

    def csv_row(self, row: Row) -> Mapping[str, Any]:
        """Return the row as columns of the CSV file."""
        return {key: "; ".join(value) if isinstance(value, list) else value for key, value in flat(row)}

    @abstractmethod
    def page(self, rows: Sequence[Row], pictures: Sequence[Picture]) -> Page:
        """Return the content of the HTML page."""

    def draw(self, rows: Sequence[Row], out: Path) -> list[Picture]:
        """Write the plots, if there are any, and return them.

        Raises:
            ImportError: matplotlib is not installed.
        """
        return []

    @abstractmethod
    def show(self, rows: Sequence[Row], console: Console) -> None:
        """Print the results."""

    def write_extra_files(self, rows: Sequence[Row], out: Path) -> None:  # noqa: B027 (most campaigns have no more files)
        """Write the files that only this campaign has."""

    def good(self, rows: Sequence[Row]) -> bool:
        """Return whether the results are good; False ends the command with exit code 5."""
        return True


@dataclass
class CampaignResult:
    """Results of a whole campaign."""

    messages: list[Message]
    notes: list[str] = field(default_factory=list)
    code: int = EXIT_OK

    @property
    def rows(self) -> list[Row]:
        """The row of each flight."""
        return [message["row"] for message in self.messages]


def run(campaign: Campaign, out: Path, console: Console | None) -> int:
    """Fly the campaign, write its files into `out` and print its results.

    Args:
        out: an existing folder; stays empty if no flight ended.
        console: where to print the tables; None to print the rows and their summary as JSON instead.

    Returns:
        The exit code.
    """
    flown = fly(campaign, out)
    if flown.messages:
        _publish(campaign, flown, out, console)
    for note in flown.notes:
        print_error(f"companion {campaign.name}: {note}")
    if flown.messages and not campaign.good(flown.rows):
        return EXIT_LOST
    return flown.code


def fly(campaign: Campaign, out: Path) -> CampaignResult:
    """Fly the campaign and show a progress bar. Ctrl-C and SIGTERM end it; the results of flights that have ended are kept."""
    results: dict[int, Message] = {}
    notes: list[str] = []
    code, whole, bad = EXIT_OK, len(campaign.flights), 0
    with campaign.start(out) as flights, signals_call(INTERRUPTS, flights.ask_to_stop), progress_bar() as bar:
        task = bar.add_task("", total=whole)
        try:
            for message in flights.results():
                results[message["index"]] = message
                bad += not campaign.good([message["row"]])
                bar.update(task, advance=1, description=_progress(campaign, message, bad))
        except CampaignError as error:
            notes.append(str(error))
            code = error.exit_code
    if len(results) < whole and code != EXIT_BAD_INPUT:
        if not notes:
            notes.append("interrupted")
            code = EXIT_ABORTED
        notes.append(f"{len(results)} of {whole} flights were flown")
    return CampaignResult([results[index] for index in sorted(results)], notes, code)


def _progress(campaign: Campaign, newest: Message, bad: int) -> str:
    row = newest["row"]
    return f"{campaign.label(row)}: {row['outcome']}" + (f"; {bad} bad" if bad else "")


def progress_bar() -> Progress:
    """Return a progress bar on standard error, which is shown on a terminal only."""
    console = console_on(sys.stderr)
    return Progress(
        TextColumn("flying"),
        BarColumn(bar_width=32),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.description}[/]"),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


def _publish(campaign: Campaign, flown: CampaignResult, out: Path, console: Console | None) -> None:
    table = {"rows": flown.rows, **campaign.summary(flown.rows)}
    try:
        _write(campaign, flown, table, out)
    except OSError as error:
        print_error(f"companion {campaign.name}: {error.filename or out}: cannot be written: {error.strerror}")
        flown.code = flown.code or EXIT_LOST
    if console is None:
        sys.stdout.write(to_json(table))
        sys.stdout.flush()
        return
    campaign.show(flown.rows, console)
    page = out / f"{campaign.name}.html"
    print_lines(console, f"\nreport  {page}")


def _write(campaign: Campaign, flown: CampaignResult, table: dict[str, Any], out: Path) -> None:
    rows, settings, used = flown.rows, campaign.settings(), versions()
    write_csv((campaign.csv_row(row) for row in rows), out / campaign.csv_name)
    try:
        pictures = campaign.draw(rows, out)
    except ImportError:
        print_error(no_plots(campaign.name))
        pictures = []
    page = campaign.page(rows, pictures)
    record = {
        "Internal errors": "\n".join(f"{campaign.label(row)}: {row['error']}" for row in rows if row["error"]),
        "Settings": json.dumps(settings, indent=2),
        "Versions": json.dumps(used, indent=2),
    }
    sections = [*page.sections, Section("Record", folded=record)]
    write_page(replace(page, sections=sections, notes=flown.notes), out / f"{campaign.name}.html")
    campaign.write_extra_files(rows, out)
    wall_s = [message["wall_s"] for message in flown.messages]
    # This file is written last: if it exists, all the others exist.
    whole = {**table, "settings": settings, "versions": used, "notes": flown.notes, "wall_s": wall_s}
    (out / f"{campaign.name}.json").write_text(to_json(whole), encoding="utf-8")


def no_plots(command: str) -> str:
    """Return the message of a command that leaves out the plots because matplotlib is not installed."""
    return f"companion {command}: plots need matplotlib: pip install '{DISTRIBUTION}[analysis]'"


def print_lines(console: Console, *lines: str) -> None:
    """Print lines as they are: without markup, highlights and line breaks, so that paths and commands can be copied."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def outcomes(rows: Iterable[Row]) -> dict[str, int]:
    """Count the flights by outcome."""
    return dict(Counter(row["outcome"] for row in rows))


def counted(rows: Iterable[Row]) -> str:
    """Return the outcomes as text: `12 landed, 1 crashed`."""
    return ", ".join(f"{count} {name}" for name, count in outcomes(rows).items())


def catches(rows: Iterable[Row]) -> tuple[int, int]:
    """Return the number of flights whose companion reported a catch that was none, and of those that did not report a true one."""
    known = [(bool(row["caught"]), row["catch_t_s"] is not None) for row in rows]
    return known.count((False, True)), known.count((True, False))


def catches_text(rows: Iterable[Row]) -> str:
    """Return the numbers of `catches` as a cell of a table: `1, 0`."""
    return "{}, {}".format(*catches(rows))


def to_json(data: Any) -> str:
    """Return plain data as JSON text for files and scripts.

    Raises:
        ValueError: a value is NaN or infinite.
    """
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def write_csv(rows: Iterable[Mapping[str, Any]], path: Path) -> None:
    """Write one line per row below a header; the keys of the first row are the columns, and an unknown value is an empty cell."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer: csv.DictWriter[str] | None = None
        for row in rows:
            if writer is None:
                writer = csv.DictWriter(file, list(row))
                writer.writeheader()
            writer.writerow(row)


def versions() -> dict[str, str]:
    """Return the versions of the packages that a campaign's results depend on."""
    from companion.recorder.versions import versions as of_flight

    found = of_flight()
    for package in ("mujoco", "joblib", "distributed"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found
