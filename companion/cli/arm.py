"""`companion arm scan|setup|zero|jog|friction`: from servos out of their boxes to an arm whose numbers are measured."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from companion.cli.px4 import VEHICLE
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.vehicle import Vehicle
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_REFUSED
from companion.runtime.console import tell

Tool = Callable[[argparse.Namespace, Vehicle], int]


def add_parser(commands: Any) -> None:
    """Add `arm` to the sub-parsers of `companion`."""
    arm = commands.add_parser("arm", help="commission the arm: find, set up, zero, move and measure its servos")
    parts = arm.add_subparsers(dest="part", required=True, metavar="PART")

    scan = parts.add_parser(
        "scan",
        help="find every servo on the bus",
        description="Find every servo at every baud rate and compare it with the vehicle file. Nothing is written to the servos, "
        "nothing gets torque. Exit code 0: all is as the vehicle file says, 3: something is not.",
    )
    _add_common(scan)
    scan.add_argument(
        "--baud", type=int, metavar="RATE", help="look at this baud rate alone, which takes a second (default: at all)"
    )
    scan.set_defaults(tool="scan")

    setup = parts.add_parser(
        "setup",
        help="set the servos up: id, baud rate, return delay, mode, limits",
        description="Bring each servo to what the companion wants. Torque is off; what is written is shown before, asked for, and read "
        "back. Exit code 0: all is set up, 3: not.",
    )
    _add_common(setup)
    _add_yes(setup)
    setup.add_argument(
        "--joint", type=_joint, metavar="N", help="the one servo that is connected is that of joint 1 or 2"
    )
    setup.set_defaults(tool="setup")

    zero = parts.add_parser(
        "zero",
        help="find zeros and directions: hold the arm by hand in three poses",
        description="No torque. Hold the arm by hand in three poses; finds zero_count and sign of both joints, and servos in each "
        "other's joint. A pose counts when it is held still for 2 s, or at Enter.",
    )
    _add_common(zero)
    zero.set_defaults(tool="zero")

    jog = parts.add_parser(
        "jog",
        help="move one joint, slowly, by keys",
        description="Move one joint at a time, at most 20 deg/s, within the walls. It stops when the key is released, and when "
        "anything is in the way. Afterwards the arm is limp: hold it.",
    )
    _add_common(jog, write=False)
    _add_yes(jog)
    jog.add_argument("--joint", type=_joint, metavar="N", help="with --to: joint 1 or 2")
    jog.add_argument("--to", type=float, metavar="DEG", help="move it there, without keys")
    jog.set_defaults(tool="jog")

    friction = parts.add_parser(
        "friction",
        help="measure torque constant and friction of both joints",
        description="Sweep each joint slowly both ways about hanging, and fit torque constant, dry and viscous friction against "
        "gravity. The arm has to hang free.",
    )
    _add_common(friction)
    _add_yes(friction)
    friction.set_defaults(tool="friction")
    arm.set_defaults(run=run)


def _add_common(parser: argparse.ArgumentParser, *, write: bool = True) -> None:
    parser.add_argument("--vehicle", metavar="FILE", default=VEHICLE, help=f"vehicle file (default: {VEHICLE})")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="e.g. vehicle.devices.arm.port=/dev/ttyUSB0",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON, nothing else on standard output")
    if write:
        parser.add_argument(
            "--write", action="store_true", help="write the proposed change into the vehicle file, a backup beside it"
        )


def _add_yes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--yes", action="store_true", help="do not ask")


def _joint(text: str) -> int:
    if text not in ("1", "2"):
        raise argparse.ArgumentTypeError(f"expected 1 (shoulder) or 2 (elbow), got '{text}'")
    return int(text) - 1


def run(arguments: argparse.Namespace) -> int:
    """The command; returns the exit code.

    Raises:
        ConfigError: the vehicle file or an option is wrong.
    """
    if not str(arguments.vehicle).strip():
        raise ConfigError([f"companion arm {arguments.part}: --vehicle: expected the name of a file, got an empty one"])
    vehicle = load_vehicle(arguments.vehicle, arguments.overrides)
    try:
        return _tool(arguments.tool)(arguments, vehicle)
    except DeviceError as error:
        tell(error)
        return EXIT_REFUSED


def _tool(name: str) -> Tool:
    """Loaded when it is used: most commands need no servo."""
    if name in ("scan", "setup"):
        from companion.commissioning.arm import bus_tools as arm_bus_tools

        return arm_bus_tools.run_scan if name == "scan" else arm_bus_tools.run_setup
    if name == "zero":
        from companion.commissioning.arm import zero_tool as arm_zero_tool

        return arm_zero_tool.run_zero
    from companion.commissioning.arm import motion_tools as arm_motion_tools

    return arm_motion_tools.run_jog if name == "jog" else arm_motion_tools.run_friction
