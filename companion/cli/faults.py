"""`companion faults`: fly each fault in every phase of a mission and judge the flights."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from typing import Any

from companion.analysis.table import for_terminal
from companion.campaigns.faults.campaign import Faults, kinds_list, kinds_table
from companion.campaigns.faults.variants import WIRES, planned, touches
from companion.cli.campaign import add_options, checked, common, fly, names, refuse_beside, wide_console
from companion.cli.options import MISSION_OR_DEFAULT_HELP, add_seed
from companion.config.document import ConfigError
from companion.config.explain import nearest
from companion.config.shipped import DEFAULT_MISSION
from companion.model.exit_codes import EXIT_OK
from companion.runtime.console import print_error
from companion.sitl_config.faults import CONTACT_PHASES, KINDS, PHASES, absent_part
from companion.sitl_config.loader import COMMAND_LINE_WORLD

_OF_FLIGHTS = (
    *("--kinds", "--phases", "--wires", "--vehicle", "--controller", "--preset", "--set", "--world"),
    *("--seed", "--jobs", "--scheduler", "--out"),
)
"""Options that have no effect on `--list`."""
CONTACT_MISSION, SLIDING_MISSION, CONTACT_WORLD = "press", "slide", "wall"


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "faults",
        help="fly a mission with every fault of the simulated world",
        description="Fly a mission in the fast closed loop, or with --wires over the real protocols, with one fault "
        "per flight, in every phase. Exit code 0 only if every flight was completed or landed, no "
        "vehicle pulled its tether taut by its own motion and none left the room; otherwise 5.",
    )
    parser.add_argument("mission", nargs="?", default=DEFAULT_MISSION, help=MISSION_OR_DEFAULT_HELP)
    parser.add_argument(
        "--list", action="store_true", help="print the kinds of faults and the meaning of their sizes; fly nothing"
    )
    kinds = _known(tuple(KINDS), "kind of fault")
    parser.add_argument("--kinds", type=kinds, default=(), metavar="KIND,...", help="default: all; see --list")
    parser.add_argument(
        "--phases", type=_known((*PHASES, *CONTACT_PHASES), "phase"), default=(), metavar="PHASE,...",
        help=f"phases from {', '.join(PHASES)}; default: all of these. Or from {', '.join(CONTACT_PHASES)}, flown with the mission "
        f"{CONTACT_MISSION} (slide: {SLIDING_MISSION}) in the world {CONTACT_WORLD} unless others are given; the default for kinds "
        "that need a surface",
    )  # fmt: skip
    parser.add_argument(
        "--wires",
        action="store_true",
        help=f"fly {len(WIRES)} selected faults with `companion fly --sitl`, one minute each",
    )
    add_options(parser, one_law=True)
    add_seed(parser)
    parser.set_defaults(run=run)


def _known(known: Sequence[str], what: str) -> Callable[[str], tuple[str, ...]]:
    def parse(text: str) -> tuple[str, ...]:
        found = names(text)
        for name in found:
            if name not in known:
                like = nearest(name, list(known))
                hint = f"did you mean '{like}'?" if like else f"available: {', '.join(known)}"
                raise argparse.ArgumentTypeError(f"there is no {what} '{name}'; {hint}")
        return found

    return parse


def run(arguments: argparse.Namespace) -> int:
    refuse_beside(arguments, "--list", _OF_FLIGHTS)
    refuse_beside(arguments, "--wires", ["--scheduler"])
    if not arguments.list:
        return fly(_campaign(arguments), arguments, "faults")
    if arguments.json:
        print(json.dumps(kinds_list(), indent=1))
    else:
        wide_console().print(for_terminal(kinds_table()), highlight=False)
    return EXIT_OK


def _campaign(arguments: argparse.Namespace) -> Faults:
    """Return the campaign, after checking its configuration and its flights; raises ConfigError, one line per problem."""
    touching = [kind for kind in arguments.kinds if KINDS[kind].phases == CONTACT_PHASES]
    if touching and not arguments.phases:
        if len(touching) < len(arguments.kinds):
            raise ConfigError(
                f"companion faults: --kinds: {', '.join(touching)} need a mission with a contact, got other kinds as well; choose "
                f"--phases {','.join(CONTACT_PHASES)}, or fly two campaigns"
            )
        arguments.phases = tuple(phase for phase in CONTACT_PHASES if phase != "slide")
    if touches(arguments.phases):
        if not set(arguments.phases) <= set(CONTACT_PHASES):
            raise ConfigError(
                f"companion faults: --phases: {', '.join(CONTACT_PHASES)} need a mission with a contact, got other phases as well; "
                "fly two campaigns"
            )
        if arguments.mission == DEFAULT_MISSION:
            arguments.mission = SLIDING_MISSION if "slide" in arguments.phases else CONTACT_MISSION
        if arguments.world == COMMAND_LINE_WORLD:
            arguments.world = CONTACT_WORLD
    flights = planned(arguments.kinds, arguments.phases, wires=arguments.wires)
    if not flights:
        where = " with --wires" if arguments.wires else ""
        kinds, phases = " or ".join(arguments.kinds) or "any", " or ".join(arguments.phases) or "any"
        raise ConfigError(f"companion faults: no fault{where} has kind {kinds} and phase {phases}; choose others")
    for override in arguments.overrides:
        if override.partition("=")[0].strip().partition("[")[0] == "world.faults":
            raise ConfigError(
                "companion faults: --set world.faults: the campaign sets this key; use --kinds and --phases"
            )
    given = arguments.vehicle, arguments.controller, arguments.preset
    config = checked(arguments.mission, *given, arguments.overrides, world=arguments.world)
    if arguments.wires and config.vehicle.devices.mocap.external:
        raise ConfigError(
            "companion faults: --wires needs frames of motion capture to relate the log to the simulated world, but "
            "devices.mocap.type is external; fly without --wires"
        )
    absent = {v.kind: key for v, _ in flights if (key := absent_part(v.kind, config.vehicle)) is not None}
    if absent:
        missing = " and ".join(sorted(set(absent.values())))
        text = f"companion faults: not flown, because the vehicle has no {missing}: {', '.join(absent)}"
        flights = [(v, phase) for v, phase in flights if v.kind not in absent]
        if not flights:
            raise ConfigError(text)
        print_error(text)
    return Faults(
        configs=[config],
        flights=[
            {"variant": 0, "kind": v.kind, "size": v.size, "duration_s": v.duration_s, "phase": phase}
            for v, phase in flights
        ],
        **common(arguments),
        planned=flights,
        wires=_fly_options(arguments) if arguments.wires else None,
    )


def _fly_options(arguments: argparse.Namespace) -> list[str]:
    options = [arguments.mission]
    for name in ("vehicle", "controller", "preset", "world"):
        value = getattr(arguments, name)
        options += [f"--{name}", value] if value is not None else []
    for override in arguments.overrides:
        options += ["--set", override]
    return options
