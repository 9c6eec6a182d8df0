"""Options that several commands share: the control law and the simulated world."""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Callable, Iterator
from typing import Final, Self

from companion.config.controller import PRESETS
from companion.config.document import ConfigError
from companion.config.shipped import DEFAULT_MISSION, names
from companion.plugins import PluginError
from companion.sitl_config.loader import COMMAND_LINE_WORLD, WORLDS

MISSION_HELP = f"mission: a built-in name ({', '.join(names('missions'))}) or a file"
MISSION_OR_DEFAULT_HELP = f"{MISSION_HELP} (default: {DEFAULT_MISSION})"

_FILES: Final = {
    "vehicle": ("mission.vehicle",),
    "controller": ("mission.controller.law", "mission.controller.file"),
    "preset": ("mission.controller.preset",),
}
"""Options that replace what the mission file says, with its keys."""

_QUOTES: Final = "\"'"


class Shorthand(str):
    """An override that an option other than `--set` gives."""

    option = ""
    """The option with its value."""

    @classmethod
    def of(cls, option: str, key: str, value: str, shown: str | None = None) -> Self:
        """Return the override of a key by an option.

        Args:
            shown: the value as it is given, if that is another text.
        """
        override = cls(f"{key}={value}")
        override.option = f"{option} {value if shown is None else shown}".strip()
        return override


def refuse_contradictions(arguments: argparse.Namespace) -> None:
    """Refuse an option and a `--set` that give one setting different values; raises ConfigError."""
    overrides = getattr(arguments, "overrides", None) or ()
    for short in (*overrides, *_of_files(arguments)):
        if not isinstance(short, Shorthand):
            continue
        key, _, value = short.partition("=")
        for other in overrides:
            name, _, wanted = (text.strip() for text in other.partition("="))
            inside = any(long.startswith((f"{part}.", f"{part}[")) for long, part in ((name, key), (key, name)))
            if inside or (name == key and wanted.strip(_QUOTES) != value.strip(_QUOTES)):
                text = other.option if isinstance(other, Shorthand) else f"--set {other}"
                raise ConfigError(
                    f"companion {arguments.command}: {short.option} and {text} give one setting different values; "
                    "leave one of them out"
                )


def _of_files(arguments: argparse.Namespace) -> Iterator[Shorthand]:
    for name, keys in _FILES.items():
        value = getattr(arguments, name, None)
        if isinstance(value, str):
            for key in keys:
                yield Shorthand.of(f"--{name}", key, value)


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
    return Shorthand.of("--seed", "world.seed", str(whole(0, 999_999_999)(text)))
