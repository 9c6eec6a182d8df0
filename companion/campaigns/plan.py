"""Plan of a campaign: flies a sample, measures the processor time of each flight, and prints how long the whole campaign takes."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import mean, stdev

from rich.console import Console

from companion.campaigns.process import Message
from companion.campaigns.runner import Campaign, fly, print_lines, to_json
from companion.model.exit_codes import EXIT_LOST, EXIT_OK
from companion.runtime.console import print_error

SAMPLE = 20
"""Largest number of flights that a plan flies."""
WORKERS = (10, 100)
"""Numbers of Dask workers for which a plan gives the duration as well."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Measured cost of a sample of flights, and the duration of the whole campaign computed from it."""

    flights: int
    sample: int
    """Number of flights flown."""
    at_once: int
    """Number of simultaneous flights: processes of this computer, or threads of all workers of the scheduler."""
    cpu_s: float
    """Mean processor time of a flight, on the computers that flew the sample."""
    cpu_error_s: float
    """Standard error of the mean."""

    @classmethod
    def of(cls, flights: int, messages: Sequence[Message]) -> Plan:
        """Return the plan for a number of flights, from the results of some of them."""
        used_s = [message["cpu_s"] for message in messages]
        error_s = stdev(used_s) / len(used_s) ** 0.5 if len(used_s) > 1 else used_s[0]
        return cls(flights, len(used_s), messages[0]["at_once"], mean(used_s), error_s)

    def duration_s(self, at_once: int) -> float:
        """Return the duration of the campaign with this number of simultaneous flights, each on a free core."""
        return -(-self.flights // at_once) * self.cpu_s


def plan(campaign: Campaign, console: Console | None) -> int:
    """Fly a sample spread evenly over the campaign and print the plan; no files are written.

    Args:
        console: where to print; None to print JSON instead.

    Returns:
        The exit code.
    """
    count = len(campaign.flights)
    sample = min(SAMPLE, count)
    some = replace(campaign, flights=[campaign.flights[number * count // sample] for number in range(sample)])
    with tempfile.TemporaryDirectory() as folder:
        flown = fly(some, Path(folder))
    for note in flown.notes:
        print_error(f"companion {campaign.name}: {note}")
    if flown.code != EXIT_OK or not flown.messages:
        return flown.code or EXIT_LOST
    found = Plan.of(count, flown.messages)
    if console is None:
        sys.stdout.write(to_json({**asdict(found), "duration_s": found.duration_s(found.at_once)}))
        return EXIT_OK
    _show(found, campaign.scheduler, console)
    return EXIT_OK


def _show(found: Plan, scheduler: str | None, console: Console) -> None:
    where = where_flown(scheduler)
    print_lines(
        console,
        f"processor time of a flight: {found.cpu_s:.2f} s, standard error {found.cpu_error_s:.2f} s "
        f"({found.sample} of {found.flights} flights flown {where})",
        f"{found.flights} flights, {found.at_once} at a time {where}: {duration_text(found.duration_s(found.at_once))}",
        *(
            f"{found.flights} flights on {workers} Dask workers, one core as fast as these for each: "
            f"{duration_text(found.duration_s(workers))}"
            for workers in WORKERS
        ),
    )


def where_flown(scheduler: str | None) -> str:
    """Return where a campaign flies, as text."""
    return "on this computer" if scheduler is None else f"on the workers of {scheduler}"


def duration_text(seconds: float) -> str:
    """Return a duration as text: `45 s`, `12 min`, `3 h 20 min`."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
