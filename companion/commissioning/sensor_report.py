"""What the sensor tools share: options, the way a result is shown, the proposed patch, exit codes, Ctrl-C."""

from __future__ import annotations

import argparse
import asyncio
import json
import signal
import sys
from collections.abc import Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from companion.commissioning.patch import Patch, propose
from companion.config.base import Location
from companion.config.document import Data
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.model.rows import Level, Row, refusals
from companion.runtime.console import tell

VEHICLE = "configs/vehicles/tarot650_2r.yaml"
_TITLE_WIDTH = 34
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Result:
    """What a tool has found."""

    rows: Sequence[Row]
    data: Mapping[str, Any]
    """For `--json`, beside the rows; units in the names."""
    text: Sequence[str] = ()
    """For people, above the rows."""
    changes: Mapping[Location, Data] = field(default_factory=dict)
    """Of the vehicle file."""
    advice: Sequence[str] = ()
    """For people, below the rows."""


def add_options(parser: argparse.ArgumentParser, *, patches: bool = True) -> None:
    """Options that every sensor tool has.

    Args:
        parser: of the tool.
        patches: it may propose a change of the vehicle file.
    """
    parser.add_argument("--vehicle", metavar="FILE", default=VEHICLE, help=f"vehicle file (default: {VEHICLE})")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="e.g. vehicle.devices.force.port=...",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON, nothing else")
    if patches:
        parser.add_argument(
            "--write", action="store_true", help="write the proposed patch; the old file stays beside it"
        )
        parser.add_argument("--yes", action="store_true", help="ask nothing")


class Guide:
    """Says what to do, on standard error: standard output is the result's."""

    def __call__(self, text: str) -> None:
        """One line."""
        tell(text)


def ask(question: str, *, yes: bool) -> bool:
    """Whether a person agrees; without a terminal nobody does.

    Args:
        question: ends without a question mark's answer: "[y/N]" is added.
        yes: `--yes` was given.
    """
    if yes:
        return True
    if not sys.stdin or not sys.stdin.isatty():
        tell(f"{question}: not done; nobody can be asked here, say --yes")
        return False
    tell(f"{question} [y/N]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def finish(arguments: argparse.Namespace, result: Result) -> int:
    """Show the result, propose and perhaps write the patch; the exit code: 3 if anything is wrong, whether it was written or not.

    Raises:
        ConfigError: the vehicle file cannot take the patch.
    """
    patch = propose(arguments.vehicle, result.changes) if result.changes else None
    written = _write(arguments, patch) if patch and arguments.write else None
    wrong = bool(refusals(result.rows)) or bool(patch)
    if arguments.json:
        document = {
            "schema_version": 1,
            "ok": not wrong,
            **result.data,
            "rows": [row.as_json() for row in result.rows],
            "patch": patch.as_json() if patch else None,
            "written": written,
        }
        print(json.dumps(document, indent=2, allow_nan=False))
    else:
        print("\n".join([*result.text, *_shown(result.rows), *result.advice, *_patch_lines(patch, written)]))
    return EXIT_REFUSED if wrong else EXIT_OK


def _write(arguments: argparse.Namespace, patch: Patch) -> str | None:
    if not arguments.yes:
        tell(patch.text)
    return str(patch.write()) if ask(f"write this to {patch.shown}?", yes=arguments.yes) else None


def _shown(rows: Sequence[Row]) -> list[str]:
    lines = []
    for row in rows:
        mark = "ok" if row.ok else "WARN" if row.level is Level.WARN else "FAIL"
        wanted = f"   (wanted: {row.wanted})" if row.wanted and not row.ok else ""
        lines.append(f"{mark:<5} {row.title:<{_TITLE_WIDTH}} {row.read}{wanted}")
        if not row.ok and row.fix:
            lines.append(f"      -> {row.fix}")
    return lines


def _patch_lines(patch: Patch | None, written: str | None) -> list[str]:
    if not patch:
        return []
    said = f"written; the old file: {written}" if written else "not written; --write does it"
    return ["", patch.text, "", said]


def run_until_interrupted(work: Coroutine[Any, Any, _T]) -> _T:
    """Run it in an event loop of its own; Ctrl-C cancels it, whatever becomes of that on its way, and comes out as what it is.

    Raises:
        KeyboardInterrupt: Ctrl-C.
    """

    async def guarded() -> tuple[_T] | None:
        interrupted = asyncio.Event()
        loop = asyncio.get_running_loop()
        task = asyncio.ensure_future(work)

        def interrupt() -> None:
            interrupted.set()
            task.cancel()

        loop.add_signal_handler(signal.SIGINT, interrupt)
        try:
            await asyncio.wait((task,))
        finally:
            loop.remove_signal_handler(signal.SIGINT)
        if interrupted.is_set():
            if not task.cancelled():
                task.exception()  # seen; it is not what ended the work
            return None
        return (task.result(),)

    done = asyncio.run(guarded())
    if done is None:
        raise KeyboardInterrupt
    return done[0]
