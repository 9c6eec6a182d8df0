"""`companion robustness`: one mission in many worlds drawn at random, in the fast closed loop, and what came of it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.campaigns import robustness
from companion.campaigns.process import CampaignProcess, Message
from companion.campaigns.robustness import DRIVERS, SAFE, Cases, Row
from companion.campaigns.robustness_table import flights_table, thirds_table
from companion.cli.campaign import Flown, Place, count, fly, versions, wide_console
from companion.config.document import ConfigError
from companion.mission.check import check_mission
from companion.model.exit_codes import EXIT_LOST
from companion.runtime.console import tell
from companion.sitl_config.loader import SitlConfig, load_sitl

DEFAULT_MISSION = "configs/missions/catch.yaml"
_RESULTS = "robustness.json"


def add_parser(commands: Any) -> None:
    """Add `robustness` to the sub-parsers of `companion`."""
    parser = commands.add_parser(
        "robustness",
        help="fly a mission in many worlds drawn at random",
        description="Fly a mission in the fast closed loop in worlds drawn at random: payload, throw, catch point, delays, wind, "
        "wrong masses, a biased or missing force sensor. Exit code 5 if any of them crashed.",
    )
    parser.add_argument("mission", nargs="?", help=f"mission file, YAML (default: {DEFAULT_MISSION})")
    parser.add_argument("--draws", type=count, default=500, metavar="N", help="flights (default: 500)")
    parser.add_argument("--seed", type=count, default=1, metavar="N", help="of the draws (default: 1)")
    parser.add_argument("--first", type=_number, default=0, metavar="N", help="number of the first draw (default: 0)")
    parser.add_argument("--cases", metavar="FILE", help="fly the cases of this file instead of draws")
    parser.add_argument("--case", action="append", default=[], metavar="NAME", help="only this case of --cases")
    parser.add_argument(
        "--keep", metavar="FILE", help="write the worst ten, or the cases flown, to FILE with what came of them"
    )
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    parser.add_argument("--controller", metavar="LAW", help="control law: adaptive, csc or psc")
    parser.add_argument("--preset", metavar="NAME", help="gains: paper or recommended (adaptive), tuned (csc, psc)")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="in every flight; a key of world. is then not drawn",
    )  # fmt: skip
    parser.add_argument("--jobs", type=count, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="a Dask scheduler, to fly on its workers")
    parser.add_argument("--out", metavar="DIR", help="where results go (default: robustness/TIME)")
    parser.add_argument("--json", action="store_true", help="print rows and summary as JSON, nothing else")
    parser.set_defaults(run=run)


def _number(text: str) -> int:
    if not text.isdecimal() or len(text) > 9:
        raise argparse.ArgumentTypeError(f"expected a number from 0 on, got '{text}'")
    return int(text)


@dataclass
class _Job:
    """What is to be flown."""

    mission: str
    config: SitlConfig
    cases: tuple[robustness.Case, ...]
    """Empty: draws."""

    @property
    def law(self) -> tuple[str, str]:
        """Law and preset."""
        return self.config.controller.law, self.config.controller.preset

    def message(self, arguments: argparse.Namespace) -> Message:
        """For sitl.robustness."""
        cases = [{"name": case.name, "world": case.knobs()} for case in self.cases]
        return {
            "config": self.config.model_dump(mode="json"),
            "seed": arguments.seed,
            "first": arguments.first,
            "count": arguments.draws,
            "fixed": [_world_key(override) for override in arguments.overrides if _world_key(override)],
            "cases": cases or None,
            "jobs": arguments.jobs,
            "scheduler": arguments.scheduler,
        }


def _world_key(override: str) -> str:
    """`wind_m_s` of `world.wind_m_s[0]=1`; empty for another section."""
    section, _, key = override.partition("=")[0].strip().partition(".")
    return key.partition("[")[0].partition(".")[0] if section == "world" else ""


def run(arguments: argparse.Namespace) -> int:
    """Fly, show, write; returns the exit code."""
    job = _job(arguments)
    place = Place.of("robustness", arguments.out, "robustness", _RESULTS)
    flown = _fly(job, arguments, place.folder)
    if not flown.results:
        place.leave_empty()
        flown.tell_notes("robustness")
        return flown.code
    return _show(job, flown, arguments, place.folder)


def _job(arguments: argparse.Namespace) -> _Job:
    """What to fly, checked before anything flies.

    Raises:
        ConfigError: one line per problem.
    """
    if arguments.case and arguments.cases is None:
        raise ConfigError(["companion robustness: --case needs --cases FILE, the file in which the case is"])
    kept: Cases | None = None
    chosen: tuple[robustness.Case, ...] = ()
    if arguments.cases is not None:
        kept = robustness.read_cases(Path(arguments.cases))
        chosen = kept.named(arguments.case)
        if not chosen:
            raise ConfigError([f"{arguments.cases}: cases: there is none in it"])
    mission = arguments.mission or (kept.mission if kept is not None else DEFAULT_MISSION)
    # Another law has presets of its own.
    preset = arguments.preset or (kept.preset if kept is not None and arguments.controller is None else None)
    law = arguments.controller or (kept.controller if kept is not None else None)
    config = load_sitl(mission, arguments.vehicle, law, preset, arguments.overrides)
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    if problems:
        raise ConfigError(problems)
    return _Job(mission, config, chosen)


def _fly(job: _Job, arguments: argparse.Namespace, out: Path) -> Flown[Row]:
    with CampaignProcess(job.message(arguments), out / "campaign.log", "sitl.campaigns.robustness") as campaign:
        results = ((message["index"], message["row"]) for message in campaign.results())
        return fly(results, len(job.cases) or arguments.draws, campaign.ask_to_stop, _describe)


def _describe(flown: Flown[Row], row: Row) -> str:
    safe = sum(one["outcome"] in SAFE for one in flown.results.values())
    return f"{row['name']}: {row['outcome']}; {safe} safe"


def _show(job: _Job, flown: Flown[Row], arguments: argparse.Namespace, out: Path) -> int:
    rows = flown.rows
    table = {"rows": rows, "summary": _summary(rows)}
    law, preset = job.law
    settings = {
        "command": arguments.command_line,
        "mission": job.mission,
        "vehicle": job.config.sources.vehicle,
        "controller": law,
        "preset": preset,
        "overrides": list(arguments.overrides),
        "seed": None if job.cases else arguments.seed,
        "cases": arguments.cases,
    }
    hardest = robustness.worst(rows)
    keep = rows if job.cases else hardest
    # Their names for the terminal too: the same ones as in the file.
    names = [case.name for case in robustness.as_cases(hardest)]
    try:
        _write(job, table, settings, arguments, out, flown.notes)
        if arguments.keep is not None:
            _keep(job, keep, arguments, Path(arguments.keep))
    except OSError as error:
        tell(f"companion robustness: {error.filename or out}: cannot be written: {error.strerror}")
        flown.code = flown.code or EXIT_LOST
    if arguments.json:
        sys.stdout.write(json.dumps(table, indent=1, allow_nan=False) + "\n")
        sys.stdout.flush()
    else:
        _print(job, rows, list(zip(names, hardest, strict=True)), arguments, out)
    flown.tell_notes("robustness")
    if any(row["outcome"] not in SAFE for row in rows):
        flown.code = EXIT_LOST
    return flown.code


def _summary(rows: Sequence[Row]) -> dict[str, Any]:
    return {
        "flights": len(rows),
        "outcomes": robustness.outcomes(rows),
        "caught": sum(bool(row["caught"]) for row in rows),
        "missed": sum(bool(row["thrown"]) and not row["caught"] for row in rows),
        "not_thrown": sum(not row["thrown"] for row in rows),
        "thirds": [
            {
                "payload_kg": [third.low_kg, third.high_kg],
                "flights": third.flights,
                "caught": third.caught,
                "e_p_m": {"p50": third.p50_m, "p90": third.p90_m, "max": third.max_m},
            }
            for third in robustness.thirds(rows)
        ],
        "influence": dict(robustness.influence(rows)),
    }


def _write(
    job: _Job,
    table: dict[str, Any],
    settings: dict[str, Any],
    arguments: argparse.Namespace,
    out: Path,
    notes: list[str],
) -> None:
    """draws.csv, robustness.json, worst.yaml, distribution.png."""
    rows = table["rows"]
    robustness.write_csv(rows, out / "draws.csv")
    _keep(job, robustness.worst(rows), arguments, out / "worst.yaml")
    try:
        from companion.campaigns.robustness_plots import write_distribution
    except ImportError:
        tell("companion robustness: the picture needs matplotlib: pip install 'companion[analysis]'")
    else:
        law, preset = job.law
        title = f"{job.config.mission.name}, {law}/{preset}: {len(rows)} worlds"
        write_distribution(rows, title, out / "distribution.png")
    # The last one: where it is, the rest is.
    whole = {**table, "settings": settings, "versions": versions(), "notes": notes}
    (out / _RESULTS).write_text(json.dumps(whole, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _keep(job: _Job, rows: Sequence[Row], arguments: argparse.Namespace, path: Path) -> None:
    law, preset = job.law
    cases = Cases(mission=job.mission, controller=law, preset=preset, cases=robustness.as_cases(rows))
    remark = (
        "Worlds in which this law had the hardest time, and what came of it there, in the fast closed loop.\n"
        f"Fly them again: companion robustness --cases {path.name} (--case NAME for one; --keep FILE to keep what comes of it).\n"
    )
    if not job.cases:
        remark += (
            f"The worst of draws {arguments.first} to {arguments.first + arguments.draws - 1}, seed {arguments.seed}."
        )
    robustness.write_cases(cases, path, remark.strip())


def _print(
    job: _Job, rows: Sequence[Row], hardest: Sequence[tuple[str, Row]], arguments: argparse.Namespace, out: Path
) -> None:
    console = wide_console()
    law, preset = job.law
    counted = ", ".join(f"{count} {name}" for name, count in robustness.outcomes(rows).items())
    caught = sum(bool(row["caught"]) for row in rows)
    missed = sum(bool(row["thrown"]) and not row["caught"] for row in rows)
    console.print(
        f"{law}/{preset}, {len(rows)} worlds: {counted}; {caught} caught, {missed} missed the net", highlight=False
    )
    console.print(thirds_table(rows), highlight=False)
    if driving := robustness.influence(rows)[:5]:
        text = ", ".join(f"{DRIVERS[key]} {value:+.2f}" for key, value in driving)
        console.print(f"e_p goes with (rank correlation): {text}\n", highlight=False)
    kept = {case.name: case.kept for case in job.cases}
    shown = [(row["name"], row) for row in rows] if kept else hardest
    console.print(flights_table(shown, kept), highlight=False)
    for row in rows:
        if row["outcome"] != "completed":
            text = f"{row['name']}: {row['outcome']}: {row['error'] or row['why'] or 'no event tells why'}"
            console.print(text, style="yellow" if row["outcome"] in SAFE else "red", highlight=False, markup=False)
    sets = [override for override in arguments.overrides if not _world_key(override)]
    line = robustness.fly_command(job.mission, law, preset, hardest[0][1]["world"], sets)
    console.print(f"the worst one over real wires:\n{line}", highlight=False, markup=False, soft_wrap=True)
    console.print(f"\nresults  {out}", highlight=False, markup=False, soft_wrap=True)
