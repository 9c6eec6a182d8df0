"""`companion export`: write logs as CSV or Parquet tables, as a LeRobot dataset, or as one file for Foxglove."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from companion import DISTRIBUTION
from companion.analysis.export import write_lerobot, write_tables
from companion.analysis.log import TICKS_KEPT, FlightLog, LogError
from companion.cli.report import names_of
from companion.config.document import ConfigError
from companion.model.exit_codes import EXIT_OK
from companion.recorder.viewer_file import write_viewer_file

_TICKS_MIN = 500
"""Ticks of each of many logs that are kept in memory."""


def add_parser(commands: Any) -> None:
    export = commands.add_parser(
        "export",
        help="write logs as CSV or Parquet tables, as a LeRobot dataset, or as one file for Foxglove",
        description="csv, parquet: one table for each of inputs, outputs, sent and events, and columns.json with units and rates. "
        "lerobot: one dataset (v3.0) with an episode for each log. foxglove: one file in which Foxglove shows the flights of all logs "
        "in one scene, such as those of a team.",
    )
    export.add_argument("log", type=Path, nargs="+", help="flight.mcap")
    export.add_argument("--format", choices=("csv", "parquet", "lerobot", "foxglove"), required=True)
    export.add_argument(
        "--out",
        type=Path,
        metavar="PATH",
        help="folder to write to; foxglove: the file (default: csv, parquet: that of the log; several logs get a folder each)",
    )
    export.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read and write the logs; return the exit code.

    Raises:
        ConfigError: one line that says what the user must change.
    """
    paths: list[Path] = arguments.log
    out: Path | None = arguments.out
    ticks_max = max(_TICKS_MIN, TICKS_KEPT // len(paths))
    try:
        if arguments.format == "lerobot":
            if out is None:
                raise ConfigError("companion export: --format lerobot needs --out, the folder of the dataset")
            logs = [FlightLog.read(path, ticks_max=ticks_max) for path in paths]
            frames = write_lerobot(logs, out)
            _report_ends(logs)
            print(f"{out}: {len(paths)} episodes, {frames} frames")
            return EXIT_OK
        if arguments.format == "foxglove":
            if out is None:
                raise ConfigError(
                    "companion export: --format foxglove needs --out, the file to write, such as both.mcap"
                )
            out.parent.mkdir(parents=True, exist_ok=True)
            logs = [FlightLog.read(path, ticks_max=ticks_max) for path in paths]
            write_viewer_file(dict(zip(names_of(paths), logs, strict=True)), out)
            _report_ends(logs)
            print(out)
            return EXIT_OK
        for path, name in zip(paths, names_of(paths), strict=True):
            folder = path.parent if out is None else out / name if len(paths) > 1 else out
            log = FlightLog.read(path, ticks_max=TICKS_KEPT)
            for written in write_tables(log, folder, arguments.format):
                print(written)
            _report_ends([log])
    except LogError as error:
        raise ConfigError(str(error)) from None
    except ImportError:
        raise ConfigError(f"companion export: needs pandas and pyarrow: pip install '{DISTRIBUTION}[pandas]'") from None
    except OSError as error:
        if error.filename is None:
            raise  # of standard output
        raise ConfigError(f"companion export: {error.filename}: cannot be written: {error.strerror}") from None
    return EXIT_OK


def _report_ends(logs: list[FlightLog]) -> None:
    for log in logs:
        log.report_missing_end()
