"""`companion compare`: controllers, presets, payloads and seeds in the fast closed loop, and the table of what came of it."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.campaigns.compare import Cell, Flight, Row, Variant, aggregate, flights_of, variants_of
from companion.campaigns.compare_html import write_html
from companion.campaigns.compare_table import EXPLAINED, print_tables, write_csv
from companion.campaigns.printed import SOURCE
from companion.campaigns.process import CampaignProcess, Message
from companion.cli.campaign import Flown, Place, count, fly, versions, wide_console
from companion.config.controller import PRESETS
from companion.config.document import ConfigError
from companion.mission.check import check_mission
from companion.model.exit_codes import EXIT_LOST
from companion.runtime.console import tell
from companion.sitl_config.loader import SitlConfig, load_sitl


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
        "--seeds", type=count, default=5, metavar="N", help="flights per cell, seeds 1 to N (default: 5)"
    )
    parser.add_argument(
        "--ablation", action="store_true", help="also what is left when one thing at a time is taken away"
    )
    parser.add_argument("--jobs", type=count, metavar="N", help="processes (default: one per core)")
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


@dataclass
class _Grid:
    """What is to be flown."""

    variants: list[Variant]
    configs: list[SitlConfig]
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


def run(arguments: argparse.Namespace) -> int:
    """Fly, show, write; returns the exit code."""
    grid = _grid(arguments)
    place = Place.of("compare", arguments.out, "comparisons", "compare.json")
    flown = _fly(grid, arguments.jobs, arguments.scheduler, place.folder)
    if not flown.results:
        place.leave_empty()
        flown.tell_notes("compare")
        return flown.code
    return _show(grid, flown, arguments, place.folder)


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
    configs: list[SitlConfig] = []
    for variant in variants:
        overrides = (*arguments.overrides, *variant.overrides)
        try:
            configs.append(
                load_sitl(arguments.mission, arguments.vehicle, variant.controller, variant.base_preset, overrides)
            )
        except ConfigError as error:
            # What is wrong for the first one is likely to be wrong for all; what only a later one refuses is its own.
            raise ConfigError([f"{variant.label}: {line}" if configs else line for line in error.lines]) from None
    problems = check_mission(configs[0].mission, configs[0].vehicle, phase_origins=configs[0].sources.phases)
    if problems:
        raise ConfigError(problems)
    return _Grid(variants, configs, flights_of(variants, arguments.payloads, range(1, arguments.seeds + 1)))


def _fly(grid: _Grid, jobs: int | None, scheduler: str | None, out: Path) -> Flown[Message]:
    with CampaignProcess(grid.job(jobs, scheduler), out / "campaign.log") as campaign:
        results = ((message["index"], message) for message in campaign.results())
        return fly(results, len(grid.flights), campaign.ask_to_stop, _describe)


def _describe(_: Flown[Message], message: Message) -> str:
    row = message["row"]
    return f"{row['controller']}/{row['preset']} {row['payload_kg']:g} kg: {row['outcome']}"


def _show(grid: _Grid, flown: Flown[Message], arguments: argparse.Namespace, out: Path) -> int:
    rows = [message["row"] for message in flown.rows]
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
    flown.tell_notes("compare")
    return flown.code


def _print(rows: Sequence[Row], cells: Sequence[Cell], out: Path) -> None:
    console = wide_console()
    print_tables(cells, console)
    console.print(f"{EXPLAINED} Paper: {SOURCE}.", style="dim", highlight=False, markup=False)
    for row in rows:
        if row["error"]:
            text = f"{row['controller']}/{row['preset']} {row['payload_kg']:g} kg seed {row['seed']}: {row['error']}"
            console.print(text, style="red", highlight=False, markup=False)
    console.print(f"\nreport  {out / 'compare.html'}", highlight=False, markup=False, soft_wrap=True)


def _write(
    table: dict[str, Any],
    cells: Sequence[Cell],
    grid: _Grid,
    flown: Flown[Message],
    settings: dict[str, Any],
    out: Path,
) -> None:
    """compare.csv, compare.json, pictures, compare.html."""
    rows, used = [message["row"] for message in flown.rows], versions()
    write_csv(rows, out / "compare.csv")
    wall_s = [message["wall_s"] for message in flown.rows]
    whole = {**table, "settings": settings, "versions": used, "notes": flown.notes, "wall_s": wall_s}
    (out / "compare.json").write_text(json.dumps(whole, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    try:
        from companion.campaigns.compare_plots import Track, write_pictures
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
    write_html(rows, cells, pictures, settings, used, flown.notes, out / "compare.html")


def _settings(grid: _Grid, arguments: argparse.Namespace) -> dict[str, Any]:
    config = grid.configs[0]
    return {
        "command": arguments.command_line,
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
