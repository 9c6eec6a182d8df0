"""`companion faults`: one fault after the other in every phase of a mission, and what came of it."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from companion.analysis.faults import WIRES, Row, Variant, good, outcomes, summary, variants_of, write_csv
from companion.analysis.faults_table import flights_table, kinds_list, kinds_table, write_html
from companion.campaign_process import CampaignError, CampaignProcess
from companion.compare_command import PIPED_WIDTH, _count, _versions
from companion.config.document import ConfigError
from companion.config.explain import nearest
from companion.config.faults import KINDS, PHASES, FlightPhase
from companion.config.loader import FlightConfig, load_flight
from companion.exit_codes import EXIT_ABORTED, EXIT_BAD_INPUT, EXIT_LOST, EXIT_OK
from companion.faults_wires import WireFlights, default_jobs
from companion.mission.check import check_mission
from companion.terminal import tell, terminal_console

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
    parser.add_argument("--jobs", type=_count, metavar="N", help="flights at the same time (default: by the cores)")
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


@dataclass
class _Flown:
    """What came of it."""

    results: dict[int, Row] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    code: int = EXIT_OK

    @property
    def rows(self) -> list[Row]:
        """In the order of the table."""
        return [self.results[index] for index in sorted(self.results)]


def run(arguments: argparse.Namespace) -> int:
    """Fly, show, write; returns the exit code."""
    if arguments.list:
        return _list(arguments)
    flights = _flights(arguments)
    config = _config(arguments)
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = Path(arguments.out) if arguments.out is not None else Path("faults") / stamp
    problem = "expected the name of a folder, got an empty one" if arguments.out == "" else _why_unusable(out)
    if problem is not None:
        tell(f"companion faults: --out {out}: {problem}")
        return EXIT_BAD_INPUT
    flown = _fly(config, flights, arguments, out)
    if not flown.results:
        with contextlib.suppress(OSError):
            out.rmdir()  # if nothing is in it
            if arguments.out is None:
                out.parent.rmdir()
        for note in flown.notes:
            tell(f"companion faults: {note}")
        return flown.code
    return _show(config, flown, arguments, out)


def _list(arguments: argparse.Namespace) -> int:
    if arguments.json:
        print(json.dumps(kinds_list(), indent=1))
        return EXIT_OK
    console = terminal_console()
    if not console.is_terminal:
        console.width = max(console.width, PIPED_WIDTH)
    console.print(kinds_table(), highlight=False)
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


def _config(arguments: argparse.Namespace) -> FlightConfig:
    """Checked before anything flies.

    Raises:
        ConfigError: one line per problem.
    """
    for override in arguments.overrides:
        if override.partition("=")[0].strip().partition("[")[0] == "world.faults":
            raise ConfigError(["companion faults: --set world.faults: the campaign sets it; use --kinds and --phases"])
    config = load_flight(
        arguments.mission, arguments.vehicle, arguments.controller, arguments.preset, arguments.overrides
    )
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    if problems:
        raise ConfigError(problems)
    return config


def _why_unusable(out: Path) -> str | None:
    """Make the folder; None if a campaign can leave its files there."""
    try:
        if out.exists() and not out.is_dir():
            return "is a file; choose a folder"
        if (out / _RESULTS).exists():
            return f"there is a {_RESULTS} already; choose another folder"
        out.mkdir(parents=True, exist_ok=True)
        # Only trying tells: root may write where the permissions say no, and nobody may in some file systems.
        with tempfile.TemporaryFile(dir=out):
            return None
    except OSError as error:
        return f"{error.strerror}; choose a folder that can be written to"


def _fly(
    config: FlightConfig, flights: Sequence[tuple[Variant, FlightPhase]], arguments: argparse.Namespace, out: Path
) -> _Flown:
    flown = _Flown()
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
    with contextlib.ExitStack() as stack:
        if arguments.wires:
            wires = WireFlights(_fly_options(arguments), config, out, arguments.jobs or default_jobs())
            results, stop = wires.results(flights), wires.ask_to_stop
        else:
            job = {
                "config": config.model_dump(mode="json"),
                "flights": [
                    {"kind": v.kind, "size": v.size, "duration_s": v.duration_s, "phase": phase} for v, phase in flights
                ],
                "jobs": arguments.jobs,
                "scheduler": arguments.scheduler,
            }
            process = stack.enter_context(CampaignProcess(job, out / "campaign.log", "sitl.fault_campaign"))
            results, stop = _fast(process), process.ask_to_stop
        stack.enter_context(_interrupts(stop))
        stack.enter_context(progress)
        task = progress.add_task("", total=len(flights))
        try:
            for index, row in results:
                flown.results[index] = row
                bad = sum(not good(one) for one in flown.results.values())
                text = f"{row['fault']}, {row['phase']}: {row['outcome']}; {bad} bad"
                progress.update(task, advance=1, description=text)
        except CampaignError as error:
            flown.notes.append(str(error))
            flown.code = EXIT_BAD_INPUT if error.bad_input else EXIT_LOST
    if len(flown.results) < len(flights) and flown.code != EXIT_BAD_INPUT:
        if not flown.notes:
            flown.notes.append("interrupted")
            flown.code = EXIT_ABORTED
        flown.notes.append(f"{len(flown.results)} of {len(flights)} flights were flown")
    return flown


def _fast(process: CampaignProcess) -> Iterator[tuple[int, Row]]:
    for message in process.results():
        yield message["index"], message["row"]


def _fly_options(arguments: argparse.Namespace) -> list[str]:
    options = [arguments.mission]
    for name in ("vehicle", "controller", "preset"):
        value = getattr(arguments, name)
        if value is not None:
            options += [f"--{name}", value]
    for override in arguments.overrides:
        options += ["--set", override]
    return options


@contextlib.contextmanager
def _interrupts(stop: Any) -> Iterator[None]:
    """While inside: Ctrl-C and SIGTERM end the campaign, and what was flown until then is shown."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.signal(number, lambda *_: stop()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _show(config: FlightConfig, flown: _Flown, arguments: argparse.Namespace, out: Path) -> int:
    rows = flown.rows
    table: dict[str, Any] = {"rows": rows, "summary": summary(rows)}
    settings = {
        "mission": config.sources.mission,
        "vehicle": config.sources.vehicle,
        "controller": config.sources.controller,
        "overrides": list(arguments.overrides),
        "where": "over real wires" if arguments.wires else "in the fast closed loop",
    }
    try:
        write_csv(rows, out / "faults.csv")
        write_html(rows, settings, _versions(), flown.notes, out / "faults.html")
        whole = {**table, "settings": settings, "versions": _versions(), "notes": flown.notes}
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
    for note in flown.notes:
        tell(f"companion faults: {note}")
    if not all(map(good, rows)):
        flown.code = EXIT_LOST
    return flown.code


def _print(rows: Sequence[Row], out: Path) -> None:
    console = terminal_console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    console.print(flights_table(rows), highlight=False)
    counted = ", ".join(f"{count} {name}" for name, count in outcomes(rows).items())
    console.print(f"{len(rows)} flights: {counted}", highlight=False)
    for row in rows:
        if not good(row):
            why = "; ".join([*row["problems"], *([row["error"]] if row["error"] else [])])
            text = f"{row['fault']} {row['size'] if row['size'] is not None else ''} in {row['phase']}: {why}"
            console.print(text, style="red", highlight=False, markup=False)
    console.print(f"\nreport  {out / 'faults.html'}", highlight=False, markup=False, soft_wrap=True)
