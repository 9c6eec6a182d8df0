"""`companion team fly|check`: two vehicles that carry a bar between them (docs/team.md)."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path
from typing import Any

from companion.cli.flight import no_bus_time, speed_of, start_impossible
from companion.cli.options import add_law, add_overrides, add_seed, add_sitl, add_world, time_stamp
from companion.config.document import ConfigError
from companion.config.shipped import names
from companion.mission.check import check_mission
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.runtime.console import print_error, terminal_console
from companion.runtime.subprocesses import LaunchError
from companion.sitl_config.team import TEAM_WORLD, TeamConfig, load_team


def add_parser(commands: Any) -> None:
    """Add the command to the sub-parsers of `companion`."""
    team = commands.add_parser("team", help="two vehicles that carry a bar: fly them in SITL, or check their files")
    parts = team.add_subparsers(dest="part", required=True, metavar="PART")
    fly = parts.add_parser(
        "fly",
        help="fly both vehicles of a team in the simulated world",
        description="Fly both vehicles of a team in one simulated world. On hardware, each vehicle flies its own part: "
        "companion fly FILE --member left|right.",
    )
    _add_options(fly)
    fly.add_argument("--out", metavar="DIR", help="folder for logs and reports (default: flights/TIME-TEAM)")
    fly.add_argument("--speed", metavar="FACTOR|max", help="as for companion fly")
    fly.add_argument("--real-time", action="store_true", help="as for companion fly")
    fly.add_argument("--no-report", action="store_true", help="write only logs and summaries")
    fly.set_defaults(run=_fly)
    check = parts.add_parser(
        "check",
        help="check the files of a team, and with --sitl the simulated devices of both",
        description="Check that both vehicles can fly their parts together. With --sitl, also run every check of the preflight.",
    )
    _add_options(check)
    check.set_defaults(run=_check, json=False, hand=False)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("team", metavar="TEAM", help=f"team: a built-in name ({', '.join(names('teams'))}) or a file")
    add_sitl(parser, "in the simulated world, with two PX4 stubs or two real PX4 (SITL)")
    add_law(parser)
    add_overrides(parser, "of both members")
    add_world(parser, TEAM_WORLD)
    add_seed(parser)


def _loaded(arguments: argparse.Namespace) -> TeamConfig:
    """Return the checked configuration of both members; raises ConfigError if the files, or the members together, have problems."""
    team = load_team(
        arguments.team,
        arguments.overrides,
        controller_law=arguments.controller,
        preset=arguments.preset,
        world=arguments.world,
        real_px4=arguments.sitl == "px4",
    )
    problems = []
    for end, config in team.members:
        found = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
        problems += [f"{end}: {line}" for line in found]
    if problems:
        raise ConfigError(problems)
    return team


def _fly(arguments: argparse.Namespace) -> int:
    from companion.cli.campaign import reserved_folder
    from companion.launcher.team import run_team

    if arguments.sitl is None:
        raise ConfigError(
            "companion team fly: expected --sitl; on hardware each vehicle flies its part: companion fly FILE --member left"
        )
    speed = speed_of(arguments)
    team = _loaded(arguments)
    problems = [
        f"{end}: {line}"
        for end, config in team.members
        for line in start_impossible(config) + no_bus_time(config, speed)
    ]
    shown = {config.vehicle.ground.foxglove for _, config in team.members}
    if len(shown) == 1 and None not in shown:
        text = f"both members have ground.foxglove {shown.pop()}; give each a port of its own"
        problems.append(f"{team.source}: {text}: --set right.vehicle.ground.foxglove=127.0.0.1:8766")
    if problems:
        raise ConfigError(problems)
    console, px4 = terminal_console(), arguments.sitl == "px4"
    default = Path("flights") / f"{time_stamp()}-{team.name}"
    with reserved_folder("team fly", arguments.out, default, "summary.json") as out:
        return run_team(team, out, console=console, report=not arguments.no_report, speed=speed, px4=px4)


def _check(arguments: argparse.Namespace) -> int:
    team = _loaded(arguments)
    if arguments.sitl is None:
        print(f"{team.source}: both members can fly mission {team.left.mission.name!r} together")
        return EXIT_OK
    from companion.cli import check
    from companion.launcher.sitl_process import SitlProcess
    from companion.launcher.team import linked

    scratch = Path(tempfile.mkdtemp(prefix="companion-check-"))
    codes = []
    try:
        try:
            members = linked(team, scratch)
            for end in members:
                (scratch / end).mkdir()
            folders = [(config, scratch / end) for end, config in members.items()]
            worlds = SitlProcess.start_all(folders, px4=arguments.sitl == "px4")
        except (OSError, LaunchError) as error:
            print_error(f"companion team check: {error}")
            return EXIT_REFUSED
        try:
            arguments.plan_only = False
            for (end, config), world in zip(members.items(), worlds, strict=True):
                print(f"{end}:", flush=True)
                codes.append(check.run(arguments, config, world))
        finally:
            for world in worlds:
                world.told.close()
            for world in worlds:
                world.stop()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return max(codes)
