"""`companion report`: write summary and report of a log, or one side-by-side page for several logs."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion import DISTRIBUTION
from companion.analysis.contact import PROBE, contact_lines, write_probe
from companion.analysis.log import FlightLog, LogError
from companion.analysis.summary import summarise, write_summary
from companion.campaigns.runner import no_plots, to_json
from companion.campaigns.side_by_side.comparison import FLIGHTS_MAX, Comparison, NotAlignable, compare, jsonable
from companion.campaigns.side_by_side.flight import Flight, flight_of
from companion.config.document import ConfigError
from companion.model.exit_codes import EXIT_OK, EXIT_REFUSED
from companion.model.types import Outcome
from companion.runtime.console import print_error

PAGE = "side_by_side.html"
RESULT = "side_by_side.json"
_ANOTHER = "is the summary of another flight; outcome and payload are unknown"
_NAME_BYTES_MAX = 200
"""Longest name of a folder that is named after flights, in bytes; file systems allow 255."""


def add_parser(commands: Any) -> None:
    report = commands.add_parser(
        "report",
        help="write summary and report of a log, or compare several flights side by side",
        description=f"One log: write its summary and report again. Two to {FLIGHTS_MAX} logs: write one page with "
        "the missions, the settings that differ, all metrics, and plots that overlay all flights.",
    )
    report.add_argument(
        "log", type=Path, nargs="+", help="flight.mcap; several logs are compared with the first, side by side"
    )
    report.add_argument(
        "--out",
        metavar="DIR",
        help="folder to write to (default: that of the log; for several logs a new folder reports/A-vs-B)",
    )
    report.add_argument(
        "--align",
        choices=("catch", "takeoff", "start"),
        help="several logs: zero of the common time axis (default: the catch if all flights have one, else take-off)",
    )
    report.add_argument(
        "--gif",
        type=Path,
        metavar="FILE",
        help="one log: also write the animation of report.html as a GIF, 800 pixels wide",
    )
    report.add_argument(
        "--json", action="store_true", help="print only the summary or comparison, as JSON; write files only with --out"
    )
    report.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read and evaluate the logs, and write the report; return the exit code.

    Raises:
        ConfigError: one line that says what the user must change.
    """
    logs: list[Path] = arguments.log
    if arguments.out is not None and not arguments.out.strip():
        raise _refusal("--out: expected the name of a folder, got an empty one")
    if len(logs) > FLIGHTS_MAX:
        raise _refusal(f"{len(logs)} logs: expected at most {FLIGHTS_MAX}: more cannot be distinguished in one plot")
    if arguments.align is not None and len(logs) == 1:
        raise _refusal("--align: expected two or more logs, got one")
    if arguments.gif is not None and len(logs) > 1:
        raise _refusal(f"--gif: expected one log, got {len(logs)}")
    try:
        return _one(logs[0], arguments) if len(logs) == 1 else _several(logs, arguments)
    except (LogError, NotAlignable) as error:
        raise ConfigError(str(error)) from None


def _refusal(text: str) -> ConfigError:
    return ConfigError(f"companion report: {text}")


# One flight


@dataclass(frozen=True)
class Graded:
    """A log with the summary that the launcher would have written."""

    log: FlightLog
    summary: dict[str, Any]
    note: str | None
    """Why the summary beside the log was not used; None if it was used."""


def graded(path: Path) -> Graded:
    """Read and evaluate a log. Values that only the flight's launcher knew come from the summary beside the log.

    Raises:
        LogError: the file is not a log.
    """
    from companion.launcher.run import TICKS_MAX, autopilot_of

    log = FlightLog.read(path, ticks_max=TICKS_MAX)
    own = summarise(log, outcome=Outcome.LOST.value, controller="", preset="")
    known, note = _known(path.parent / "summary.json", own)
    summary = own | {
        "outcome": known.get("outcome") or (log.outcome or Outcome.LOST).value,
        "controller": _setting(log, "law"),
        "preset": _setting(log, "preset"),
        "payload_kg": known.get("payload_kg"),
        "recorder": {**own["recorder"], **(known.get("recorder") or {})},
        "world": known.get("world"),
        "autopilot": known.get("autopilot") or autopilot_of(log, {}),
    }
    # The guardian acts after the last tick, so its events are not in the core's outputs.
    recorded_ids = {event["id"] for event in summary["events"]}
    summary["events"] = summary["events"] + [e for e in known.get("events", ()) if e["id"] not in recorded_ids]
    return Graded(log, summary, note)


def _known(path: Path, own: dict[str, Any]) -> tuple[dict[str, Any], str | None]:
    """Return the summary beside the log, and a note if it is not used: the summary beside a copied log may be another flight's."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}, None
    except (OSError, ValueError) as error:
        return {}, f"{path}: cannot be read ({error}); outcome and payload are unknown"
    try:
        times = {event["t_s"] for event in known["events"]}
        same = known["loop"]["ticks"] == own["loop"]["ticks"] and times >= {event["t_s"] for event in own["events"]}
    except (KeyError, TypeError):
        return {}, f"{path}: is not the summary of a flight; outcome and payload are unknown"
    return (known, None) if same else ({}, f"{path}: {_ANOTHER}")


def _setting(log: FlightLog, name: str) -> str:
    controller = log.config.get("controller")
    value = controller.get(name) if isinstance(controller, dict) else None
    return str(value or log.metadata.get("flight", {}).get(name) or "unknown")


def _one(path: Path, arguments: argparse.Namespace) -> int:
    from companion.launcher.run import report_of

    flight = graded(path)
    out = path.parent if arguments.out is None else Path(arguments.out)
    writes = arguments.out is not None or not arguments.json
    if writes and (_known(out / "summary.json", flight.summary)[1] or "").endswith(_ANOTHER):
        raise _refusal(f"{out}: its summary.json is of another flight; choose another folder with --out")
    if flight.note is not None:
        print_error(flight.note)
    flight.log.report_missing_end()
    if arguments.gif is not None:
        _write_gif(flight, arguments.gif)
    if arguments.json:
        sys.stdout.write(to_json(flight.summary))
        if not writes:
            return EXIT_OK
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_summary(flight.summary, out / "summary.json")
        write_probe(flight.log, out / PROBE)
        report = report_of(flight.log, flight.summary, out)
    except OSError as error:
        raise _unwritable(out, error) from None
    if report is None:
        return _no_pictures()
    if not arguments.json:
        for name, text in contact_lines(flight.summary):
            print(f"{name}: {text}")
        print(report)
        if arguments.gif is not None:
            print(arguments.gif)
    return EXIT_OK


def _write_gif(flight: Graded, path: Path) -> None:
    try:
        from companion.analysis.animation import movie_of, write_gif
    except ImportError:
        raise _refusal(f"--gif needs matplotlib: pip install '{DISTRIBUTION}[analysis]'") from None
    movie = movie_of(flight.log, flight.summary)
    if movie is None:
        raise _refusal(
            f"{flight.log.path}: the vehicle did not take off, or the log lacks its geometry: no animation was made"
        )
    try:
        write_gif(movie, path)
    except (OSError, ValueError) as error:
        raise _refusal(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from None


# Several flights


def _several(paths: Sequence[Path], arguments: argparse.Namespace) -> int:
    flights: list[Flight] = []
    for n, (path, name) in enumerate(zip(paths, names_of(paths), strict=True)):
        flight = graded(path)
        if flight.note is not None:
            print_error(flight.note)
        flights.append(flight_of(chr(ord("A") + n), name, str(path), _digest(path), flight.log, flight.summary))
        del flight  # one log at a time: the ticks of a long one take half a GB
    comparison = compare(flights, arguments.align)
    out = _folder(arguments.out, flights)
    if arguments.json:
        sys.stdout.write(to_json(jsonable(comparison)))
        if arguments.out is None:
            return EXIT_OK
    try:
        page = write_page(comparison, out)
    except OSError as error:
        raise _unwritable(out, error) from None
    except ImportError:
        return _no_pictures()
    for line in comparison.cautions:
        print_error(line)
    if not arguments.json:
        print(page)
    return EXIT_OK


def write_page(comparison: Comparison, out: Path) -> Path:
    """Write side_by_side.html, its pictures as PNG and side_by_side.json into `out`; return the path of the page.

    Raises:
        ImportError: matplotlib is missing.
        OSError: a file cannot be written.
    """
    from companion.campaigns.side_by_side.page import write_html
    from companion.campaigns.side_by_side.plots import write_pictures

    out.mkdir(parents=True, exist_ok=True)
    (out / RESULT).write_text(to_json(jsonable(comparison)), encoding="utf-8")
    write_html(comparison, write_pictures(comparison, out), out / PAGE)
    return out / PAGE


def names_of(paths: Sequence[Path]) -> list[str]:
    """Return a distinct name for each flight: its folder, or its file if that is not called flight.mcap."""
    own = [path.resolve().parent.name if path.name == "flight.mcap" else path.stem for path in paths]
    if len(set(own)) < len(own) and len({path.resolve() for path in paths}) == len(paths):
        own = [f"{path.resolve().parent.parent.name}/{name}" if path.name == "flight.mcap" else
               f"{path.resolve().parent.name}/{name}" for path, name in zip(paths, own, strict=True)]  # fmt: skip
    own = [
        name.encode(errors="replace").decode() for name in own
    ]  # a folder's name may be no text, which no page holds
    return [name if own.count(name) == 1 else f"{name} ({own[: n + 1].count(name)})" for n, name in enumerate(own)]


def _folder(asked: str | None, flights: Sequence[Flight]) -> Path:
    """Return the output folder; reject one that contains a report of other flights."""
    digests = [flight.digest for flight in flights]
    if asked is not None:
        folder = Path(asked)
        if _holds_others(folder, digests):
            raise _refusal(f"--out {folder}: already contains a {RESULT} of other flights; choose another folder")
        return folder
    name = "-vs-".join(flight.name.replace("/", "-") for flight in flights)
    if len(name.encode()) > _NAME_BYTES_MAX:
        name = name.encode()[: _NAME_BYTES_MAX - 4].decode(errors="ignore")
    folder, n = Path("reports") / name, 1
    while _holds_others(folder, digests):
        n += 1
        folder = Path("reports") / f"{name}-{n}"
    return folder


def _holds_others(folder: Path, digests: list[str]) -> bool:
    try:
        held = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        return [flight["sha256"] for flight in held["flights"]] != digests
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError, KeyError, TypeError):
        return True


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def _unwritable(out: Path, error: OSError) -> ConfigError:
    return _refusal(f"{out}: cannot be written: {error.strerror}; choose another folder with --out")


def _no_pictures() -> int:
    print_error(no_plots("report"))
    return EXIT_REFUSED
