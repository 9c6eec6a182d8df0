"""`companion robustness`: fly a mission in many randomly drawn worlds, in the fast loop."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from companion.campaigns.pair import PairRobustness
from companion.campaigns.robustness.campaign import Robustness
from companion.campaigns.robustness.cases import Case, Cases, read_cases
from companion.cli.campaign import add_options, add_plan, checked, common, count, fly, refuse_beside, why_unusable
from companion.cli.options import MISSION_OR_DEFAULT_HELP, Shorthand, whole
from companion.config.document import ConfigError
from companion.config.shipped import DEFAULT_MISSION, names
from companion.mission.check import check_mission
from companion.sitl_config.team import TEAM_WORLD, load_team


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "robustness",
        help="fly a mission in many randomly drawn worlds",
        description="Fly a mission in the fast closed loop in randomly drawn worlds: payload, throw, catch point, "
        "and everything that the world's seed determines. A key of the world section that is set with --set is "
        "not drawn. Exit code 5 if any flight crashed or was lost.",
    )
    parser.add_argument("mission", nargs="?", help=MISSION_OR_DEFAULT_HELP)
    parser.add_argument("--draws", type=count, default=500, metavar="N", help="number of flights (default: 500)")
    parser.add_argument("--seed", type=count, default=1, metavar="N", help="seed of the draws (default: 1)")
    parser.add_argument(
        "--first", type=whole(0, 999_999_999), default=0, metavar="N", help="number of the first draw (default: 0)"
    )
    parser.add_argument(
        "--model-error",
        dest="overrides",
        action="append",
        default=[],
        type=_model_error_override,
        metavar="SHARE",
        help="fraction by which masses, inertia and torque constants differ from the vehicle file, 0 to 0.3 (short "
        "for --set world.model_error=SHARE)",
    )
    parser.add_argument("--cases", metavar="FILE", help="fly the cases of this file instead of draws")
    parser.add_argument("--case", action="append", default=[], metavar="NAME", help="only this case of --cases")
    parser.add_argument(
        "--keep", metavar="FILE", help="write the ten worst draws, or the flown cases, with their results to FILE"
    )
    add_options(parser, one_law=True, world=None)
    add_plan(parser)
    parser.set_defaults(run=run)


def _model_error_override(text: str) -> str:
    return Shorthand.of("--model-error", "world.model_error", text)


def run(arguments: argparse.Namespace) -> int:
    mission = arguments.mission or ""
    team = mission in names("teams") or Path(mission).parent.name == "teams"
    return fly(_of_team(arguments) if team else _campaign(arguments), arguments, "robustness")


def _of_team(arguments: argparse.Namespace) -> PairRobustness:
    """Return the campaign of a team file; raises ConfigError, one line per problem."""
    if arguments.cases is not None or arguments.keep is not None or arguments.vehicle is not None:
        raise ConfigError("companion robustness: a team file takes no --cases, --keep and --vehicle")
    _check_case(arguments)
    world = arguments.world or TEAM_WORLD
    team = load_team(
        arguments.mission,
        arguments.overrides,
        controller_law=arguments.controller,
        preset=arguments.preset,
        world=world,
    )
    problems = [
        text
        for _, config in team.members
        for text in check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    ]
    if problems:
        raise ConfigError(problems)
    numbers = range(arguments.first, arguments.first + arguments.draws)
    return PairRobustness(
        configs=[team.left, team.right],
        flights=[{"variant": 0, "name": f"draw {n}", "number": n} for n in numbers],
        **common(arguments),
        team=arguments.mission,
        seed=arguments.seed,
    )


def _campaign(arguments: argparse.Namespace) -> Robustness:
    """Return the campaign, after checking its configuration and its cases; raises ConfigError, one line per problem."""
    _check_case(arguments)
    refuse_beside(arguments, "--cases", ["--draws", "--seed", "--first"])
    kept: Cases | None = None
    cases: tuple[Case, ...] = ()
    if arguments.cases is not None:
        kept = read_cases(Path(arguments.cases))
        cases = kept.named(arguments.case)
        if not cases:
            raise ConfigError(f"{arguments.cases}: cases: expected at least one case, found none")
    mission = arguments.mission or (kept.mission if kept is not None else DEFAULT_MISSION)
    # The file's preset belongs to the file's control law.
    preset = arguments.preset or (kept.preset if kept is not None and arguments.controller is None else None)
    law = arguments.controller or (kept.controller if kept is not None else None)
    vehicle = arguments.vehicle or (kept.vehicle if kept is not None else None)
    arguments.overrides = [*(kept.overrides if kept is not None else ()), *arguments.overrides]
    # A case contains its whole world.
    world = arguments.world or ("robustness" if kept is None else "ideal")
    config = checked(mission, vehicle, law, preset, arguments.overrides, world=world)
    if law is None and config.mission.controller.file is not None:
        law = config.sources.controller
    if arguments.keep is not None:
        _check_keep(arguments)
    numbers = range(arguments.first, arguments.first + arguments.draws)
    return Robustness(
        configs=[config],
        flights=[{"variant": 0, "name": case.name, "number": None, "world": case.knobs()} for case in cases]
        or [{"variant": 0, "name": f"draw {n}", "number": n, "world": None} for n in numbers],
        **common(arguments),
        mission=mission,
        seed=arguments.seed,
        cases=cases,
        cases_file=arguments.cases,
        keep=arguments.keep,
        vehicle=vehicle,
        controller=law,
    )


def _check_case(arguments: argparse.Namespace) -> None:
    if arguments.case and arguments.cases is None:
        raise ConfigError("companion robustness: --case needs --cases FILE, the file that contains the case")


def _check_keep(arguments: argparse.Namespace) -> None:
    """Raise ConfigError if `--keep` cannot be written, or replaces cases that are not flown."""
    keep = Path(arguments.keep)
    updates = arguments.cases is not None and not arguments.case and keep.resolve() == Path(arguments.cases).resolve()
    problem = why_unusable(keep.parent, None)
    if keep.exists() and not updates:
        problem = "exists; expected the name of a new file, or that of --cases without --case"
    if problem is not None:
        raise ConfigError(f"companion robustness: --keep {keep}: {problem}")
