"""Options that several commands share: the control law and the simulated world."""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Callable

from companion.config.controller import PRESETS
from companion.config.shipped import DEFAULT_MISSION, names
from companion.plugins import PluginError
from companion.sitl_config.loader import COMMAND_LINE_WORLD, WORLDS

MISSION_HELP = f"mission: a built-in name ({', '.join(names('missions'))}) or a file"
MISSION_OR_DEFAULT_HELP = f"{MISSION_HELP} (default: {DEFAULT_MISSION})"


def time_stamp() -> str:
    """Return the local time as part of a file name, such as `20261125-093743`."""
    return datetime.datetime.now().strftime("%Y%m%d-%H%M%S")


def add_law(parser: argparse.ArgumentParser) -> None:
    """Add `--controller` and `--preset`."""
    parser.add_argument(
        "--controller", metavar="LAW|FILE", help=f"control law: {', '.join(PRESETS)}, or a file: *.yaml, *.onnx"
    )
    parser.add_argument("--preset", metavar="NAME", help="gains")


def preset_help() -> str:
    """Return the help of `--preset`. This imports every installed law, so the text is made only when the help is shown."""
    gains = []
    for law in PRESETS:
        try:
            gains += [f"{law}: {', '.join(reversed(PRESETS[law]))}"] if PRESETS[law] else []
        except PluginError:
            gains.append(f"{law}: see companion plugins")
    return f"gains, the default first ({'; '.join(gains)})"


def add_world(parser: argparse.ArgumentParser, default: str | None = COMMAND_LINE_WORLD) -> None:
    """Add `--world`; only `companion robustness` has no default."""
    parser.add_argument(
        "--world",
        default=default,
        metavar=f"{'|'.join(WORLDS)}|FILE",
        help=f"simulated world: a built-in name or a file (default: {default or 'robustness; with --cases: ideal'})",
    )


def add_overrides(parser: argparse.ArgumentParser, help: str) -> None:
    """Add `--set`."""
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help=help)


def add_sitl(parser: argparse.ArgumentParser, help: str) -> None:
    """Add `--sitl`."""
    parser.add_argument("--sitl", type=_autopilot, metavar="stub|px4", help=help)


def _autopilot(text: str) -> str:
    if text not in ("stub", "px4"):
        raise argparse.ArgumentTypeError(f"expected --sitl, --sitl=stub or --sitl=px4, got '{text}'")
    return text


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return an argparse type: a whole number within limits."""

    def parse(text: str) -> int:
        if not text.isdecimal() or len(text) > len(str(high)) or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"expected a whole number from {low} to {high}, got '{text}'")
        return int(text)

    return parse


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add `--seed`, a shorthand for `--set world.seed=N`."""
    parser.add_argument(
        "--seed",
        dest="overrides",
        action="append",
        default=[],
        type=_seed_override,
        metavar="N",
        help="seed of the simulated world: another seed draws another laboratory and other noise (shorthand for --set world.seed=N)",
    )


def _seed_override(text: str) -> str:
    return f"world.seed={whole(0, 999_999_999)(text)}"
