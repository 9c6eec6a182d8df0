"""Evaluates a hand test: returns rows with the measurements, and names the axis that is wrong. Pure functions.

IMU measurements are in the vehicle's body frame (x forward, y left, z up), motion-capture measurements in the frame of its rigid
body. In a correct set-up both frames are the same.
"""

from __future__ import annotations

import math
from typing import Final

from companion.model.check_row import Row
from companion.model.frames import quat_rotate
from companion.model.types import Vec3
from companion.preflight.axes import ALL, IDENTITY, Y_UP, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.motion import Motion, angle_rad
from companion.preflight.hand_test.steps import HandResult

_ASTRAY = "the controller would push in the wrong directions"
DONE = Check("hand.done", "hand test", "every step is recognised", "the axes are not known")
AS_REQUESTED = Check(
    "hand.instructed",
    "hand test: as instructed",
    "the IMU measured up, forward and a turn to the left",
    "the vehicle was moved differently, or PX4's own axes are wrong",
)
LEVEL = Check("hand.level", "hand test: level", "gravity is vertical in the stream within 5 deg", _ASTRAY)
LIFT = Check("hand.lift", "hand test: up", "IMU and motion capture agree on the direction within 20 deg", _ASTRAY)
FORWARD = Check(
    "hand.forward",
    "hand test: forward",
    "IMU and motion capture agree within 20 deg, and within 12 deg about the vertical",
    "PX4 fuses this yaw and cannot detect that it is wrong: the vehicle would circle or fly away",
)
TURN = Check(
    "hand.turn",
    "hand test: turn",
    "gyro and motion capture agree within 8 deg",
    "a yaw with the wrong sign never settles",
)
SCALE = Check(
    "hand.scale",
    "hand test: distance",
    "motion capture measures 0.7 to 1.4 m for each metre that the IMU measures",
    "every distance would be wrong by this factor",
)
CHECKS = (DONE, AS_REQUESTED, LEVEL, LIFT, FORWARD, TURN, SCALE)

LEVEL_MAX_DEG: Final = 5.0
"""Largest angle between gravity as measured by the accelerometer, rotated by the streamed attitude, and the world's vertical."""
AXIS_MAX_DEG: Final = 20.0
YAW_MAX_DEG: Final = 12.0
"""Largest angle between the forward axes of the rigid body and of the vehicle."""
TURN_MAX_DEG: Final = 8.0
"""Largest difference between gyro and motion capture over a turn of about 45 deg."""
REQUESTED_MAX_DEG: Final = 40.0
"""Largest angle between the requested direction and the motion measured by the IMU."""
SCALE_SPAN: Final = (0.7, 1.4)

_UP: Vec3 = (0.0, 0.0, 1.0)
_AHEAD: Vec3 = (1.0, 0.0, 0.0)
_RESET = "in Motive, with the vehicle level and its nose along the stream's +x, reset the rigid body's orientation"
_BOARD = "correct PX4's SENS_BOARD_ROT and calibrate its accelerometer: its axes are not the vehicle's"


def rows(result: HandResult, up_axis: str) -> list[Row]:
    """Return one row per property that the test measures.

    Args:
        up_axis: devices.mocap.up_axis, "y" or "z".
    """
    lift, forward, turn = result.lift, result.forward, result.turn
    up_body = result.stood.force_m_s2
    requested = _as_requested(lift, forward, turn, up_body)
    fix = _BOARD if not requested.ok and _seen_as_requested(result) else _explain(result, up_axis)
    level_deg = gravity_off_deg(result)
    lift_deg = math.degrees(angle_rad(lift.response, lift.felt_m))
    yaw_deg = yaw_offset_deg(forward)
    slant_deg = math.degrees(angle_rad(forward.response, forward.felt_m))
    felt_deg, seen_deg = (math.degrees(value) for value in (turn.felt_turn_rad[2], turn.seen_turn_rad[2]))
    axis_deg = math.degrees(angle_rad(turn.seen_turn_rad, turn.felt_turn_rad))
    scales = (math.hypot(*lift.response), math.hypot(*forward.response))

    far = "calibrate the motion-capture volume again (wand length), or the accelerometer if it reads wrong at rest"
    return [
        DONE.good("lift, forward and turn were recognised"),
        requested,
        LEVEL.row(
            level_deg <= LEVEL_MAX_DEG,
            f"gravity points {level_deg:.1f} deg from the stream's vertical",
            f"within {LEVEL_MAX_DEG:g} deg",
            fix,
        ),
        LIFT.row(
            lift_deg <= AXIS_MAX_DEG,
            f"IMU {_way(lift.felt_m)}, motion capture {_way(lift.seen_m)}, {lift_deg:.0f} deg apart",
            f"within {AXIS_MAX_DEG:g} deg",
            fix,
        ),
        FORWARD.row(
            abs(yaw_deg) <= YAW_MAX_DEG and slant_deg <= AXIS_MAX_DEG,
            f"IMU {_way(forward.felt_m)}, motion capture {_way(forward.seen_m)}; the body's yaw is off by {yaw_deg:+.0f} deg",
            f"within {YAW_MAX_DEG:g} deg",
            fix,
        ),
        TURN.row(
            abs(seen_deg - felt_deg) <= TURN_MAX_DEG and axis_deg <= AXIS_MAX_DEG,
            f"IMU {felt_deg:+.0f} deg about its vertical, motion capture {seen_deg:+.0f} deg",
            f"within {TURN_MAX_DEG:g} deg",
            fix,
        ),
        SCALE.row(
            all(SCALE_SPAN[0] <= scale <= SCALE_SPAN[1] for scale in scales),
            f"motion capture measured {scales[0]:.2f} m up and {scales[1]:.2f} m forward for each metre that the IMU measured",
            f"{SCALE_SPAN[0]:g} to {SCALE_SPAN[1]:g} m",
            far,
        ),
    ]


def ended(cause: str, again: str = "companion check --hand") -> Row:
    """Return the row of a test without a result; `again` is the command that repeats it."""
    return DONE.bad(cause, "lift, forward and a turn to the left, each recognised", f"repeat the test: {again}")


def yaw_offset_deg(forward: Motion) -> float:
    """Return by how much the streamed yaw is too large, in (-180, 180] deg."""
    (fx, fy, _), (sx, sy, _) = forward.felt_m, forward.response
    return math.degrees(math.atan2(sx * fy - sy * fx, fx * sx + fy * sy))


def _as_requested(lift: Motion, forward: Motion, turn: Motion, up_body: Vec3) -> Row:
    """Return the row on whether the IMU measured the requested motion. If it did, the IMU's own axes are right too."""
    up_deg = math.degrees(angle_rad(lift.felt_m, up_body))
    standing_deg = math.degrees(angle_rad(up_body, _UP))
    ahead_deg = math.degrees(angle_rad(forward.felt_m, _AHEAD))
    left_deg = math.degrees(turn.felt_turn_rad[2])
    read = f"the IMU measured {_way(lift.felt_m)}, then {_way(forward.felt_m)}, then a turn by {left_deg:+.0f} deg"
    if max(up_deg, standing_deg, ahead_deg) <= REQUESTED_MAX_DEG and left_deg > 0.0:
        return AS_REQUESTED.good(read, "up, forward, left")
    return AS_REQUESTED.bad(
        read, "up, forward, left", f"repeat the test; if the vehicle was moved as instructed, {_BOARD}"
    )


def _seen_as_requested(result: HandResult) -> bool:
    """Return whether motion capture, considered alone, measured the requested motion: up, forward, left."""
    most = math.radians(REQUESTED_MAX_DEG)
    straight = angle_rad(result.lift.seen_m, _UP) <= most and angle_rad(result.forward.seen_m, _AHEAD) <= most
    return straight and result.turn.seen_turn_rad[2] > 0.0


def gravity_off_deg(result: HandResult) -> float:
    """Return the angle between measured gravity and the stream's vertical before the lift, deg."""
    return math.degrees(angle_rad(quat_rotate(result.stood.attitude, result.stood.force_m_s2), _UP))


def proposed_up_axis(level: bool, axes: AxisMap, up_axis: str) -> str:
    """Return the value of devices.mocap.up_axis that puts the axes right, or the present one if none does.

    Args:
        level: whether gravity is vertical in the stream. It is vertical in a stream whose axes are all wrong, but not in one in which
            only the body's axes are wrong.
        axes: axes of the rigid body (`best_axes`).
        up_axis: devices.mocap.up_axis during the test.
    """
    if level and axes == Y_UP and up_axis == "z":
        return "y"
    if level and axes == Y_UP.inverse and up_axis == "y":
        return "z"
    return up_axis


def best_axes(result: HandResult) -> AxisMap:
    """Return which of the 48 axis maps of the rigid body fits all measurements best."""
    polar = [(m.felt_m, m.response) for m in (result.lift, result.forward)]
    axial = (result.turn.felt_turn_rad, result.turn.seen_turn_rad)

    def misfit(axes: AxisMap) -> float:
        total = sum(angle_rad(axes.vector(felt), seen) ** 2 for felt, seen in polar)
        x, y, z = axes.vector(axial[0])
        d = axes.determinant
        return total + angle_rad((d * x, d * y, d * z), axial[1]) ** 2

    return min(ALL, key=misfit)


def _explain(result: HandResult, up_axis: str) -> str:
    """Return the remedy as one line."""
    axes = best_axes(result)
    yaw_deg = yaw_offset_deg(result.forward)
    if axes.determinant < 0:
        return (
            f"the stream is left-handed (its x, y, z look like the true {', '.join(axes.names)}): use Motive's right-handed "
            "axes, without axis conversion"
        )
    level = gravity_off_deg(result) <= LEVEL_MAX_DEG
    if (proposed := proposed_up_axis(level, axes, up_axis)) != up_axis:
        return f"the stream looks {proposed}-up: set devices.mocap.up_axis: {proposed}"
    if axes.vector(_UP) == _UP and (axes != IDENTITY or abs(yaw_deg) > YAW_MAX_DEG):
        side = "left" if yaw_deg > 0.0 else "right"
        return f"the rigid body's zero is turned: its x axis points {abs(yaw_deg):.0f} deg to the {side} of the nose; {_RESET}"
    if axes == IDENTITY:
        return f"the rigid body's zero was set while the vehicle was tilted, or the ground plane is not level; {_RESET}"
    exchanged = f"axes are exchanged (its x, y, z look like the vehicle's {', '.join(axes.names)})"
    if level:
        return f"the stream's {exchanged}: set devices.mocap.up_axis to match Motive's stream, and Motive's ground plane with z up"
    return f"the rigid body's {exchanged}; {_RESET}"


def _way(v: Vec3) -> str:
    """Return a displacement as text, such as "0.29 m forward"."""
    words = (("forward", "back"), ("left", "right"), ("up", "down"))
    size = math.hypot(*v)
    parts = [
        f"{abs(part):.2f} m {pair[part < 0.0]}"
        for part, pair in zip(v, words, strict=True)
        if abs(part) >= max(0.05, 0.25 * size)
    ]
    return " and ".join(parts) if parts else f"{100.0 * size:.0f} cm"
