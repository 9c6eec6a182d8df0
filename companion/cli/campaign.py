"""Shared parts of the campaign commands: options, checked configuration, results folder."""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import itertools
import os
import shlex
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from companion.campaigns.plan import SAMPLE, plan
from companion.campaigns.runner import Campaign, run
from companion.cli.options import add_law, add_overrides, add_world, time_stamp, whole
from companion.config.document import ConfigError
from companion.mission.check import check_mission
from companion.mission.plan import Plan
from companion.runtime.console import terminal_console
from companion.sitl_config.loader import COMMAND_LINE_WORLD, SitlConfig, load_sitl

PIPED_WIDTH = 132
"""Width of a table in columns if standard output is not a terminal."""
CAMPAIGN_WIDTH = 168
count = whole(1, 10_000)
"""Parser of a number of flights, seeds or processes, for argparse."""
MISSION_MAX_S = 300.0
"""Longest mission of a campaign: the fast loop keeps a flight in memory, 1.7 MB for each second, and a slow computer must
fly it within `companion.campaigns.process.STALL_TIMEOUT_S`."""


def add_options(parser: argparse.ArgumentParser, *, one_law: bool, world: str | None = COMMAND_LINE_WORLD) -> None:
    """Add the options that all campaigns share.

    Args:
        one_law: whether the campaign flies a single control law; adds `--controller` and `--preset`.
    """
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    if one_law:
        add_law(parser)
    add_overrides(parser, "override a setting for every flight")
    add_world(parser, world)
    parser.add_argument(
        "--jobs",
        type=count,
        metavar="N",
        help="number of simultaneous flights (default: depends on the number of cores)",
    )
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, to fly on its workers")
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: a new one named after the time)")
    parser.add_argument("--json", action="store_true", help="print only the results, as JSON")


def add_plan(parser: argparse.ArgumentParser) -> None:
    """Add `--plan`, for a campaign that flies in the fast closed loop only."""
    parser.add_argument(
        "--plan",
        action="store_true",
        help=f"fly at most {SAMPLE} of the flights, measure their processor time, and print how long all of them take here or with "
        "--scheduler on its workers",
    )


def refuse_beside(arguments: argparse.Namespace, option: str, others: Sequence[str]) -> None:
    """Raise ConfigError if the command line has an option and others that it makes meaningless."""
    given = {word.partition("=")[0] for word in shlex.split(arguments.command_line)}
    useless = [other for other in others if other in given]
    if option in given and useless:
        raise ConfigError(
            f"companion {arguments.command}: {', '.join(useless)}: has no effect with {option}; leave it out"
        )


def common(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a `Campaign` that the shared options set.

    Raises:
        ConfigError: of two options, one makes the other meaningless.
    """
    refuse_beside(arguments, "--scheduler", ["--jobs"])
    refuse_beside(arguments, "--plan", ["--out", "--keep"])
    return {
        "command": arguments.command_line,
        "overrides": arguments.overrides,
        "jobs": arguments.jobs,
        "scheduler": arguments.scheduler,
    }


def names(text: str) -> tuple[str, ...]:
    """Parse comma-separated names, for argparse."""
    found = tuple(name.strip() for name in text.split(","))
    if not all(found):
        raise argparse.ArgumentTypeError(f"expected comma-separated names, got '{text}'")
    return found


def checked(
    mission: str,
    vehicle: str | None,
    controller: str | None,
    preset: str | None,
    overrides: Sequence[str],
    *,
    world: str,
) -> SitlConfig:
    """Load a configuration and check its mission.

    Raises:
        ConfigError: one line per problem.
    """
    config = load_sitl(mission, vehicle, controller, preset, overrides, world=world)
    problems = check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)
    if problems:
        raise ConfigError(problems)
    duration_s = Plan.build(config.mission, config.vehicle).duration_s
    if duration_s > MISSION_MAX_S:
        text = f"expected a mission of at most {MISSION_MAX_S:g} s, got {duration_s:.0f} s; lower repeat, or fly it with companion fly"
        raise ConfigError(f"{mission}: {text}")
    return config


def fly(campaign: Campaign, arguments: argparse.Namespace, parent: str) -> int:
    """Fly a campaign into `--out`, or into a new folder under `parent`, or plan it with `--plan`; return the exit code.

    Raises:
        ConfigError: the folder cannot be used.
    """
    console = None if arguments.json else wide_console(CAMPAIGN_WIDTH)
    if getattr(arguments, "plan", False):
        return plan(campaign, console)
    with results_folder(arguments, parent, f"{campaign.name}.json") as folder:
        return run(campaign, folder, console)


@contextlib.contextmanager
def results_folder(arguments: argparse.Namespace, parent: str, result: str | None) -> Iterator[Path]:
    """Yield the folder for the results: `--out`, or a new one under `parent`. Afterwards it is removed if nothing was written.

    Raises:
        ConfigError: the folder cannot be used.
    """
    with reserved_folder(arguments.command, arguments.out, Path(parent) / time_stamp(), result) as folder:
        try:
            yield folder
        finally:
            # Removes empty folders only.
            with contextlib.suppress(OSError):
                folder.rmdir()
                if arguments.out is None:
                    folder.parent.rmdir()


@contextlib.contextmanager
def reserved_folder(command: str, given: str | None, default: Path, result: str | None) -> Iterator[Path]:
    """Yield the folder `given`, or a new one with the name `default`. Until the block ends, no other command can reserve it.

    Args:
        result: as for `why_unusable`.

    Raises:
        ConfigError: the folder cannot be used.
    """
    if given is not None and not given.strip():
        raise ConfigError(f"companion {command}: --out: expected the name of a folder, got an empty one")
    folder = _new(default) if given is None else Path(given)
    problem = why_unusable(folder, result)
    if problem is None:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if _locked(descriptor):
                yield folder
                return
        finally:
            os.close(descriptor)
        problem = "another command writes to it now; choose another folder"
    raise ConfigError(f"companion {command}: --out {folder}: {problem}")


def _new(folder: Path) -> Path:
    """Create a folder, with a number after its name if it exists. Return its path, also if it cannot be created."""
    path = folder
    for number in itertools.count(2):
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            path = folder.with_name(f"{folder.name}-{number}")
        except OSError:
            break
        else:
            break
    return path


def _locked(descriptor: int) -> bool:
    """Lock a folder without waiting. Return False if another process has locked it; a file system without locks never refuses."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def wide_console(width: int = PIPED_WIDTH) -> Console:
    """Return the console on standard output; for a pipe it has at least `width` columns."""
    console = terminal_console()
    if not console.is_terminal:
        console.width = max(console.width, width)
    return console


def why_unusable(folder: Path, result: str | None) -> str | None:
    """Create the folder if it does not exist. Return why results cannot be written into it, or None if they can.

    Args:
        result: name of the file by which earlier results are recognised; None to accept them.
    """
    try:
        if folder.exists() and not folder.is_dir():
            return "is a file; choose a folder"
        if result is not None and (folder / result).exists():
            return f"already contains {result}; choose another folder"
        folder.mkdir(parents=True, exist_ok=True)
        # Permission bits prove nothing: root ignores them, and a read-only file system overrides them.
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return f"{error.strerror}; choose a writable folder"
