"""`companion compare`: compare controllers, presets, payloads and seeds in the fast loop, in the form of the paper's table."""

from __future__ import annotations

import argparse
import math
from typing import Any

from companion.campaigns.compare.campaign import Compare
from companion.campaigns.compare.grid import ADAPTATION, Variant, flights_of, variants_of
from companion.cli.campaign import add_options, add_plan, checked, common, count, fly, names
from companion.cli.options import MISSION_OR_DEFAULT_HELP, whole
from companion.config.controller import PRESETS
from companion.config.document import ConfigError
from companion.config.loader import is_controller_file, preset_of_file
from companion.config.shipped import DEFAULT_MISSION
from companion.sitl_config.loader import SitlConfig, load_sitl

_OPTIONS = {"world.payload_kg": "--payloads", "world.seed": "--seeds", "world.model_error": "--model-error"}
"""Options to use instead of overriding the keys that the grid sets."""

_FIRST_SEED_MAX = 900_000
"""Largest first seed: `companion tune` searches in laboratories from 1,000,000 on."""


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "compare",
        help="compare controllers in the fast closed loop",
        description="Fly a grid of controllers, presets, payloads and seeds in the fast closed loop and print the "
        "results beside the values of the paper's table. A crash is a result, not an error.",
    )
    parser.add_argument(
        "--payloads", type=_payloads, default=(0.1, 0.2, 0.3), metavar="KG,...", help="default: 0.1,0.2,0.3"
    )
    parser.add_argument(
        "--controllers",
        type=names,
        default=(),
        metavar="LAW|FILE,...",
        help="control laws, and files: *.yaml of companion tune, *.onnx "
        f"(default: the presets of {','.join(law for law in PRESETS if PRESETS[law])})",
    )
    parser.add_argument(
        "--presets", type=names, default=(), metavar="NAME,...", help="default: all presets of each law"
    )
    parser.add_argument("--seeds", type=count, default=5, metavar="N", help="number of seeds per cell (default: 5)")
    parser.add_argument(
        "--first-seed", type=whole(1, _FIRST_SEED_MAX), default=1, metavar="N", help="first seed (default: 1)"
    )
    parser.add_argument(
        "--model-error", type=_model_errors, metavar="SHARE,...",
        help="fractions by which masses, inertia and torque constants differ from the vehicle file, 0 to 0.3, e.g. 0,0.1,0.2,0.3 "
        "(default: the model error of the world)",
    )  # fmt: skip
    parser.add_argument(
        "--adaptation", type=_adaptation, default=ADAPTATION[:1], metavar="on,off",
        help="whether the presets of the adaptive law fly with their adaptation (on), without it (off) or both ways (on,off) "
        "(default: on)",
    )  # fmt: skip
    parser.add_argument(
        "--ablation", action="store_true", help="also fly adaptive/recommended with one part removed at a time"
    )
    parser.add_argument("--mission", default=DEFAULT_MISSION, metavar="FILE", help=MISSION_OR_DEFAULT_HELP)
    add_options(parser, one_law=False)
    add_plan(parser)
    parser.set_defaults(run=run)


def _payloads(text: str) -> tuple[float, ...]:
    return _numbers(text, 2.0, "masses in kg from 0 to 2")


def _model_errors(text: str) -> tuple[float, ...]:
    return _numbers(text, 0.3, "fractions from 0 to 0.3")


def _adaptation(text: str) -> tuple[str, ...]:
    if not set(names(text)) <= set(ADAPTATION):
        raise argparse.ArgumentTypeError(f"expected on, off or on,off, got '{text}'")
    return names(text)


def _numbers(text: str, most: float, what: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (math.nan,)
    if not all(0 <= value <= most for value in values):
        raise argparse.ArgumentTypeError(f"expected comma-separated {what}, got '{text}'")
    return tuple(dict.fromkeys(values))


def run(arguments: argparse.Namespace) -> int:
    return fly(_campaign(arguments), arguments, "comparisons")


def _campaign(arguments: argparse.Namespace) -> Compare:
    """Return the campaign, after checking every configuration; raises ConfigError, one line per problem."""
    for override in arguments.overrides:
        for key, option in _OPTIONS.items():
            if override.partition("=")[0].strip() == key:
                raise ConfigError(f"companion compare: --set {key}: the grid sets this key; use {option}")
    files = list(dict.fromkeys(name for name in arguments.controllers if is_controller_file(name)))
    laws = [name for name in arguments.controllers if name not in files]
    if files and not laws:
        given = {
            "--presets": arguments.presets,
            "--ablation": arguments.ablation,
            "--adaptation": "off" in arguments.adaptation,
        }
        for option in (option for option, value in given.items() if value):
            raise ConfigError(f"companion compare: {option}: expected a control law in --controllers, got files only")
    variants = [Variant(file, preset_of_file(file), None) for file in files]
    try:
        if laws or not files:
            variants += variants_of(PRESETS, laws, arguments.presets, arguments.ablation, arguments.adaptation)
    except ValueError as error:
        raise ConfigError(f"companion compare: {error}") from None
    configs: list[SitlConfig] = []
    for variant in variants:
        load = load_sitl if configs else checked  # the same mission and vehicle: checked once
        overrides = (*arguments.overrides, *variant.overrides)
        try:
            configs.append(
                load(
                    arguments.mission,
                    arguments.vehicle,
                    variant.controller,
                    variant.base_preset,
                    overrides,
                    world=arguments.world,
                )
            )
        except ConfigError as error:
            # A problem of the first variant usually affects all; a problem of a later one affects only that one.
            raise ConfigError([f"{variant.label}: {line}" if configs else line for line in error.lines]) from None
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    model_errors = arguments.model_error or (configs[0].world.model_error,)
    return Compare(
        configs=configs,
        flights=flights_of(variants, arguments.payloads, seeds, model_errors),
        **common(arguments),
        variants=variants,
        payloads_kg=arguments.payloads,
        seeds=seeds,
        model_errors=model_errors,
    )
