"""Common sequence of the commissioning tools: collect data from the devices, fit, propose a change to the vehicle file, report.

The tools are the `TOOLS` of `companion.commissioning.arm`, `.force_torque`, `.latency` and `.mocap`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

from rich.text import Text

from companion.commissioning.patch import Patch, propose
from companion.config.base import Location
from companion.config.device_plugins import DYNAMIXEL
from companion.config.document import ConfigError, Data
from companion.config.loader import load_vehicle
from companion.config.shipped import DEFAULT_VEHICLE, named_file, names
from companion.config.vehicle import Vehicle
from companion.io.protocols import DeviceError
from companion.model.check_row import Level, Row, refusals
from companion.model.exit_codes import EXIT_ABORTED, EXIT_OK, EXIT_REFUSED
from companion.preflight.checks import Check
from companion.runtime.console import console_on, print_error
from companion.runtime.event_loop import run_until_interrupted

SCHEMA_VERSION: Final = 1
WRITE_HELP: Final = "write the proposed change into the vehicle file; the old file is kept beside it"
_T = TypeVar("_T")


class Cancelled(Exception):
    """The user ended the tool or answered no; the message states what was not done."""


@dataclass(frozen=True, slots=True)
class Family:
    """How a group of tools guides the user, writes the vehicle file and sets the exit code."""

    guides_on_stderr: bool
    """Whether instructions go to standard error even without `--json`."""
    asks_before_writing: bool
    """Whether `--write` without `--yes` asks before it writes the vehicle file."""
    ok_when_written: bool
    """Whether the exit code is 0 once the proposed change is written; if not, the user has to measure again."""


ARM: Final = Family(guides_on_stderr=False, asks_before_writing=False, ok_when_written=True)
SENSORS: Final = Family(guides_on_stderr=True, asks_before_writing=True, ok_when_written=False)


@dataclass(frozen=True, slots=True)
class Report:
    """Result of a tool."""

    rows: Sequence[Row] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    """JSON values in addition to the rows, with units in their keys."""
    text: Sequence[str] = ()
    """Lines printed above the rows."""
    changes: Mapping[Location, Data] = field(default_factory=dict)
    """Values to change in the vehicle file."""
    advice: Sequence[str] = ()
    """Lines printed below the rows."""
    ok: bool | None = None
    """Whether everything except `changes` is right; None if the rows decide."""
    brief: Mapping[str, str] = field(default_factory=dict)
    """Titles by id prefix: rows with this prefix that are ok are printed as one line."""

    @property
    def lines(self) -> list[str]:
        """Return the report as lines, without the change to the vehicle file."""
        return [*self.text, *row_lines(self.rows, self.brief), *self.advice]


class Session:
    """One run of a tool.

    Raises:
        ConfigError: the vehicle file or an override is wrong.
    """

    def __init__(self, arguments: argparse.Namespace, family: Family) -> None:
        if not str(arguments.vehicle).strip():
            raise ConfigError(
                f"companion {arguments.command}: --vehicle: expected the name of a file, got an empty one"
            )
        if arguments.writes_vehicle_file and arguments.write and arguments.vehicle in names("vehicles"):
            raise ConfigError(
                f"companion {arguments.command}: --write: {arguments.vehicle} is part of the installation; name your own vehicle "
                "file with --vehicle (companion init DIR writes copies of all files)"
            )
        self.arguments = arguments
        self.vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
        self.console = console_on(sys.stderr if family.guides_on_stderr or arguments.json else sys.stdout)

    def say(self, text: str, style: str = "") -> None:
        """Print one line of instructions."""
        self.console.print(Text(text, style=style), soft_wrap=True)

    def show(self, report: Report) -> None:
        """Print a report among the instructions, for a question about it."""
        for line in report.lines:
            self.say(line)

    def ask(self, question: str) -> bool | None:
        """Ask a yes-or-no question, which `--yes` answers with yes; return None if there is no terminal."""
        if getattr(self.arguments, "yes", False):
            return True
        if sys.stdin is None or not sys.stdin.isatty():
            return None
        self.say(f"{question} [y/N]", "bold")
        return sys.stdin.readline().strip().lower() in ("y", "yes")

    def confirm(self, question: str) -> bool:
        """Return whether the user agrees; if there is no terminal, print that nothing was done."""
        answer = self.ask(question)
        if answer is None:
            self.say(f"{question} not done: there is no terminal to ask; add --yes")
        return bool(answer)


@dataclass(frozen=True, slots=True)
class Tool(Generic[_T]):
    """One commissioning tool."""

    name: str
    """Words after `companion` on the command line."""
    family: Family
    collect: Callable[[Session], _T | Coroutine[Any, Any, _T]]
    """Checks the options, opens the devices, guides the user and returns the measurements. Ctrl-C cancels it if it is a coroutine."""
    fit: Callable[[_T, Vehicle], Report]
    """Evaluates the measurements; a pure function."""
    device: Check | None = None
    """Check whose row reports a device that cannot be opened or stops answering; None to report it as one line on standard error."""
    no_data: Mapping[str, Any] = field(default_factory=dict)
    """`Report.data` when a device fails."""
    servos_only: bool = False
    """Whether the tool reads or writes registers of Dynamixel servos."""


def run_tool(tool: Tool[Any], arguments: argparse.Namespace) -> int:
    """Run a tool to its end; return the exit code.

    Raises:
        ConfigError: an option or the vehicle file is wrong, or the change cannot be written into the vehicle file.
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    session = Session(arguments, tool.family)
    bus = session.vehicle.devices.arm
    if tool.family is ARM and bus is None:
        raise ConfigError(
            f"companion {tool.name}: expected a vehicle with an arm, but arm is null in {arguments.vehicle}"
        )
    if tool.servos_only and bus is not None and bus.type != DYNAMIXEL:
        raise ConfigError(f"companion {tool.name}: works with {DYNAMIXEL} servos only; devices.arm.type is {bus.type}")
    try:
        collected = tool.collect(session)
        if isinstance(collected, Coroutine):
            collected = run_until_interrupted(collected)
        report = tool.fit(collected, session.vehicle)
    except DeviceError as error:
        if tool.device is None:
            print_error(error)
            return EXIT_REFUSED
        report = Report([tool.device.bad(str(error))], tool.no_data)
    except Cancelled as end:
        print_error(f"companion {tool.name}: {end}")
        return EXIT_ABORTED
    if not arguments.json:  # before the question whether to write what it proposes
        for line in report.lines:
            print(line, flush=True)
    patch, written, problem = _change_file(session, tool.family, report)
    settled = not patch or (written is not None and tool.family.ok_when_written)
    ok = problem is None and settled and (not refusals(report.rows) if report.ok is None else report.ok)
    if arguments.json:
        document = {
            "schema_version": SCHEMA_VERSION,
            "tool": tool.name,
            "ok": ok,
            **report.data,
            "rows": [row.as_json() for row in report.rows],
            "patch": patch.as_json() if patch else None,
            "written": written,
            "backup": written,  # the arm's name for it
        }
        print(json.dumps(document, allow_nan=False))
    else:
        for line in _patch_lines(patch, written, problem):
            print(line)
    if problem is not None:
        raise problem  # after what was measured, which would be lost
    return EXIT_OK if ok else EXIT_REFUSED


def _change_file(
    session: Session, family: Family, report: Report
) -> tuple[Patch | None, str | None, ConfigError | None]:
    """Return the proposed change, the backup if it is written, and why it cannot be proposed or written."""
    patch = None
    try:
        if report.changes:
            patch = propose(named_file("vehicles", session.arguments.vehicle, "--vehicle"), report.changes)
        return patch, str(patch.write()) if patch and _may_write(session, family, patch, report) else None, None
    except ConfigError as error:
        return patch, None, error


def _may_write(session: Session, family: Family, patch: Patch, report: Report) -> bool:
    if not getattr(session.arguments, "write", False):
        return False
    if not family.asks_before_writing or session.arguments.yes:
        return True
    if session.arguments.json:
        session.show(report)
    session.say(patch.text)
    return session.confirm(f"write this to {patch.shown}?")


def row_lines(rows: Sequence[Row], brief: Mapping[str, str]) -> list[str]:
    """Return the rows as lines: result, title, measured value, and the remedy if a row is not ok."""
    lines, hidden, wrong = [], Counter[str](), set()
    for row in rows:
        group = row.id.rpartition(".")[0]
        if row.ok and group in brief:
            hidden[group] += 1
            continue
        mark = "ok" if row.ok else "WARN" if row.level is Level.WARN else "FAIL"
        wanted = f"   (wanted: {row.wanted})" if row.wanted and not row.ok else ""
        lines.append(f"{mark:<5} {row.title:<34} {row.read}{wanted}")
        if not row.ok:
            wrong.add(group)
            lines += [f"      -> {row.fix}"] if row.fix else []
    lines += [
        f"{'ok':<5} {brief[group]:<34} {'the other' if group in wrong else 'all'} {count} are correct"
        for group, count in hidden.items()
    ]
    return lines


def _patch_lines(patch: Patch | None, written: str | None, problem: ConfigError | None) -> list[str]:
    if not patch:
        return []
    how = f"written; the old file is kept as {written}" if written else "not written; add --write to write it"
    return ["", patch.text, *(["", how] if problem is None else [])]


def add_tool(
    parts: Any, name: str, module: str, *, help: str, description: str, write: str = WRITE_HELP, yes: bool = True
) -> argparse.ArgumentParser:
    """Add a tool's parser with the options that all tools have.

    Args:
        name: name of the tool, its key in `TOOLS`.
        module: module of `TOOLS`; imported when the tool runs.
        write: help of `--write`; empty if the tool has no such option.
    """
    parser: argparse.ArgumentParser = parts.add_parser(name, help=help, description=description)
    parser.add_argument(
        "--vehicle", metavar="FILE", default=DEFAULT_VEHICLE, help=f"vehicle file (default: {DEFAULT_VEHICLE})"
    )
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="override a value, e.g. vehicle.devices.arm.port=/dev/ttyUSB0",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print only one JSON document on standard output")
    if write:
        parser.add_argument("--write", action="store_true", help=write)
    if yes:
        parser.add_argument("--yes", action="store_true", help="answer every question with yes")
    parser.set_defaults(
        run=lambda arguments: run_tool(importlib.import_module(module).TOOLS[name], arguments),
        writes_vehicle_file=write == WRITE_HELP,
    )
    return parser


def number(low: float, high: float, unit: str = "", kind: Callable[[str], float] = float) -> Callable[[str], float]:
    """Return an argparse type: a number within limits, neither NaN nor infinite."""

    def parse(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {low:g} to {high:g}{unit}, got '{text}'")
        return value

    return parse
