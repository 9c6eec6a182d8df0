"""The command `companion`: parses the command line and calls the module of the command."""

from __future__ import annotations

import argparse
import errno
import importlib
import re
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from companion import __version__
from companion.runtime.subprocesses import prepare_streams, use_default_signals

_OF_FLIGHT = ("fly", "check", "schema", "sitl", "replay")
"""Commands whose parsers are in `companion.cli.flight`."""
_WITH_MODULES = (
    "compare", "robustness", "faults", "tune", "hover", "identify", "install", "arm", "px4", "mocap", "ft", "latency", "monitor",
    "command", "broker", "report", "export", "init", "plugins", "team",
)  # fmt: skip
"""Commands whose parser is in `companion.cli.NAME`."""
_ADDRESS = re.compile(r"[^/]*:\d+")
"""A word that is the value of the `--foxglove` before it."""


class _Parser(argparse.ArgumentParser):
    """Argument parser that prints one line per error and accepts no abbreviations."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def format_help(self) -> str:
        for action in self._actions:
            if action.dest == "preset":
                from companion.cli.options import preset_help

                action.help = preset_help()
        return super().format_help()

    def error(self, message: str) -> None:  # type: ignore[override]
        from companion.model.exit_codes import EXIT_BAD_INPUT

        sys.stderr.write(f"{self.prog}: {message}; see {self.prog} --help\n")
        sys.exit(EXIT_BAD_INPUT)

    def _print_message(self, message: str, file: Any = None) -> None:
        print(message, end="", file=file or sys.stderr, flush=True)  # argparse ignores what cannot be written


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `companion`."""
    prepare_streams()
    use_default_signals()
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        return _run(_normalised(words))
    except KeyboardInterrupt:  # also while modules are imported, which takes most of the time of a short command
        from companion.runtime.interrupt import interrupted

        return interrupted(words)


def _run(words: list[str]) -> int:
    """Run the command and return its exit code.

    Args:
        words: the command line after `_normalised`.
    """
    code = None
    try:
        code = _run_command(words)
        sys.stdout.flush()
        from companion.runtime.console import SteadyStream

        SteadyStream.raise_full()
    except OSError as error:
        from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK
        from companion.runtime.console import FULL, SteadyStream, print_error

        if error.errno not in (errno.EPIPE, *FULL) or error.filename is not None:
            raise
        SteadyStream(sys.stdout).discard()
        if error.errno == errno.EPIPE:
            return code or EXIT_OK
        print_error(f"{' '.join(['companion', *words[:1]])}: standard output cannot be written: {error.strerror}")
        if code is not None and "fly" in words[:2]:  # the code is the flight's outcome, and 2 says that nothing moved
            return code
        return code or EXIT_BAD_INPUT
    return code


def _run_command(words: list[str]) -> int:
    arguments, unknown = make_parser(words[:1]).parse_known_args(words)
    # Imported here, because printing the version needs none of it.
    from companion.config.document import ConfigError
    from companion.install.extras import missing_extra
    from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_REFUSED
    from companion.plugins import PluginError
    from companion.runtime.console import print_error

    if unknown:
        print_error(
            f"companion {arguments.command}: unknown arguments: {' '.join(unknown)}; see companion {arguments.command} --help"
        )
        return EXIT_BAD_INPUT
    arguments.command_line = shlex.join(["companion", *words])
    missing = missing_extra(arguments)
    if missing is not None:
        print_error(missing)
        return EXIT_REFUSED
    try:
        if hasattr(arguments, "overrides"):
            from companion.cli.options import refuse_contradictions

            refuse_contradictions(arguments)
        code: int = arguments.run(arguments)
    except (ConfigError, PluginError) as error:
        for line in error.lines if isinstance(error, ConfigError) else (error,):
            print_error(line)
        return EXIT_BAD_INPUT
    return code


def _normalised(argv: list[str]) -> list[str]:
    """Convert `--sitl` and `--foxglove` without a value to their default values, and `--set a=1 b=2` to one `--set` each."""
    out: list[str] = []
    in_set = False
    for word, following in zip(argv, [*argv[1:], ""], strict=False):
        if word == "--foxglove" and not _ADDRESS.fullmatch(following):
            from companion.config.ground import FOXGLOVE_DEFAULT

            out.append(f"--foxglove={FOXGLOVE_DEFAULT}")
            in_set = False
        elif word == "--sitl":
            out.append("--sitl=stub")
            in_set = False
        elif in_set and "=" in word and not word.startswith("-"):
            out += ["--set", word] if out[-1] != "--set" else [word]
        else:
            if in_set and out[-1] == "--set":
                out.append(word)  # not KEY=VALUE: the loader reports it
                in_set = False
                continue
            in_set = word == "--set" or word.startswith("--set=")
            out.append(word)
    return out


def make_parser(first: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of the first command on the command line, or else of all commands, which takes half a second to load."""
    parser = _Parser(
        prog="companion", description="Flies an aerial manipulator on PX4 with adaptive impedance control."
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    word = first[0] if first else ""
    modules = ["flight", *_WITH_MODULES]
    if word == "--version":
        modules = []
    elif word in _OF_FLIGHT:
        modules = ["flight"]
    elif word in _WITH_MODULES:
        modules = [word]
    for name in modules:
        importlib.import_module(f"companion.cli.{name}").add_parser(commands)
    return parser
