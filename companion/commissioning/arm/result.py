"""How each of the arm's tools ends: the proposed change shown or written, one JSON document, an exit code."""

from __future__ import annotations

import argparse
import json
from typing import Any

from rich.console import Console

from companion.commissioning.arm.screen import say
from companion.commissioning.patch import Patch, propose
from companion.config.base import Location
from companion.config.document import Data
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED

SCHEMA_VERSION = 1


def finish(
    arguments: argparse.Namespace,
    people: Console,
    fine: bool,
    changes: dict[Location, Data],
    result: dict[str, Any],
    *,
    instead: str = "",
) -> int:
    """Show the patch, write it if asked, print the JSON document; returns the exit code.

    Args:
        arguments: of the command: `vehicle`, `part`, `json`, perhaps `write`.
        people: where people are told.
        fine: nothing but the changes is wrong.
        changes: for the vehicle file.
        result: the tool's own part of the JSON document.
        instead: what the change of the file would be instead of; empty: there is no other way.

    Raises:
        ConfigError: the vehicle file cannot be changed so, or not be written.
    """
    patch = propose(arguments.vehicle, changes) if changes else None
    written = None
    if patch:
        write = getattr(arguments, "write", False)
        if write:
            written = str(patch.write())
        say(people, "")
        lead = f"or, instead of {instead}, let" if instead else "let"
        say(
            people,
            "written into the vehicle file:" if write else f"{lead} the vehicle file say (--write does it):",
            "bold",
        )
        say(people, patch.text)
        if written:
            say(people, f"the file as it was: {written}")
    left = bool(patch) and written is None
    ok = fine and not left
    if arguments.json:
        document = {"schema_version": SCHEMA_VERSION, "tool": f"arm {arguments.part}", "ok": ok, **result}
        print(json.dumps({**document, "patch": _patch_json(patch), "backup": written}, allow_nan=False))
    return EXIT_OK if ok else EXIT_REFUSED


def _patch_json(patch: Patch | None) -> dict[str, Any] | None:
    return patch.as_json() if patch else None
