"""The commands: fly, check, schema, sitl, report, replay."""

from __future__ import annotations

import argparse
import datetime
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from companion.config.document import ConfigError
from companion.config.loader import FlightConfig, load_flight
from companion.config.schema import schema_json
from companion.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from companion.mission.check import check_mission


class _Parser(argparse.ArgumentParser):
    """argparse, with one line per mistake."""

    def error(self, message: str) -> None:  # type: ignore[override]
        sys.stderr.write(f"{self.prog}: {message}; see {self.prog} --help\n")
        sys.exit(EXIT_BAD_INPUT)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of `companion`."""
    arguments = _parser().parse_args(_normalised(list(sys.argv[1:] if argv is None else argv)))
    try:
        code: int = arguments.run(arguments)
    except ConfigError as error:
        for line in error.lines:
            print(line, file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:
        return EXIT_OK
    return code


def _normalised(argv: list[str]) -> list[str]:
    """`--sitl` without a value becomes `--sitl=stub`; `--set a=1 b=2` becomes one `--set` each."""
    out: list[str] = []
    in_set = False
    for word in argv:
        if word == "--sitl":
            out.append("--sitl=stub")
            in_set = False
        elif in_set and "=" in word and not word.startswith("-"):
            out += ["--set", word] if out[-1] != "--set" else [word]
        else:
            if in_set and out[-1] == "--set":
                out.append(word)  # no KEY=VALUE: the loader says so
                in_set = False
                continue
            in_set = word == "--set"
            out.append(word)
    return out


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="companion", description="Flies an aerial manipulator on PX4 with adaptive impedance control."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    fly = commands.add_parser("fly", help="fly a mission", description="Fly a mission, on the vehicle or in SITL.")
    _add_flight_options(fly)
    fly.add_argument("--sitl", metavar="stub", help="fly in the simulated world")
    fly.add_argument("--out", type=Path, metavar="DIR", help="where log and report go (default: flights/TIME-MISSION)")
    fly.set_defaults(run=_fly)

    check = commands.add_parser("check", help="check a mission without flying it")
    _add_flight_options(check)
    check.set_defaults(run=_check)

    schema = commands.add_parser("schema", help="print the JSON Schema of a file, for editors")
    schema.add_argument("kind", choices=("mission", "vehicle", "controller", "world"))
    schema.set_defaults(run=lambda a: print(schema_json(a.kind)) or EXIT_OK)

    sitl = commands.add_parser("sitl", help="run the simulated world alone, for QGroundControl or a script of your own")
    _add_flight_options(sitl, mission_default=True)
    sitl.set_defaults(run=_sitl)

    report = commands.add_parser("report", help="make summary and report of a log again")
    report.add_argument("log", type=Path)
    report.add_argument("--out", type=Path, metavar="DIR", help="default: beside the log")
    report.set_defaults(run=_report)

    replay = commands.add_parser(
        "replay", help="run the core on a log's inputs; exit 0 if every output is bit-identical"
    )
    replay.add_argument("log", type=Path)
    replay.set_defaults(run=_replay)
    return parser


def _add_flight_options(parser: argparse.ArgumentParser, mission_default: bool = False) -> None:
    if mission_default:
        parser.add_argument("mission", nargs="?", default="configs/missions/catch.yaml")
    else:
        parser.add_argument("mission", help="mission file, YAML")
    parser.add_argument("--vehicle", metavar="FILE", help="vehicle file instead of the mission's")
    parser.add_argument("--controller", metavar="LAW", help="control law: adaptive")
    parser.add_argument("--preset", metavar="NAME", help="gains: paper or recommended")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE", help="e.g. world.payload_kg=0.3"
    )


def _load(arguments: argparse.Namespace) -> FlightConfig:
    return load_flight(
        arguments.mission, arguments.vehicle, arguments.controller, arguments.preset, arguments.overrides
    )


def _problems(config: FlightConfig) -> list[str]:
    return check_mission(config.mission, config.vehicle, phase_origins=config.sources.phases)


def _check(arguments: argparse.Namespace) -> int:
    config = _load(arguments)
    problems = _problems(config)
    for line in problems:
        print(line, file=sys.stderr)
    if problems:
        return EXIT_BAD_INPUT
    print(f"{arguments.mission}: mission {config.mission.name!r} can be flown by {config.vehicle.name}")
    return EXIT_OK


def _fly(arguments: argparse.Namespace) -> int:
    from companion.flight import run_flight

    if arguments.sitl not in (None, "stub"):
        print(f"companion fly: --sitl={arguments.sitl}: expected --sitl or --sitl=stub", file=sys.stderr)
        return EXIT_BAD_INPUT
    config = _load(arguments)
    problems = _problems(config)
    if problems:
        for line in problems:
            print(line, file=sys.stderr)
        return EXIT_BAD_INPUT
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    out = arguments.out or Path("flights") / f"{stamp}-{config.mission.name}"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"companion fly: --out {out}: {error.strerror}", file=sys.stderr)
        return EXIT_BAD_INPUT
    if (out / "flight.mcap").exists():
        print(f"companion fly: --out {out}: there is a flight.mcap already; choose another folder", file=sys.stderr)
        return EXIT_BAD_INPUT
    return run_flight(config, out, sitl=arguments.sitl is not None, console=Console())


def _sitl(arguments: argparse.Namespace) -> int:
    config = _load(arguments)
    with tempfile.NamedTemporaryFile("w", suffix=".json", encoding="utf-8") as file:
        file.write(config.model_dump_json())
        file.flush()
        process = subprocess.Popen([sys.executable, "-m", "sitl", "--config", file.name])
        while True:
            try:
                return process.wait()
            except KeyboardInterrupt:
                continue  # the world got it too and ends by itself


def _report(arguments: argparse.Namespace) -> int:
    from companion.analysis.log import LogError
    from companion.flight import report_again

    try:
        report = report_again(arguments.log, arguments.out or arguments.log.parent)
    except LogError as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    if report is None:
        print("companion report: plots need matplotlib: pip install 'companion[analysis]'", file=sys.stderr)
        return EXIT_REFUSED
    print(report)
    return EXIT_OK


def _replay(arguments: argparse.Namespace) -> int:
    from companion.analysis import replay

    return replay.run(arguments.log)


if __name__ == "__main__":
    sys.exit(main())
