"""`companion mocap check|align|pivot`: check the motion-capture stream, find its axes and the error of the pivot."""

from __future__ import annotations

import argparse
import math
from typing import Any

from companion.commissioning.tool import add_tool, number
from companion.config.shipped import DEFAULT_MISSION

_TOOLS = "companion.commissioning.mocap.tools"


def add_parser(commands: Any) -> None:
    mocap = commands.add_parser("mocap", help="motion capture: check the stream, find its axes and the pivot")
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
    pivot = add_tool(
        parts, "pivot", _TOOLS,
        help="how far the rigid body's pivot is off, from probes of a surface whose place is known",
        description="Compare probed surfaces with where they are, and print how to move the pivot. Three flights of a mission "
        "like probe: nose to the left, nose to the right, surface leaned. Exit 0: the pivot is right; 3: it is not.",
        write="", yes=False,
    )  # fmt: skip
    pivot.add_argument("flights", nargs="+", metavar="FLIGHT", help="folder of a flight that probed the surface")
    pivot.add_argument(
        "--plane", action="append", required=True, type=_plane, metavar="X,Y,Z,NX,NY,NZ",
        help="a point of the surface, m, and its normal out of it, world frame; once, or once for each flight",
    )  # fmt: skip


def _plane(text: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    try:
        x, y, z, nx, ny, nz = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = nx = ny = nz = math.nan
    length = math.hypot(nx, ny, nz)
    if not (math.isfinite(x + y + z + length) and length > 0.0):
        raise argparse.ArgumentTypeError(
            f"expected six numbers X,Y,Z,NX,NY,NZ, a normal that is not zero, got '{text}'"
        )
    return (x, y, z), (nx / length, ny / length, nz / length)
