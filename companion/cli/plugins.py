"""`companion plugins`: list the parts that installed distributions provide."""

from __future__ import annotations

import argparse
from typing import Any

from companion.config.base import Model
from companion.config.controller import LAWS
from companion.config.device_plugins import device_class
from companion.config.phase import phase_class
from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
from companion.plugins import CONTROL_LAWS, KINDS, PHASES, PluginError, installed


def add_parser(commands: Any) -> None:
    parser = commands.add_parser(
        "plugins",
        help="list the installed control laws, devices and phases of missions, and the packages that provide them",
        description="List the installed plug-ins: name, kind, distribution, version, description. Exit code 2: one cannot be used.",
    )
    parser.set_defaults(run=run)


def run(_: argparse.Namespace) -> int:
    """Print one row per plug-in; return the exit code."""
    rows = [("name", "kind", "distribution", "version", "what it is")]
    code = EXIT_OK
    for group, kind in KINDS.items():
        for name, plugin in installed(group).items():
            try:
                what = (_settings(group, name).__doc__ or "").strip().partition("\n")[0]
            except PluginError as error:
                code, what = EXIT_BAD_INPUT, f"cannot be used: {error.reason}"
            rows.append((name, kind, plugin.distribution, plugin.version, what))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    return code


def _settings(group: str, name: str) -> type[Model]:
    """Return the class of a plug-in's settings; raises PluginError if it cannot be used."""
    settings: type[Model]
    if group == CONTROL_LAWS:
        settings = LAWS[name]
    else:
        settings = phase_class(name) if group == PHASES else device_class(group, name).options
    return settings
