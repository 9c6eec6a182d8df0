"""`companion tune`: find the gains of a control law for a machine."""

from __future__ import annotations

import argparse
import shlex
from typing import Any

from companion.campaigns.tune.tune import Tune, plan, run
from companion.cli.campaign import CAMPAIGN_WIDTH, add_options, checked, common, count, results_folder, wide_console
from companion.cli.options import MISSION_OR_DEFAULT_HELP
from companion.config.document import ConfigError
from companion.config.shipped import DEFAULT_MISSION


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "tune",
        help="find the gains of a control law for a machine",
        description="Search the gains that a control law declares by CMA-ES, in drawn laboratories in the fast closed loop, from the "
        "gains of a preset or a controller file. Write them as a controller file if they cost less in held-out laboratories; exit code "
        "3 if they do not. The same command with the same --out continues a search that was interrupted.",
    )
    parser.add_argument("--mission", default=DEFAULT_MISSION, metavar="FILE", help=MISSION_OR_DEFAULT_HELP)
    parser.add_argument("--budget", type=count, default=300, metavar="N", help="candidates to fly (default: 300)")
    parser.add_argument("--seed", type=count, default=1, metavar="N", help="seed of the search (default: 1)")
    parser.add_argument(
        "--laboratories", type=count, default=8, metavar="N", help="laboratories of the search (default: 8)"
    )
    parser.add_argument(
        "--held-out", type=count, default=30, metavar="N", help="laboratories that judge the result (default: 30)"
    )
    parser.add_argument(
        "--plan",
        action="store_true",
        help="fly a few flights, measure their processor time, and print how long the search takes here, or with --scheduler on its "
        "workers",
    )
    add_options(parser, one_law=True)
    parser.set_defaults(run=run_command)


def run_command(arguments: argparse.Namespace) -> int:
    """Search; return the exit code."""
    tune = _tune(arguments)
    console = None if arguments.json else wide_console(CAMPAIGN_WIDTH)
    if arguments.plan:
        return plan(tune, console)
    with results_folder(arguments, "tuning", None) as folder:
        return run(tune, folder, console)


def _tune(arguments: argparse.Namespace) -> Tune:
    """Return the search, after checking its configuration; raises ConfigError, one line per problem."""
    for override in arguments.overrides:
        if override.partition("=")[0].strip() == "world.seed":
            raise ConfigError("companion tune: --set world.seed: the search sets this key; use --seed")
    config = checked(
        arguments.mission,
        arguments.vehicle,
        arguments.controller,
        arguments.preset,
        arguments.overrides,
        world=arguments.world,
    )
    words = ["companion", "fly", arguments.mission, "--sitl", "--world", arguments.world]
    words += [] if arguments.vehicle is None else ["--vehicle", arguments.vehicle]
    # The controller file has its own overrides already.
    sets = [override for override in arguments.overrides if not override.strip().startswith("controller.")]
    words += ["--set", *sets] if sets else []
    return Tune(
        config=config,
        budget=arguments.budget,
        seed=arguments.seed,
        training=arguments.laboratories,
        held_out=arguments.held_out,
        fly=shlex.join(words),
        **common(arguments),
    )
