"""Mounting and scale of the force sensor from a known weight on the net, and its drift at rest. Pure functions.

Frames: the last link's tip (x outwards; for a planar arm, y along the joint axes) and the sensor, which is rotated relative to it by
`tool.sensor_rpy_deg`. A reading is the force of the surroundings on the tool side of the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.check_row import Row
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.types import ForceSample, Joints, Quat, Vec3
from companion.preflight.axes import IDENTITY, ROTATIONS, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.motion import angle_rad

WEIGHT = Check("ft.weight", "known weight", why="scale and direction remain unknown")
SCALE = Check("ft.scale", "force sensor scale", why="the controller would respond to the wrong force")
DIRECTION = Check(
    "ft.direction", "force sensor direction", why="the controller would respond to every force in the wrong direction"
)
POSE = Check(
    "ft.pose", "pose of the arm", why="a rotation of the sensor about the weight's direction is invisible", warns=True
)

SCALE_TOLERANCE: Final = 0.05
DIRECTION_MAX_DEG: Final = 8.0
EXPLAINED_MAX_DEG: Final = 20.0
"""Largest remaining angle at which a rotation by multiples of 90 deg is accepted as the cause of a wrong direction."""
APART_MIN_DEG: Final = 12.0
"""Smallest difference between the angle errors of the best and the second-best rotation with which the mounting counts as certain."""


@dataclass(frozen=True, slots=True)
class WeightFit:
    """Scale and mounting of the sensor, measured with a known weight."""

    expected_n: float
    measured_n: float
    scale: float
    """Measured over expected weight."""
    off_deg: float
    """Angle between the measured weight and its direction according to the vehicle file."""
    turn: AxisMap
    """Rotation of the sensor by multiples of 90 deg, relative to the vehicle file's mounting, that best fits the weight's direction."""
    rest_deg: float
    """Remaining angle after that rotation."""
    others: tuple[AxisMap, ...]
    """Other rotations that fit the weight's direction nearly as well."""
    rpy_deg: Vec3
    """Value of `tool.sensor_rpy_deg` with that rotation."""


def down_at_tip(vehicle: Vehicle, arm_rad: Joints) -> Vec3:
    """Return gravity's direction in the frame of the arm's tip for a level vehicle."""
    rpy_deg = vehicle.tool.sensor_rpy_deg if vehicle.tool is not None else (0.0, 0.0, 0.0)
    sensor = quat_rotate(quat_conjugate(manipulator_of(vehicle).sensor_attitude_body(arm_rad)), (0.0, 0.0, -1.0))
    return quat_rotate(_mounting(rpy_deg), sensor)


def _mounting(sensor_rpy_deg: Vec3) -> Quat:
    roll, pitch, yaw = map(math.radians, sensor_rpy_deg)
    return quat_from_euler_zyx(roll, pitch, yaw)


def fit_weight(empty_n: Vec3, loaded_n: Vec3, down_tip: Vec3, weight_kg: float, sensor_rpy_deg: Vec3) -> WeightFit:
    """Return the sensor's scale and mounting. The mounting is the one of the 24 rotations by multiples of 90 deg that best fits the
    direction of the weight; the configured mounting is kept if it is within 1 deg of the best.

    Args:
        empty_n: mean reading with the net empty, sensor frame.
        loaded_n: mean reading with the weight on the net, sensor frame.
        down_tip: gravity's direction in the frame of the arm's tip.
    """
    mounted = _mounting(sensor_rpy_deg)
    measured = (loaded_n[0] - empty_n[0], loaded_n[1] - empty_n[1], loaded_n[2] - empty_n[2])
    expected = quat_rotate(quat_conjugate(mounted), down_tip)
    off_deg = {turn: math.degrees(angle_rad(turn.vector(expected), measured)) for turn in ROTATIONS}
    best = min(ROTATIONS, key=off_deg.__getitem__)
    if off_deg[IDENTITY] <= off_deg[best] + 1.0:
        best = IDENTITY
    measured_n, expected_n = math.hypot(*measured), GRAVITY_M_S2 * weight_kg
    return WeightFit(
        expected_n=expected_n,
        measured_n=measured_n,
        scale=measured_n / expected_n,
        off_deg=off_deg[IDENTITY],
        turn=best,
        rest_deg=off_deg[best],
        others=tuple(turn for turn in ROTATIONS if turn != best and off_deg[turn] < off_deg[best] + APART_MIN_DEG),
        rpy_deg=_degrees(quat_multiply(mounted, best.inverse.quat)),
    )


def rows(fit: WeightFit) -> Iterator[Row]:
    """Return the rows on scale, direction, and whether the arm's pose reveals the direction."""
    read = f"{fit.measured_n:.2f} N of {fit.expected_n:.2f} N, ratio {fit.scale:.3f}"
    fix = (
        f"the sensor reads {fit.scale:.2f} times the true force: check the weight, and hang it on the net only; if "
        "that is correct, the sensor is a different model (the RFT60 has 50 counts per N) or must be calibrated by its manufacturer"
    )
    yield SCALE.row(abs(fit.scale - 1.0) <= SCALE_TOLERANCE, read, f"within {100 * SCALE_TOLERANCE:g} %", fix)
    read = f"{fit.off_deg:.0f} deg from the direction according to tool.sensor_rpy_deg"
    fix = (
        "hang the weight freely from the net's centre; check the arm's angles (companion arm zero); level the vehicle; raise "
        "the last link to about 30 deg below level, and repeat"
    )
    if changes(fit):
        rpy = ", ".join(f"{angle:g}" for angle in fit.rpy_deg)
        fix = (
            f"the sensor is mounted rotated: set tool.sensor_rpy_deg: [{rpy}] (remaining error {fit.rest_deg:.0f} deg)"
        )
    yield DIRECTION.row(fit.off_deg <= DIRECTION_MAX_DEG, read, f"within {DIRECTION_MAX_DEG:g} deg", fix)
    read = f"{len(fit.others) or 'no'} other rotations by multiples of 90 deg fit the weight as well"
    yield POSE.row(
        not fit.others, read, "none", "repeat with the last link about 20 to 35 deg below level, not straight down"
    )


def changes(fit: WeightFit) -> dict[Location, Data]:
    """Return the mounting to change in the vehicle file; empty if it is correct or uncertain."""
    right = fit.off_deg <= DIRECTION_MAX_DEG
    if right or fit.turn == IDENTITY or fit.others or fit.rest_deg > EXPLAINED_MAX_DEG:
        return {}
    return {("tool", "sensor_rpy_deg"): list(fit.rpy_deg)}


def as_json(fit: WeightFit) -> dict[str, Any]:
    """Return the fit's part of the JSON document; N and degrees."""
    numbers = {key: getattr(fit, key) for key in ("expected_n", "measured_n", "scale", "off_deg", "rest_deg")}
    return {**numbers, "sensor_rpy_deg": list(fit.rpy_deg), "certain": not fit.others}


@dataclass(frozen=True, slots=True)
class Drift:
    """Drift of one axis of a sensor at rest."""

    mean_n: float
    noise_n: float
    """Standard deviation about the drift line."""
    per_minute_n: float
    standard_error_n: float
    """Standard error of `per_minute_n`, from the scatter of means over a second or less."""


def drift(samples: Sequence[ForceSample]) -> list[Drift]:
    """Fit a straight line to each axis x, y, z of at least four samples."""
    stamps_s = np.array([sample.stamp_s for sample in samples])
    return [_drift(stamps_s, np.array(values)) for values in zip(*(s.force_sensor_n for s in samples), strict=True)]


def _drift(stamps_s: NDArray[np.float64], values: NDArray[np.float64]) -> Drift:
    t_s = stamps_s - stamps_s[0]
    block = (t_s / min(1.0, t_s[-1] / 4)).astype(int)
    counts = np.bincount(block)
    filled, counts = counts > 0, counts[counts > 0]
    mean_s, means = (np.bincount(block, one)[filled] / counts for one in (t_s, values))
    line, covariance = np.polyfit(mean_s, means, 1, w=np.sqrt(counts), cov="unscaled")
    scatter = counts @ (means - np.polyval(line, mean_s)) ** 2 / max(1, len(counts) - 2)
    return Drift(
        mean_n=float(values.mean()),
        noise_n=float(np.std(values - np.polyval(line, t_s))),
        per_minute_n=60.0 * float(line[0]),
        standard_error_n=60.0 * math.sqrt(scatter * covariance[0, 0]),
    )


def _degrees(q: Quat) -> Vec3:
    """Return roll, pitch, yaw to a tenth of a degree; at a pitch of 90 deg, where roll and yaw are one rotation, yaw is 0."""
    w, x, y, z = q
    upright = 2.0 * (w * y - z * x)
    angles = euler_zyx_from_quat(q)
    if abs(upright) > 1.0 - 1e-6:
        angles = (math.remainder(2.0 * math.atan2(x, w), 2.0 * math.pi), math.copysign(0.5 * math.pi, upright), 0.0)
    roll, pitch, yaw = (round(math.degrees(angle), 1) + 0.0 for angle in angles)
    return (roll, pitch, yaw)
