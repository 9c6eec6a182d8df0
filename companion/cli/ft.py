"""`companion ft check|tare`: check the force sensor, with a known weight if given, and measure its drift and bias."""

from __future__ import annotations

from typing import Any

from companion.commissioning.tool import add_tool, number

_TOOLS = "companion.commissioning.force_torque.tools"


def add_parser(commands: Any) -> None:
    ft = commands.add_parser("ft", help="check the force sensor with a known weight; measure its drift and bias")
    parts = ft.add_subparsers(dest="part", required=True, metavar="PART")
    check = add_tool(
        parts, "check", _TOOLS,
        help="check rate, noise and bias; with a known weight also scale and direction",
        description="Measure the force sensor at rest and, with --weight, with a known weight on the net. The arm hangs limp. Exit 0: "
        "no problem; 3: a problem was found.",
    )  # fmt: skip
    check.add_argument(
        "--weight", type=number(0.1, 5.0, " kg"), metavar="KG", help="mass that you hang on the net when prompted"
    )
    tare = add_tool(
        parts, "tare", _TOOLS, write="",
        help="measure the drift over a minute, and the bias that the tare at the start of a flight would remove",
        description="Measure with an empty net. Nothing is written to the sensor without --sensor or --clear. Exit 0: no problem; 3: "
        "a problem was found; 4: cancelled.",
    )  # fmt: skip
    tare.add_argument(
        "--seconds", type=number(5.0, 600.0, " s"), default=60.0, metavar="N", help="duration (default: 60)"
    )
    what = tare.add_mutually_exclusive_group()
    what.add_argument("--sensor", action="store_true", help="then set the sensor's own zero to the current reading")
    what.add_argument("--clear", action="store_true", help="first clear the sensor's own zero")
    for part in (check, tare):
        part.add_argument(
            "--arm-pose",
            metavar="A1,A2",
            help="joint angles in deg, used instead of reading the servos; at 90,0 the arm hangs straight down",
        )
