"""`companion latency`: measure the delay of motion capture to PX4 by tapping the airframe."""

from __future__ import annotations

from typing import Any

from companion.commissioning.tool import add_tool, number


def add_parser(commands: Any) -> None:
    latency = add_tool(
        commands, "latency", "companion.commissioning.latency.tools",
        help="measure the delay of motion capture (EKF2_EV_DELAY) by tapping the airframe",
        description="Hold the vehicle up, disarmed, propellers off, while a second person taps its frame. IMU and "
        "motion capture are compared. Exit 0: EKF2_EV_DELAY is right; 3: it is wrong or could not be "
        "measured.",
        write="write EKF2_EV_DELAY to PX4, which must then be restarted",
    )  # fmt: skip
    latency.add_argument(
        "--taps", type=number(5, 60, "", int), default=8, metavar="N", help="number of taps (default: 8)"
    )
    latency.add_argument(
        "--seconds", type=number(5.0, 600.0, " s"), default=90.0, metavar="N", help="timeout for the taps (default: 90)"
    )
