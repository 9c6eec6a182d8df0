"""`companion init`: copy the shipped configuration files into a folder, for users to edit."""

from __future__ import annotations

import argparse
import shlex
import shutil
from pathlib import Path
from typing import Any

from companion.config.document import ConfigError
from companion.config.shipped import DEFAULT_MISSION, FILES
from companion.model.exit_codes import EXIT_OK


def add_parser(commands: Any) -> None:
    init = commands.add_parser(
        "init",
        help="copy the shipped missions, vehicle, control laws, worlds and layouts into a new folder, to edit them",
        description="Copy the shipped configuration files into a new folder. The documentation calls this folder configs.",
    )
    init.add_argument("folder", nargs="?", type=Path, default=Path("configs"), help="new folder (default: configs)")
    init.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Copy the files; return the exit code.

    Raises:
        ConfigError: the folder exists or cannot be written.
    """
    folder: Path = arguments.folder
    if folder.exists():
        raise ConfigError(f"companion init: {folder} exists; expected the name of a new folder; nothing was written")
    try:
        shutil.copytree(FILES, folder, copy_function=shutil.copyfile)
    except OSError as error:
        raise ConfigError(f"companion init: {folder}: cannot be written: {error.strerror or error}") from None
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    line = shlex.join(["companion", "fly", f"{folder / 'missions' / DEFAULT_MISSION}.yaml", "--sitl"])
    print(f"try: {line}")
    return EXIT_OK
