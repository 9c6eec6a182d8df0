"""`companion faults`: one fault after the other in every phase of a mission, and what came of it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.campaigns.faults import WIRES, Row, Variant, good, outcomes, summary, variants_of, write_csv
from companion.campaigns.faults_over_wires import WireFlights, default_jobs
from companion.campaigns.faults_table import flights_table, kinds_list, kinds_table, write_html
from companion.campaigns.process import CampaignProcess
from companion.cli.campaign import Flown, Place, count, fly, versions, wide_console
from companion.config.document import ConfigError
from companion.config.explain import nearest
from companion.mission.check import check_mission
from companion.model.exit_codes import EXIT_LOST, EXIT_OK
from companion.runtime.console import tell
from companion.sitl_config.faults import KINDS, PHASES, FlightPhase
from companion.sitl_config.loader import SitlConfig, load_sitl

DEFAULT_MISSION = "configs/missions/catch.yaml"
_RESULTS = "faults.json"
WIDTH = 168
"""Columns of a table that no terminal limits."""


def add_parser(commands: Any) -> None:
    """Add `faults` to the sub-parsers of `companion`."""
    parser = commands.add_parser(
        "faults",
        help="fly a mission with every fault that the simulated world knows",
        description="Fly a mission in the fast closed loop with one fault at a time, in every phase of the flight, or with --wires "
        "over real wires. Exit code 0 only if every flight was completed or landed, no tether was taut by the machine's own motion "
        "and nothing left the room; else 5.",
    )
    parser.add_argument(
        "mission", nargs="?", default=DEFAULT_MISSION, help=f"mission file, YAML (default: {DEFAULT_MISSION})"
    )
    parser.add_argument(
        "--list", action="store_true", help="print the kinds of faults and what their sizes mean, fly nothing"
    )
    parser.add_argument("--kinds", type=_kinds, default=(), metavar="KIND,...", help="default: all; see --list")
    parser.add_argument(
        "--phases", type=_phases, default=(), metavar="PHASE,...", help=f"of {', '.join(PHASES)}; default: all"
    )
    parser.add_argument(
        "--wires", action="store_true", help=f"fly {len(WIRES)} chosen ones with `companion fly --sitl`, a minute each"
    )
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    parser.add_argument("--controller", metavar="LAW", help="control law: adaptive, csc or psc")
    parser.add_argument("--preset", metavar="NAME", help="gains: paper or recommended (adaptive), tuned (csc, psc)")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="in every flight"
    )
    parser.add_argument("--jobs", type=count, metavar="N", help="flights at the same time (default: by the cores)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, to fly on its workers")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: faults/TIME)")
    parser.add_argument("--json", action="store_true", help="print rows and summary as JSON, nothing else")
    parser.set_defaults(run=run)


def _kinds(text: str) -> tuple[str, ...]:
    return _named(text, tuple(KINDS), "kind of fault")


def _phases(text: str) -> tuple[str, ...]:
    return _named(text, PHASES, "phase")


def _named(text: str, known: Sequence[str], what: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in known:
            like = nearest(name, list(known))
            hint = f"did you mean '{like}'?" if like else f"there are: {', '.join(known)}"
            raise argparse.ArgumentTypeError(f"there is no {what} '{name}'; {hint}")
    return names


def run(arguments: argparse.Namespace) -> int:
    """Fly, show, write; returns the exit code."""
    if arguments.list:
        return _list(arguments)
    flights = _flights(arguments)
    config = _config(arguments)
    place = Place.of("faults", arguments.out, "faults", _RESULTS)
    flown = _fly(config, flights, arguments, place.folder)
    if not flown.results:
        place.leave_empty()
        flown.tell_notes("faults")
        return flown.code
    return _show(config, flown, arguments, place.folder)


def _list(arguments: argparse.Namespace) -> int:
    if arguments.json:
        print(json.dumps(kinds_list(), indent=1))
        return EXIT_OK
    wide_console().print(kinds_table(), highlight=False)
    return EXIT_OK


def _flights(arguments: argparse.Namespace) -> list[tuple[Variant, FlightPhase]]:
    """What is to be flown.

    Raises:
        ConfigError: nothing is left of it.
    """
    kinds, phases = arguments.kinds, arguments.phases
    if arguments.wires:
        chosen = [
            (variant, phase)
            for variant, phase in WIRES
            if (not kinds or variant.kind in kinds) and (not phases or phase in phases)
        ]
    else:
        chosen = variants_of(kinds, phases)
    if not chosen:
        what = "with --wires there is no" if arguments.wires else "there is no"
        raise ConfigError(
            [f"companion faults: {what} {' or '.join(kinds)} in phase {' or '.join(phases) or 'any'} to be flown"]
        )
    return chosen


def _config(arguments: argparse.Namespace) -> SitlConfig:
    """Checked before anything flies.

    Raises:
        ConfigError: one line per problem.
    """
    for override in arguments.overrides:
        if override.partition("=")[0].strip().partition("[")[0] == "world.faults":
            raise ConfigError(["companion faults: --set world.faults: the campaign sets it; use --kinds and --phases"])
    config = load_sitl(
        arguments.mission, arguments.vehicle, arguments.controller, arguments.preset, arguments.overrides
    )
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    if problems:
        raise ConfigError(problems)
    return config


def _fly(
    config: SitlConfig, flights: Sequence[tuple[Variant, FlightPhase]], arguments: argparse.Namespace, out: Path
) -> Flown[Row]:
    if arguments.wires:
        wires = WireFlights(_fly_options(arguments), config, out, arguments.jobs or default_jobs())
        return fly(wires.results(flights), len(flights), wires.ask_to_stop, _describe)
    job = {
        "config": config.model_dump(mode="json"),
        "flights": [
            {"kind": v.kind, "size": v.size, "duration_s": v.duration_s, "phase": phase} for v, phase in flights
        ],
        "jobs": arguments.jobs,
        "scheduler": arguments.scheduler,
    }
    with CampaignProcess(job, out / "campaign.log", "sitl.campaigns.faults") as campaign:
        results = ((message["index"], message["row"]) for message in campaign.results())
        return fly(results, len(flights), campaign.ask_to_stop, _describe)


def _describe(flown: Flown[Row], row: Row) -> str:
    bad = sum(not good(one) for one in flown.results.values())
    return f"{row['fault']}, {row['phase']}: {row['outcome']}; {bad} bad"


def _fly_options(arguments: argparse.Namespace) -> list[str]:
    options = [arguments.mission]
    for name in ("vehicle", "controller", "preset"):
        value = getattr(arguments, name)
        if value is not None:
            options += [f"--{name}", value]
    for override in arguments.overrides:
        options += ["--set", override]
    return options


def _show(config: SitlConfig, flown: Flown[Row], arguments: argparse.Namespace, out: Path) -> int:
    rows = flown.rows
    table: dict[str, Any] = {"rows": rows, "summary": summary(rows)}
    settings = {
        "command": arguments.command_line,
        "mission": config.sources.mission,
        "vehicle": config.sources.vehicle,
        "controller": config.sources.controller,
        "overrides": list(arguments.overrides),
        "where": "over real wires" if arguments.wires else "in the fast closed loop",
    }
    try:
        write_csv(rows, out / "faults.csv")
        write_html(rows, settings, versions(), flown.notes, out / "faults.html")
        whole = {**table, "settings": settings, "versions": versions(), "notes": flown.notes}
        # The last one: where it is, the rest is.
        (out / _RESULTS).write_text(json.dumps(whole, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        tell(f"companion faults: {error.filename or out}: cannot be written: {error.strerror}")
        flown.code = flown.code or EXIT_LOST
    if arguments.json:
        sys.stdout.write(json.dumps(table, indent=1, allow_nan=False) + "\n")
        sys.stdout.flush()
    else:
        _print(rows, out)
    flown.tell_notes("faults")
    if not all(map(good, rows)):
        flown.code = EXIT_LOST
    return flown.code


def _print(rows: Sequence[Row], out: Path) -> None:
    console = wide_console(WIDTH)
    console.print(flights_table(rows), highlight=False)
    counted = ", ".join(f"{count} {name}" for name, count in outcomes(rows).items())
    console.print(f"{len(rows)} flights: {counted}", highlight=False)
    for row in rows:
        if not good(row):
            why = "; ".join([*row["problems"], *([row["error"]] if row["error"] else [])])
            text = f"{row['fault']} {row['size'] if row['size'] is not None else ''} in {row['phase']}: {why}"
            console.print(text, style="red", highlight=False, markup=False)
    console.print(f"\nreport  {out / 'faults.html'}", highlight=False, markup=False, soft_wrap=True)
