"""`companion compare`: controllers, presets, payloads and seeds in the fast closed loop, and the table of what came of it."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib.metadata
import json
import math
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion.analysis.compare import Cell, Flight, Row, Variant, aggregate, flights_of, variants_of
from companion.analysis.compare_html import write_html
from companion.analysis.compare_table import EXPLAINED, print_tables, write_csv
from companion.analysis.printed import SOURCE
from companion.campaign_process import CampaignError, CampaignProcess, Message
from companion.config.controller import PRESETS
from companion.config.document import ConfigError
from companion.config.loader import FlightConfig, load_flight
from companion.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK
from companion.mission.check import check_mission
from companion.terminal import tell, terminal_console

PIPED_WIDTH = 132
"""Columns of a table that no terminal limits."""


def add_parser(commands: Any) -> None:
    """Add `compare` to the sub-parsers of `companion`."""
    parser = commands.add_parser(
        "compare",
        help="fly controllers against each other in the fast closed loop",
        description="Fly a grid of controllers, presets, payloads and seeds in the fast closed loop and print the paper's table "
        "with its printed values beside ours. A crash is a result.",
    )
    parser.add_argument(
        "--payloads", type=_payloads, default=(0.1, 0.2, 0.3), metavar="KG,...", help="default: 0.1,0.2,0.3"
    )
    parser.add_argument(
        "--controllers", type=_names, default=(), metavar="LAW,...", help=f"default: {','.join(PRESETS)}"
    )
    parser.add_argument("--presets", type=_names, default=(), metavar="NAME,...", help="default: all of each law")
    parser.add_argument(
        "--seeds", type=_count, default=5, metavar="N", help="flights per cell, seeds 1 to N (default: 5)"
    )
    parser.add_argument(
        "--ablation", action="store_true", help="also what is left when one thing at a time is taken away"
    )
    parser.add_argument("--jobs", type=_count, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, to fly on its workers")
    parser.add_argument("--mission", default="configs/missions/catch.yaml", metavar="FILE")
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="in every flight"
    )
    parser.add_argument("--out", metavar="DIR", help="where table and plots go (default: comparisons/TIME)")
    parser.add_argument("--json", action="store_true", help="print rows and aggregate as JSON, nothing else")
    parser.set_defaults(run=run)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"expected names with commas between them, got '{text}'")
    return names


def _payloads(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(0 <= value <= 2 for value in values):
        raise argparse.ArgumentTypeError(f"expected masses in kg from 0 to 2 with commas between them, got '{text}'")
    return tuple(dict.fromkeys(values))


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 10_000:
        raise argparse.ArgumentTypeError(f"expected a number from 1 to 10000, got '{text}'")
    return int(text)


@dataclass
class _Grid:
    """What is to be flown."""

    variants: list[Variant]
    configs: list[FlightConfig]
    flights: list[Flight]

    def job(self, jobs: int | None, scheduler: str | None) -> Message:
        """For sitl.campaign; courses are wanted of the first seed only."""
        first = min(flight.seed for flight in self.flights)
        return {
            "configs": [config.model_dump(mode="json") for config in self.configs],
            "flights": [
                {
                    "variant": flight.variant,
                    "controller": self.variants[flight.variant].controller,
                    "preset": self.variants[flight.variant].preset,
                    "payload_kg": flight.payload_kg,
                    "seed": flight.seed,
                    "series": flight.seed == first,
                }
                for flight in self.flights
            ],
            "jobs": jobs,
            "scheduler": scheduler,
        }


@dataclass
class _Flown:
    """What came of it: by position in the grid."""

    results: dict[int, Message] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    """Why the grid is not complete."""
    code: int = EXIT_OK

    @property
    def rows(self) -> list[Row]:
        """In the order of the grid."""
        return [self.results[index]["row"] for index in sorted(self.results)]


def run(arguments: argparse.Namespace) -> int:
    """Fly, show, write; returns the exit code."""
    grid = _grid(arguments)
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = Path(arguments.out) if arguments.out is not None else Path("comparisons") / stamp
    problem = "expected the name of a folder, got an empty one" if arguments.out == "" else _why_unusable(out)
    if problem is not None:
        tell(f"companion compare: --out {out}: {problem}")
        return EXIT_BAD_INPUT
    flown = _fly(grid, arguments.jobs, arguments.scheduler, out)
    if not flown.results:
        with contextlib.suppress(OSError):
            out.rmdir()  # if nothing is in it
            if arguments.out is None:
                out.parent.rmdir()
        for note in flown.notes:
            tell(f"companion compare: {note}")
        return flown.code
    return _show(grid, flown, arguments, out)


def _grid(arguments: argparse.Namespace) -> _Grid:
    """Every configuration, checked before anything flies.

    Raises:
        ConfigError: one line per problem.
    """
    for override in arguments.overrides:
        for key, option in (("world.payload_kg", "--payloads"), ("world.seed", "--seeds")):
            if override.partition("=")[0].strip() == key:
                raise ConfigError([f"companion compare: --set {key}: the grid sets it; use {option}"])
    try:
        variants = variants_of(PRESETS, arguments.controllers, arguments.presets, arguments.ablation)
    except ValueError as error:
        raise ConfigError([f"companion compare: {error}"]) from None
    configs: list[FlightConfig] = []
    for variant in variants:
        overrides = (*arguments.overrides, *variant.overrides)
        try:
            configs.append(
                load_flight(arguments.mission, arguments.vehicle, variant.controller, variant.base_preset, overrides)
            )
        except ConfigError as error:
            # What is wrong for the first one is likely to be wrong for all; what only a later one refuses is its own.
            raise ConfigError([f"{variant.label}: {line}" if configs else line for line in error.lines]) from None
    problems = check_mission(configs[0].mission, configs[0].vehicle, phase_origins=configs[0].sources.phases)
    if problems:
        raise ConfigError(problems)
    return _Grid(variants, configs, flights_of(variants, arguments.payloads, range(1, arguments.seeds + 1)))


def _fly(grid: _Grid, jobs: int | None, scheduler: str | None, out: Path) -> _Flown:
    flown = _Flown()
    whole = len(grid.flights)
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
    with CampaignProcess(grid.job(jobs, scheduler), out / "campaign.log") as campaign, _interrupts(campaign), progress:
        task = progress.add_task("", total=whole)
        try:
            for message in campaign.results():
                flown.results[message["index"]] = message
                row = message["row"]
                text = f"{row['controller']}/{row['preset']} {row['payload_kg']:g} kg: {row['outcome']}"
                progress.update(task, advance=1, description=text)
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
def _interrupts(campaign: CampaignProcess) -> Iterator[None]:
    """While inside: Ctrl-C and SIGTERM end the campaign, and what was flown until then is shown."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.signal(number, lambda *_: campaign.ask_to_stop()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _show(grid: _Grid, flown: _Flown, arguments: argparse.Namespace, out: Path) -> int:
    rows = flown.rows
    cells = aggregate(rows)
    settings = _settings(grid, arguments)
    table: dict[str, Any] = {"rows": rows, "aggregate": [cell.jsonable() for cell in cells]}
    try:
        _write(table, cells, grid, flown, settings, out)
    except OSError as error:
        tell(f"companion compare: {out}: cannot be written: {error.strerror}")
        flown.code = flown.code or EXIT_LOST
    if arguments.json:
        sys.stdout.write(json.dumps(table, indent=1, allow_nan=False) + "\n")
        sys.stdout.flush()
    else:
        _print(rows, cells, out)
    for note in flown.notes:
        tell(f"companion compare: {note}")
    return flown.code


def _print(rows: Sequence[Row], cells: Sequence[Cell], out: Path) -> None:
    console = terminal_console()
    if not console.is_terminal:
        console.width = max(console.width, PIPED_WIDTH)
    print_tables(cells, console)
    console.print(f"{EXPLAINED} Paper: {SOURCE}.", style="dim", highlight=False, markup=False)
    for row in rows:
        if row["error"]:
            text = f"{row['controller']}/{row['preset']} {row['payload_kg']:g} kg seed {row['seed']}: {row['error']}"
            console.print(text, style="red", highlight=False, markup=False)
    console.print(f"\nreport  {out / 'compare.html'}", highlight=False, markup=False, soft_wrap=True)


def _write(
    table: dict[str, Any], cells: Sequence[Cell], grid: _Grid, flown: _Flown, settings: dict[str, Any], out: Path
) -> None:
    """compare.csv, compare.json, pictures, compare.html."""
    rows, versions = flown.rows, _versions()
    write_csv(rows, out / "compare.csv")
    wall_s = [flown.results[index]["wall_s"] for index in sorted(flown.results)]
    whole = {**table, "settings": settings, "versions": versions, "notes": flown.notes, "wall_s": wall_s}
    (out / "compare.json").write_text(json.dumps(whole, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    try:
        from companion.analysis.compare_plots import Track, write_pictures
    except ImportError:
        tell("companion compare: pictures need matplotlib: pip install 'companion[analysis]'")
        pictures = []
    else:
        tracks = []
        for index, message in sorted(flown.results.items()):
            variant, row = grid.variants[grid.flights[index].variant], message["row"]
            if message["series"] is not None:
                tracks.append(
                    Track(
                        variant.label,
                        variant.short_label,
                        variant.ablation,
                        row["payload_kg"],
                        row["seed"],
                        row["outcome"],
                        message["series"],
                    )
                )
        pictures = write_pictures(tracks, cells, out)
    write_html(rows, cells, pictures, settings, versions, flown.notes, out / "compare.html")


def _settings(grid: _Grid, arguments: argparse.Namespace) -> dict[str, Any]:
    config = grid.configs[0]
    return {
        "mission": config.sources.mission,
        "vehicle": config.sources.vehicle,
        "overrides": list(arguments.overrides),
        "payloads_kg": list(arguments.payloads),
        "seeds": list(range(1, arguments.seeds + 1)),
        "variants": [
            {
                "controller": variant.controller,
                "preset": variant.preset,
                "file": chosen.sources.controller,
                "overrides": list(variant.overrides),
            }
            for variant, chosen in zip(grid.variants, grid.configs, strict=True)
        ],
        "jobs": arguments.jobs,
        "scheduler": arguments.scheduler,
    }


def _versions() -> dict[str, str]:
    from companion.recorder_process import versions

    found = versions()
    for package in ("mujoco", "joblib", "distributed"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def _why_unusable(out: Path) -> str | None:
    """Make the folder; None if a comparison can leave its files there."""
    try:
        if out.exists() and not out.is_dir():
            return "is a file; choose a folder"
        if (out / "compare.json").exists():
            return "there is a compare.json already; choose another folder"
        out.mkdir(parents=True, exist_ok=True)
        # Only trying tells: root may write where the permissions say no, and nobody may in some file systems.
        with tempfile.TemporaryFile(dir=out):
            return None
    except OSError as error:
        return f"{error.strerror}; choose a folder that can be written to"
