"""`companion arm scan|setup|zero|jog|friction|reboot`: commission the arm."""

from __future__ import annotations

import argparse
from typing import Any

from companion.commissioning.tool import add_tool

_TOOLS = "companion.commissioning.arm.tools"


def add_parser(commands: Any) -> None:
    arm = commands.add_parser("arm", help="commission the arm: find, set up, zero, move and measure its servos")
    parts = arm.add_subparsers(dest="part", required=True, metavar="PART")
    scan = add_tool(
        parts, "scan", _TOOLS, yes=False,
        help="find every servo on the bus",
        description="Find every servo at every baud rate and compare it with the vehicle file. Nothing is written to "
        "the servos; torque stays off. Exit 0: everything matches the vehicle file; 3: something "
        "differs.",
    )  # fmt: skip
    scan.add_argument(
        "--baud", type=int, metavar="RATE", help="try only this baud rate; takes one second (default: all)"
    )
    setup = add_tool(
        parts, "setup", _TOOLS,
        help="set up the servos: id, baud rate, return delay, mode, limits",
        description="Write the required settings to each servo. Torque is off; you see and confirm the values, which "
        "are then written and read back. Exit 0: all servos are set up; 3: not all are.",
    )  # fmt: skip
    setup.add_argument(
        "--joint", type=_joint, metavar="N", help="joint to which the only connected servo belongs, from 1"
    )
    add_tool(
        parts, "zero", _TOOLS, yes=False,
        help="find zeros and directions: hold the arm by hand in three poses",
        description="Torque is off. Hold the arm by hand in three poses, to find zero_count and sign of every joint "
        "and whether the servos are interchanged. A pose is accepted when it is held still for 2 s, or "
        "on Enter.",
    )  # fmt: skip
    jog = add_tool(
        parts, "jog", _TOOLS, write="",
        help="move one joint slowly with keys",
        description="Move one joint at a time, at up to 20 deg/s, within the joint limits. It stops as soon as you release "
        "the key or it meets an obstacle. Afterwards the arm is limp: hold it.",
    )  # fmt: skip
    jog.add_argument("--joint", type=_joint, metavar="N", help="with --to: joint to move, from 1")
    jog.add_argument("--to", type=float, metavar="DEG", help="move to this angle instead of using keys")
    add_tool(
        parts, "friction", _TOOLS,
        help="measure torque constant and friction of every joint",
        description="Sweep each joint slowly in both directions about the hanging pose, and fit its torque constant and "
        "its dry and viscous friction, with gravity as the reference torque. The arm must hang freely.",
    )  # fmt: skip
    add_tool(
        parts, "reboot", _TOOLS, write="",
        help="reboot the servos, which clears hardware errors",
        description="Reboot every servo of the arm: torque goes off, so that the arm drops, and hardware errors are cleared. "
        "Remove the cause first. Exit 0: no servo has an error; 3: an error remains or a servo does not answer.",
    )  # fmt: skip


def _joint(text: str) -> int:
    if text not in list("1234567"):
        raise argparse.ArgumentTypeError(f"expected 1 (shoulder), 2 (elbow) or a later joint up to 7, got '{text}'")
    return int(text) - 1
