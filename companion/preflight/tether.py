"""Rows on the safety tether as described in the vehicle file. No sensor measures the tether; the operator compares the rows with
it. Pure functions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from companion.config.tether import Tether
from companion.config.vehicle import Vehicle
from companion.model.best_pose import last_pose
from companion.model.check_row import Row
from companion.model.frames import quat_rotate
from companion.model.observations import Observations
from companion.preflight.checks import Check
from companion.safety.tether_shape import Clearance

LINE = Check(
    "tether.line",
    "tether as described",
    "shown for comparison with the real tether; a vehicle without `tether` only warns",
    "every distance to the taut sphere is computed from it",
)
STRENGTH = Check(
    "tether.strength",
    "tether strength",
    "`tether.load_rating_n` is at least the full thrust",
    "the tether must not break",
)
SLACK = Check(
    "tether.slack",
    "tether slack at the start",
    "`tether.margin_m` or more at the vehicle's position",
    "a taut tether tips the vehicle over at take-off",
)
ARM = Check(
    "tether.arm",
    "tether and arm",
    "the tether is tied outside the space that the arm sweeps; otherwise its clearance from the arm is not judged",
    "a slack line that hangs through the arm's sweep can catch arm or net, and neither mission check nor `tether_near` sees it",
    warns=True,
)
CHECKS = (LINE, STRENGTH, SLACK, ARM)


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of the tether, or one warning if the vehicle has none."""
    tether, airframe = vehicle.tether, vehicle.airframe
    if tether is None:
        fix = "add tether to the vehicle file if the vehicle is tethered; without it, only the room limits the flight"
        yield LINE.doubtful("none; slack, tension, winding and clearance of a tether are not monitored", "", fix)
        return
    x, y, z = tether.anchor_world_m
    ax, ay, az = tether.attachment_body_m
    yield LINE.good(
        f"{tether.length_m:g} m, from the anchor at ({x:g}, {y:g}, {z:g}) m to ({ax:g}, {ay:g}, {az:g}) m on the body",
        "compare with a tape measure",
    )
    read, wanted = f"{tether.load_rating_n:g} N", f"{airframe.thrust_max_n:g} N (airframe.thrust_max_n)"
    fix = "use a stronger tether, and correct tether.load_rating_n"
    yield STRENGTH.row(tether.load_rating_n >= airframe.thrust_max_n, read, wanted, fix)
    if vehicle.arm.joints:
        yield _arm(vehicle, tether)
    pose = last_pose(o, external=vehicle.devices.mocap.external)
    if pose is None:
        return
    attachment = quat_rotate(pose.attitude_wxyz, tether.attachment_body_m)
    tied_m = [p + a for p, a in zip(pose.position_world_m, attachment, strict=True)]
    slack_m = tether.length_m - math.dist(tied_m, tether.anchor_world_m)
    read, wanted = f"{slack_m:.2f} m", f"{tether.margin_m:g} m or more"
    fix = "move the vehicle nearer to the anchor, or correct tether.length_m and tether.anchor_world_m"
    yield SLACK.row(slack_m >= tether.margin_m, read, wanted, fix)


def _arm(vehicle: Vehicle, tether: Tether) -> Row:
    clearance = Clearance(vehicle, tether)
    if clearance.judges_arm:
        return ARM.good("the clearance of the tether from the arm is judged", "")
    read = "the clearance of the tether from the arm is not judged: the tether is tied within the arm's sweep"
    if not clearance.arm_is_planar:
        return ARM.bad(read, "", "watch the line in flight; keep the arm folded where the line hangs below the vehicle")
    shoulder_y_m = vehicle.arm.first_joint_body_m[1]
    fix = (
        f"tie it more than {vehicle.tip_radius_m:g} m beside the arm's plane (y = {shoulder_y_m:g} m), on the anchor's side, and "
        "correct tether.attachment_body_m; otherwise watch the line in flight"
    )
    return ARM.bad(read, "", fix)
