"""Checks that motion capture, PX4 and the mission use the same axes, from data at rest. Pure functions.

PX4 fuses motion capture, so a wrong yaw is invisible to EKF2. Gravity measured by the accelerometer reveals a tilted frame; the
mission's start position and yaw reveal a rotated one; the hand test reveals the rest (`companion.preflight.hand_test.steps`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.model.check_row import Row
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_multiply, quat_rotate, wrap_rad, yaw_from_quat
from companion.model.observations import Observations
from companion.model.types import MocapPose, Quat, Vec3, VehicleState
from companion.preflight.axes import IDENTITY, MIRRORINGS, ROTATIONS, Y_UP, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.motion import angle_rad, mean_attitude, mean_vector, turned_rad

HAND_TEST = Check(
    "frames.hand_test",
    "hand test",
    "passed once with this vehicle, server, rigid body, up axis and NatNet version (not required in SITL)",
    "PX4 fuses motion capture and cannot detect wrong axes; at rest, some axis errors cannot be seen",
    warns=True,
)
REST = Check("frames.rest", "at rest", "no motion during the observation", "gravity can only be measured at rest")
GRAVITY = Check(
    "frames.gravity",
    "gravity in the motion-capture axes",
    "specific force, rotated by motion capture's attitude, points up within 5 deg",
    "the thrust would be tilted by this angle",
)
HEIGHT = Check(
    "frames.height",
    "height at rest",
    "`airframe.ground_clearance_m` ± 3 cm; refused beyond the mission's `start.tolerance_m`",
    "heights are wrong by the difference, and touchdown is detected early or late",
)
PLACE = Check(
    "frames.place",
    "start position in the motion-capture axes",
    "the mission's `start.position_m`",
    "the room, the tether and the path are given in these axes",
)
YAW = Check(
    "frames.yaw",
    "start yaw in the motion-capture axes",
    "the mission's `start.yaw_deg`",
    "PX4 fuses this yaw and cannot detect that it is wrong: the vehicle would circle or fly away",
)
NOISE_POSITION = Check(
    "frames.noise_position",
    "noise of the position at rest",
    "at most 2 mm, and no frame more than 30 mm off; refused above 10 mm",
    "the vehicle would shake, or lose its estimate",
)
NOISE_ATTITUDE = Check(
    "frames.noise_attitude",
    "noise of the attitude at rest",
    "at most 0.3 deg, and no frame more than 10 deg off; refused above 2 deg",
    "yaw jumps when Motive mixes up markers, and PX4 follows the jumps",
)
ACCELEROMETER = Check(
    "frames.accelerometer",
    "gravity measured by the accelerometer",
    "9.81 ± 0.5 m/s2",
    "PX4's height and tilt depend on it",
    warns=True,
)
PX4_TILT = Check(
    "frames.px4_tilt",
    "PX4's tilt compared with motion capture",
    "within 3 deg",
    "every attitude setpoint would be wrong by this angle",
    settles=True,
)
PX4_YAW = Check(
    "frames.px4_yaw",
    "PX4's yaw compared with motion capture",
    "within `safety.yaw_disagreement_deg`",
    "PX4 does not fuse motion capture's yaw: the vehicle would fly away sideways",
    settles=True,
)
CHECKS = (
    HAND_TEST, REST, GRAVITY, HEIGHT, PLACE, YAW, NOISE_POSITION, NOISE_ATTITUDE, ACCELEROMETER, PX4_TILT, PX4_YAW,
)  # fmt: skip

SAMPLES_MIN: Final = 20
GRAVITY_MAX_DEG: Final = 5.0
GRAVITY_TOLERANCE_M_S2: Final = 0.5
HEIGHT_GOOD_M: Final = 0.03
TILT_MAX_DEG: Final = 3.0
NOISE_GOOD_MM, NOISE_MAX_MM, JUMP_MAX_MM = 2.0, 10.0, 30.0
NOISE_GOOD_DEG, NOISE_MAX_DEG, JUMP_MAX_DEG = 0.3, 2.0, 10.0
"""Limits of the standard deviation of all axes together, and of a single frame's deviation."""
MOVED_MAX_M, MOVED_MAX_DEG = 0.01, 2.0
"""Largest motion between the first and the last quarter of the observation."""
RATE_MAX_DEG_S: Final = 3.0
"""Largest mean gyro rate at rest."""
_EXPLAINED_DEG: Final = 10.0
_UP: Vec3 = (0.0, 0.0, 1.0)
_RESET = "place the vehicle level with its nose along the stream's +x and reset the rigid body's orientation in Motive"


class Pose(NamedTuple):
    """Pose of the vehicle measured by motion capture, in the mission's world if the stream's axes are right."""

    position_m: Vec3
    attitude: Quat


@dataclass(frozen=True, slots=True)
class Wanted:
    """Start pose of the mission with its tolerances."""

    position_m: Vec3
    yaw_rad: float
    tolerance_m: float
    yaw_tolerance_deg: float

    @classmethod
    def of(cls, mission: Mission, vehicle: Vehicle) -> Wanted:
        """Return the start pose of a mission and its vehicle."""
        start = mission.start
        position = (*start.position_m, vehicle.airframe.ground_clearance_m)
        return cls(position, math.radians(start.yaw_deg), start.tolerance_m, start.yaw_tolerance_deg)


def rows(observations: Observations, mission: Mission, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows that can be evaluated at rest; only the first of them if data is missing or the vehicle moved."""
    if observations.hand_test is not None:
        yield _hand_test(observations.hand_test, observations.hand_test_changed)
    poses = [pose for pose in observations.mocap if pose.tracking_valid]
    states = observations.vehicle
    if len(poses) < SAMPLES_MIN or len(states) < SAMPLES_MIN:
        read = f"{len(poses)} tracked poses and {len(states)} states of PX4"
        yield REST.bad(read, f"{SAMPLES_MIN} of each", "see the rows on motion capture and on PX4's link")
        return
    rest = _rest(poses, states)
    yield rest
    if not rest.ok:
        return
    force = mean_vector([state.specific_force_body_m_s2 for state in states])
    at = Pose(mean_vector([p.position_world_m for p in poses]), mean_attitude([p.attitude_wxyz for p in poses]))
    yield from standing(at, force, Wanted.of(mission, vehicle), vehicle.devices.mocap.up_axis)
    yield from _noise(poses, at)
    yield _accelerometer(force)
    yield from _px4(at, states, vehicle)


def standing(at: Pose, force_m_s2: Vec3, wanted: Wanted, up_axis: str) -> Iterator[Row]:
    """Return the rows on gravity, height, position and yaw of a vehicle at rest.

    Args:
        at: pose measured by motion capture, with the configured up axis.
        force_m_s2: specific force measured by the accelerometer, body FLU.
        wanted: start pose of the mission.
        up_axis: devices.mocap.up_axis, "y" or "z".
    """
    fix = explanation(at, force_m_s2, wanted, up_axis)
    x, y, z = at.position_m
    wx, wy, wz = wanted.position_m
    tilt_deg = math.degrees(angle_rad(quat_rotate(at.attitude, force_m_s2), _UP))
    high_m, away_m = z - wz, math.dist((x, y), (wx, wy))
    yaw_off_deg = math.degrees(wrap_rad(yaw_from_quat(at.attitude) - wanted.yaw_rad))

    read, text = f"{tilt_deg:.1f} deg from the vertical", f"within {GRAVITY_MAX_DEG:g} deg"
    reset = f"set the ground plane again in Motive (calibration square level on the floor), then {_RESET}"
    if max(abs(high_m), away_m) <= wanted.tolerance_m:
        reset = f"the rigid body's zero was set while it was tilted: {_RESET}"
    yield GRAVITY.row(tilt_deg <= GRAVITY_MAX_DEG, read, text, fix or reset)

    read, text = f"z = {z:.3f} m", f"{wz:.2f} ± {HEIGHT_GOOD_M:g} m (airframe.ground_clearance_m)"
    pivot = (
        "in Motive, set the rigid body's pivot to the body's origin and the ground plane to the floor, "
        "or correct airframe.ground_clearance_m"
    )
    yield HEIGHT.graded(abs(high_m) <= HEIGHT_GOOD_M, abs(high_m) <= wanted.tolerance_m, read, text, fix or pivot)

    read, text = f"({x:.2f}, {y:.2f}) m, {away_m:.2f} m away", f"({wx:g}, {wy:g}) m, within {wanted.tolerance_m:g} m"
    carry = "carry the vehicle there or change the mission's start.position_m"
    yield PLACE.row(away_m <= wanted.tolerance_m, read, text, fix or carry)

    read = f"{math.degrees(yaw_from_quat(at.attitude)):.0f} deg"
    text = f"{math.degrees(wanted.yaw_rad):g} ± {wanted.yaw_tolerance_deg:g} deg"
    turned = (
        f"if the nose really points {abs(yaw_off_deg):.0f} deg off, turn the vehicle or change the mission's start.yaw_deg; "
        f"if not, the rigid body's zero is turned by {yaw_off_deg:+.0f} deg: {_RESET}"
    )
    yield YAW.row(abs(yaw_off_deg) <= wanted.yaw_tolerance_deg, read, text, fix or turned)


def explanation(at: Pose, force_m_s2: Vec3, wanted: Wanted, up_axis: str) -> str:
    """Return one line with the axis permutation that accounts for every wrong value at rest, and its remedy; empty if none does or
    nothing is wrong. Likelier permutations are tried first; only the hand test distinguishes those that look alike at rest.
    """

    def fits(position_m: Vec3, attitude: Quat) -> bool:
        tilt = angle_rad(quat_rotate(attitude, force_m_s2), _UP)
        turned = abs(math.degrees(wrap_rad(yaw_from_quat(attitude) - wanted.yaw_rad)))
        near = math.dist(position_m, wanted.position_m) <= wanted.tolerance_m
        return math.degrees(tilt) <= _EXPLAINED_DEG and near and turned <= wanted.yaw_tolerance_deg

    p, q = at
    if fits(p, q):
        return ""
    other, axes = ("y", Y_UP) if up_axis == "z" else ("z", Y_UP.inverse)
    if fits(axes.inverse.vector(p), axes.inverse.rotation(q)):
        return f"the stream looks {other}-up: set devices.mocap.up_axis: {other}"
    others = sorted((axes for axes in ROTATIONS if axes != IDENTITY), key=_least_turned)
    for axes in others:
        if fits(p, quat_multiply(q, axes.quat)):
            return f"the rigid body's zero was set while it was turned {_turn(axes)}: {_RESET}{_or_so(axes)}"
    for axes in others:
        if fits(axes.inverse.vector(p), quat_multiply(quat_conjugate(axes.quat), q)):
            return f"the world looks turned {_turn(axes)}: {_plane(axes)}{_or_so(axes)}"
    for axes in (*others, *MIRRORINGS):
        # An operator who created the body in the wrong axes still pointed its nose along the stream's x.
        nose = _nose(axes)
        upright = quat_multiply(axes.inverse.rotation(q), nose)
        if fits(axes.inverse.vector(p), upright):
            if axes.determinant < 0:
                return (
                    f"the stream looks left-handed (its x, y, z are the true {', '.join(axes.names)}): use Motive's "
                    "right-handed axes, without axis conversion"
                )
            return (
                f"the stream's axes look exchanged (its x, y, z are the true {', '.join(axes.names)}): {_plane(axes)}"
            )
    return ""


def _least_turned(axes: AxisMap) -> float:
    return math.acos(min(1.0, abs(axes.quat[0])))


def _nose(axes: AxisMap) -> Quat:
    """Return the rotation by the true yaw of the stream's x axis, or no rotation if that axis is not horizontal."""
    if axes.index[0] == 2:
        return (1.0, 0.0, 0.0, 0.0)
    half = 0.5 * (math.atan2(axes.sign[0], 0.0) if axes.index[0] == 1 else math.atan2(0.0, axes.sign[0]))
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def _turn(axes: AxisMap) -> str:
    w, x, y, z = axes.quat
    angle = 2.0 * math.degrees(math.atan2(math.sqrt(x * x + y * y + z * z), w))
    parts = {"x": x, "y": y, "z": z}
    turning = {name: part for name, part in parts.items() if abs(part) > 1e-9}
    if len(turning) > 1:
        return f"(its x, y, z look like the true {', '.join(axes.names)})"
    ((name, part),) = turning.items()
    return f"by {math.copysign(angle, part):+.0f} deg about {name}"


def _or_so(axes: AxisMap) -> str:
    """Return the note that the vehicle itself may be turned about the vertical."""
    return "; if the vehicle itself is turned, place it as the mission requires" if axes.vector(_UP) == _UP else ""


def _plane(axes: AxisMap) -> str:
    if axes.vector(_UP) == _UP:
        return "set the ground plane in Motive with the calibration square's x along the room's x"
    return "set devices.mocap.up_axis to match Motive's stream (Settings > Streaming > Up Axis), and the ground plane with z up"


def _hand_test(passed: str, changed: str) -> Row:
    read = passed or changed or "never passed"
    return HAND_TEST.row(bool(passed), read, "passed with this set-up", "run companion check --hand (one minute)")


def _rest(poses: list[MocapPose], states: tuple[VehicleState, ...]) -> Row:
    """Return the row on whether the vehicle was at rest, on which all other rows depend."""
    quarter = len(poses) // 4
    first, last = poses[:quarter], poses[-quarter:]
    moved_m = math.dist(
        mean_vector([p.position_world_m for p in first]), mean_vector([p.position_world_m for p in last])
    )
    moved_deg = math.degrees(
        turned_rad(mean_attitude([p.attitude_wxyz for p in first]), mean_attitude([p.attitude_wxyz for p in last]))
    )
    rate_deg_s = math.degrees(math.hypot(*mean_vector([state.angular_rate_body_rad_s for state in states])))
    read = (
        f"moved by {1e3 * moved_m:.1f} mm and {moved_deg:.1f} deg during the observation, gyro {rate_deg_s:.1f} deg/s"
    )
    wanted = f"at most {1e3 * MOVED_MAX_M:g} mm, {MOVED_MAX_DEG:g} deg, {RATE_MAX_DEG_S:g} deg/s"
    if moved_m > MOVED_MAX_M or moved_deg > MOVED_MAX_DEG:
        return REST.bad(read, wanted, "do not touch the vehicle, and check again")
    if rate_deg_s > RATE_MAX_DEG_S:
        return REST.bad(read, wanted, "motion capture shows that the vehicle is at rest: calibrate PX4's gyro")
    return REST.good(read, wanted)


def _noise(poses: list[MocapPose], at: Pose) -> Iterator[Row]:
    away_mm = [1e3 * math.dist(pose.position_world_m, at.position_m) for pose in poses]
    away_deg = [math.degrees(turned_rad(pose.attitude_wxyz, at.attitude)) for pose in poses]
    fix = "refine the calibration, clean the lenses, cover reflections; give the rigid body more markers, placed asymmetrically"
    for check, away, unit, good, most, jump in (
        (NOISE_POSITION, away_mm, "mm", NOISE_GOOD_MM, NOISE_MAX_MM, JUMP_MAX_MM),
        (NOISE_ATTITUDE, away_deg, "deg", NOISE_GOOD_DEG, NOISE_MAX_DEG, JUMP_MAX_DEG),
    ):
        noise, worst = math.sqrt(sum(value * value for value in away) / len(away)), max(away)
        read, wanted = f"{noise:.2g} {unit}, {worst:.2g} {unit} in the worst frame", f"{good:g} {unit}, {jump:g} {unit}"
        yield check.graded(worst <= jump and noise <= good, worst <= jump and noise <= most, read, wanted, fix)


def _accelerometer(force_m_s2: Vec3) -> Row:
    size = math.hypot(*force_m_s2)
    read, wanted = f"{size:.2f} m/s2", f"{GRAVITY_M_S2:g} ± {GRAVITY_TOLERANCE_M_S2:g} m/s2"
    right = abs(size - GRAVITY_M_S2) <= GRAVITY_TOLERANCE_M_S2
    return ACCELEROMETER.row(right, read, wanted, "calibrate PX4's accelerometer")


def _px4(at: Pose, states: tuple[VehicleState, ...], vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows on PX4's attitude against motion capture, by the newest half of its states: its filter may be new."""
    estimate = mean_attitude([state.attitude_wxyz for state in states[len(states) // 2 :]])
    tilt_deg = math.degrees(angle_rad(quat_rotate(estimate, _UP), quat_rotate(at.attitude, _UP)))
    read, wanted = f"{tilt_deg:.1f} deg apart", f"within {TILT_MAX_DEG:g} deg"
    fix = "see the row on gravity; if it passes, set PX4's level horizon (SENS_BOARD_X_OFF, SENS_BOARD_Y_OFF)"
    yield PX4_TILT.row(tilt_deg <= TILT_MAX_DEG, read, wanted, fix)
    yaw_deg = math.degrees(wrap_rad(yaw_from_quat(estimate) - yaw_from_quat(at.attitude)))
    most_deg = vehicle.safety.yaw_disagreement_deg
    read, wanted = f"{yaw_deg:+.1f} deg apart", f"within {most_deg:g} deg (safety.yaw_disagreement_deg)"
    fix = "set EKF2_EV_CTRL to 11 and EKF2_MAG_TYPE to 5: companion px4 params --diff"
    yield PX4_YAW.row(abs(yaw_deg) <= most_deg, read, wanted, fix)
