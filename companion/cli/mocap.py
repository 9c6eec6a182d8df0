"""`companion mocap check|align`: check the motion-capture stream and find its axes."""

from __future__ import annotations

from typing import Any

from companion.commissioning.tool import add_tool, number
from companion.config.shipped import DEFAULT_MISSION

_TOOLS = "companion.commissioning.mocap.tools"


def add_parser(commands: Any) -> None:
    """Add `mocap` to the sub-parsers of `companion`."""
    mocap = commands.add_parser("mocap", help="motion capture: check the stream, find its axes")
    parts = mocap.add_subparsers(dest="part", required=True, metavar="PART")
    check = add_tool(
        parts, "check", _TOOLS,
        help="check the stream: server, bodies, rate, jitter, latency and lost frames",
        description="Watch motion capture and report problems. Nothing moves; PX4 is not needed. Exit 0: no problem; 3: "
        "a problem was found.",
    )  # fmt: skip
    check.add_argument(
        "--seconds", type=number(1.0, 600.0, " s"), default=10.0, metavar="N", help="duration (default: 10)"
    )
    check.add_argument(
        "--move", action="store_true", help="identify the vehicle's rigid body, while you carry the vehicle"
    )
    align = add_tool(
        parts, "align", _TOOLS,
        help="find the axes by moving the vehicle: lift, forward, turn left",
        description="Run the guided hand test and report what is wrong with the axes. The battery must be connected, "
        "the vehicle disarmed and the propellers removed. Exit 0: the axes are right; 3: they are not; 4: cancelled.",
    )  # fmt: skip
    align.add_argument(
        "mission",
        nargs="?",
        default=DEFAULT_MISSION,
        help=f"mission whose start defines the yaw (default: {DEFAULT_MISSION})",
    )
