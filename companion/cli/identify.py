"""`companion identify`: find the parameters of a machine and of its world in the log of one flight."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from companion.analysis.log import LogError
from companion.config.document import ConfigError
from companion.config.shipped import FILES, named_file
from companion.config.yaml_strict import read_document
from companion.model.exit_codes import EXIT_OK

WORLD, RESULT = "identified_world.yaml", "identified.json"
"""Names of the files that the command writes."""


def add_parser(commands: Any) -> None:
    identify = commands.add_parser(
        "identify",
        help="find the parameters of a machine in a flight's log; write a world fitted to it",
        description="Find what one flight shows of the machine and of the room, each value with its 95 % interval: hover thrust, "
        "lags, bandwidth, delays, drag, joint friction, payload. Prints a change to the vehicle file and writes a world file.",
    )
    identify.add_argument("log", type=Path, help="flight.mcap")
    identify.add_argument(
        "--vehicle", metavar="FILE", help="vehicle file to change (default: the one that the flight was flown with)"
    )
    identify.add_argument("--out", metavar="DIR", help=f"folder for {WORLD} and {RESULT} (default: that of the log)")
    identify.add_argument(
        "--apply", action="store_true", help="write the change into the vehicle file; the old file is kept beside it"
    )
    identify.add_argument(
        "--json", action="store_true", help="print only the result, as JSON; write files only with --out"
    )
    identify.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Identify, write the files and print; return the exit code.

    Raises:
        ConfigError: the vehicle file or the folder cannot be used.
    """
    from companion.commissioning.identify.identification import identify
    from companion.commissioning.identify.proposal import HOVER_THRUST, vehicle_changes, world_text
    from companion.commissioning.identify.samples import read_part
    from companion.commissioning.patch import propose

    try:
        log, part = read_part(arguments.log)
        found = identify(log)
        log.report_missing_end()
    except LogError as error:
        raise ConfigError(str(error)) from None
    vehicle_file = _vehicle_file(arguments, found.flight.vehicle_file)
    changes = vehicle_changes(found)
    left_to_px4 = None
    if vehicle_file is not None and read_document(vehicle_file).find(HOVER_THRUST) is None:
        left_to_px4 = changes.pop(HOVER_THRUST, None)
    patch = propose(vehicle_file, changes) if vehicle_file is not None and changes else None
    folder = Path(arguments.out) if arguments.out is not None else None if arguments.json else arguments.log.parent
    world = world_text(found, str(arguments.log))
    document = {
        "schema_version": 1,
        "log": str(arguments.log),
        "ticks": None if part is None else [part.start, part.stop - 1],
        "quantities": [one.as_json() for one in found.quantities],
        "patch": patch.as_json() if patch else None,
        "world": str(folder / WORLD) if folder is not None else None,
    }
    if folder is not None:
        _write(folder, {WORLD: world, RESULT: json.dumps(document, indent=2, allow_nan=False) + "\n"})
    backup = patch.write() if patch and arguments.apply else None
    if arguments.json:
        print(json.dumps({**document, "backup": str(backup) if backup else None}, allow_nan=False))
        return EXIT_OK
    if part is not None:
        print(f"long flight: ticks {part.start} to {part.stop - 1} were used")
    for one in found.quantities:
        print(one.line())
    print()
    if left_to_px4 is not None:
        print(f"PX4: set MPC_THR_HOVER to {left_to_px4}; the vehicle file leaves the hover thrust to PX4")
    if patch:
        print(patch.text)
        kept = f"written; the old file is kept as {backup}" if backup else "not written; add --apply to write it"
        print(kept)
    elif changes:
        print("the vehicle file of this flight is not here; name one with --vehicle to see what should change in it")
    else:
        print("the vehicle file contradicts no interval; nothing to change")
    if folder is not None:
        print(f"{folder / WORLD}: the laboratory, fitted to this flight; use it with --world {folder / WORLD}")
    return EXIT_OK


def _vehicle_file(arguments: argparse.Namespace, flown: Path | None) -> Path | None:
    if arguments.vehicle is not None and not arguments.vehicle.strip():
        raise ConfigError("companion identify: --vehicle: expected the name of a file, got an empty one")
    path = named_file("vehicles", arguments.vehicle, "--vehicle") if arguments.vehicle is not None else flown
    if path is None or (arguments.vehicle is None and not path.is_file()):
        if arguments.apply:
            raise ConfigError(
                "companion identify: --apply: the vehicle file of this flight is not here; add --vehicle FILE"
            )
        return None
    if arguments.apply and path.resolve().is_relative_to(FILES.resolve()):
        raise ConfigError(
            f"companion identify: --apply: {path} is part of the installation; name your own vehicle file with --vehicle "
            "(companion init DIR writes copies of all files)"
        )
    return path


def _write(folder: Path, files: dict[str, str]) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"companion identify: --out {folder}: cannot be written: {error.strerror or error}") from None
