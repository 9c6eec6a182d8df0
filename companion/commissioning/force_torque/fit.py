"""A known weight on the net: how the force sensor lies in the arm, its scale, what is left. Drift of a sensor at rest. Pure.

Frames: link 2 (x outwards along the link, y along the joint axis); sensor, turned against it by `tool.sensor_rpy_deg`. A reading is
the force of the surroundings on the tool side of the sensor.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_conjugate, quat_from_euler_zyx, quat_multiply, quat_rotate
from companion.model.rows import Row
from companion.model.types import ForceSample, Quat, Vec2, Vec3
from companion.preflight.axes import IDENTITY, ROTATIONS, AxisMap
from companion.preflight.checks import Check
from companion.preflight.hand_test.motion import angle_rad, norm

STUCK = Check(
    "ft.stuck",
    "force sensor alive",
    "never the very same reading for longer than `safety.force_stuck_s`",
    "a stuck sensor reads well and feels nothing",
)
WEIGHT = Check("ft.weight", "known weight", "it is seen on the net", "nothing is known of scale and direction")
SCALE = Check(
    "ft.scale", "force sensor scale", "force over m g within 5 %", "the law would feel more or less than there is"
)
DIRECTION = Check(
    "ft.direction",
    "force sensor direction",
    "the weight pulls where `tool.sensor_rpy_deg` says, within 8 deg",
    "every force would be answered into a wrong direction",
)
POSE = Check(
    "ft.pose",
    "pose of the arm",
    "no other right-angle turn of the sensor explains the weight as well",
    "a sensor that is turned about the weight's own direction looks right",
    warns=True,
)
CHECKS = (STUCK, WEIGHT, SCALE, DIRECTION, POSE)

SCALE_TOLERANCE: Final = 0.05
DIRECTION_MAX_DEG: Final = 8.0
EXPLAINED_MAX_DEG: Final = 20.0
"""A right-angle turn explains a direction no worse than this."""
APART_MIN_DEG: Final = 12.0
"""So much better than the next one must the best explanation be."""


@dataclass(frozen=True, slots=True)
class Loaded:
    """One pose of the arm, without and with the weight; means over a second or two at rest."""

    empty_n: Vec3
    loaded_n: Vec3
    """Both in the sensor's own axes, as streamed."""
    down_link2: Vec3
    """Unit vector of gravity in link 2's frame."""


@dataclass(frozen=True, slots=True)
class WeightFit:
    """What a known weight says."""

    expected_n: float
    measured_n: float
    scale: float
    """Measured over expected."""
    off_deg: float
    """Between the weight as it was felt and as the vehicle file says."""
    turn: AxisMap
    """Right-angle turn of the sensor, on top of the vehicle file's, that explains the weight best."""
    rest_deg: float
    """What is left beyond it."""
    others: tuple[AxisMap, ...]
    """Turns that explain it nearly as well."""
    rpy_deg: Vec3
    """`tool.sensor_rpy_deg` with that turn."""


def down_in_link2(arm_rad: Vec2) -> Vec3:
    """Gravity's direction in link 2 while the machine stands level."""
    half = 0.5 * (arm_rad[0] - arm_rad[1])
    return quat_rotate((math.cos(half), 0.0, -math.sin(half), 0.0), (0.0, 0.0, -1.0))


def fit_weight(poses: Sequence[Loaded], weight_kg: float, sensor_rpy_deg: Vec3) -> WeightFit:
    """Of the 24 right-angle turns the one that explains the weight best in all poses; the configured one where it is as good.

    Args:
        poses: one or more.
        weight_kg: of what was hung on the net.
        sensor_rpy_deg: the vehicle file's.
    """
    roll, pitch, yaw = (math.radians(angle) for angle in sensor_rpy_deg)
    mounted: Quat = quat_from_euler_zyx(roll, pitch, yaw)
    felt = [_minus(pose.loaded_n, pose.empty_n) for pose in poses]
    believed = [quat_rotate(quat_conjugate(mounted), pose.down_link2) for pose in poses]

    def off_deg(turn: AxisMap) -> float:
        squares = [angle_rad(turn.vector(b), f) ** 2 for b, f in zip(believed, felt, strict=True)]
        return math.degrees(math.sqrt(sum(squares) / len(squares)))

    ranked = sorted(ROTATIONS, key=off_deg)
    best = IDENTITY if off_deg(IDENTITY) <= off_deg(ranked[0]) + 1.0 else ranked[0]
    others = tuple(turn for turn in ranked if turn != best and off_deg(turn) < off_deg(best) + APART_MIN_DEG)
    turned = quat_multiply(mounted, best.inverse.quat)
    measured_n = sum(norm(f) for f in felt) / len(felt)
    expected_n = GRAVITY_M_S2 * weight_kg
    return WeightFit(
        expected_n,
        measured_n,
        measured_n / expected_n,
        off_deg(IDENTITY),
        best,
        off_deg(best),
        others,
        _degrees(turned),
    )


def rows(fit: WeightFit) -> Iterator[Row]:
    """Scale, direction, and whether this pose could tell."""
    read = f"{fit.measured_n:.2f} N of {fit.expected_n:.2f} N, {fit.scale:.3f} of it"
    wanted = f"within {100 * SCALE_TOLERANCE:g} %"
    if abs(fit.scale - 1.0) <= SCALE_TOLERANCE:
        yield SCALE.good(read, wanted)
    else:
        fix = (
            f"it reads {fit.scale:.2f} times the truth: weigh the weight, and let nothing but the net carry it; if that is right, the "
            "sensor is another model (this one has 50 counts per N) or has to be calibrated by its maker"
        )
        yield SCALE.bad(read, wanted, fix)
    read, wanted = f"{fit.off_deg:.0f} deg from where tool.sensor_rpy_deg says", f"within {DIRECTION_MAX_DEG:g} deg"
    if fit.off_deg <= DIRECTION_MAX_DEG:
        yield DIRECTION.good(read, wanted)
    elif fit.turn != IDENTITY and fit.rest_deg <= EXPLAINED_MAX_DEG and not fit.others:
        rpy = ", ".join(f"{angle:g}" for angle in fit.rpy_deg)
        fix = f"the sensor is turned: set tool.sensor_rpy_deg: [{rpy}], which leaves {fit.rest_deg:.0f} deg"
        yield DIRECTION.bad(read, wanted, fix)
    else:
        fix = (
            "let the weight hang from the net's centre, and nothing touch it; see the arm's angles (companion arm zero); stand the "
            "machine level; raise link 2 to some 30 deg below level, and do it again"
        )
        yield DIRECTION.bad(read, wanted, fix)
    if fit.others:
        many = f"{len(fit.others)} other right-angle turns explain it nearly as well"
        yield POSE.bad(many, "none", "do it again with link 2 some 20 to 35 deg below level, not straight down")
    else:
        yield POSE.good("no other right-angle turn explains it", "none")


def changes(fit: WeightFit) -> dict[Location, Data]:
    """Of the vehicle file: a turned sensor, if it is certain."""
    right = fit.off_deg <= DIRECTION_MAX_DEG
    if right or fit.turn == IDENTITY or fit.others or fit.rest_deg > EXPLAINED_MAX_DEG:
        return {}
    return {("tool", "sensor_rpy_deg"): list(fit.rpy_deg)}


def as_json(fit: WeightFit) -> dict[str, Any]:
    """For scripts; N and degrees."""
    return {
        "expected_n": fit.expected_n,
        "measured_n": fit.measured_n,
        "scale": fit.scale,
        "off_deg": fit.off_deg,
        "rest_deg": fit.rest_deg,
        "sensor_rpy_deg": list(fit.rpy_deg),
        "certain": not fit.others,
    }


def stuck_row(samples: Sequence[ForceSample], vehicle: Vehicle) -> Row:
    """The longest time with the very same reading."""
    longest_s, since_s = 0.0, samples[0].stamp_s
    for before, now in itertools.pairwise(samples):
        same = (before.force_sensor_n, before.torque_sensor_nm) == (now.force_sensor_n, now.torque_sensor_nm)
        since_s = since_s if same else now.stamp_s
        longest_s = max(longest_s, now.stamp_s - since_s)
    limit_s = vehicle.safety.force_stuck_s
    read, wanted = f"the same reading for {longest_s:.2f} s at most", f"{limit_s:g} s"
    if longest_s <= limit_s:
        return STUCK.good(read, wanted)
    return STUCK.bad(read, wanted, "power-cycle the sensor; check its cable")


@dataclass(frozen=True, slots=True)
class Drift:
    """One axis of a sensor at rest."""

    mean_n: float
    noise_n: float
    """Standard deviation about the drift."""
    per_minute_n: float
    standard_error_n: float
    """Of `per_minute_n`, by the scatter of means over a second."""


def drift(samples: Sequence[ForceSample]) -> tuple[Drift, Drift, Drift]:
    """A straight line through each axis; at least 4 s of samples."""
    first, second, third = (_drift([(s.stamp_s, s.force_sensor_n[axis]) for s in samples]) for axis in range(3))
    return first, second, third


def _drift(points: Sequence[tuple[float, float]]) -> Drift:
    blocks: dict[int, list[float]] = {}
    for t_s, value in points:
        blocks.setdefault(int(t_s - points[0][0]), []).append(value)
    full = max(len(block) for block in blocks.values())
    means = [(t, sum(block) / len(block)) for t, block in blocks.items() if 2 * len(block) >= full]
    count = len(means)
    mean_t, mean = sum(t for t, _ in means) / count, sum(v for _, v in means) / count
    spread = sum((t - mean_t) ** 2 for t, _ in means)
    slope = sum((t - mean_t) * (v - mean) for t, v in means) / spread
    rest = sum((v - mean - slope * (t - mean_t)) ** 2 for t, v in means) / max(1, count - 2)
    start_s = points[0][0]
    off = [value - mean - slope * (t_s - start_s - mean_t - 0.5) for t_s, value in points]
    noise = math.sqrt(sum(value * value for value in off) / len(off))
    return Drift(mean, noise, 60.0 * slope, 60.0 * math.sqrt(rest / spread))


def mean_force(samples: Sequence[ForceSample]) -> Vec3:
    """Component by component, sensor frame."""
    x, y, z = (sum(sample.force_sensor_n[axis] for sample in samples) / len(samples) for axis in range(3))
    return (x, y, z)


def _degrees(q: Quat) -> Vec3:
    """Roll, pitch, yaw, as a person writes a right angle; at a pitch of 90 deg, where roll and yaw are one, yaw is 0."""
    w, x, y, z = q
    upright = 2.0 * (w * y - z * x)
    angles = euler_zyx_from_quat(q)
    if abs(upright) > 1.0 - 1e-6:
        angles = (math.remainder(2.0 * math.atan2(x, w), 2.0 * math.pi), math.copysign(0.5 * math.pi, upright), 0.0)
    roll, pitch, yaw = (round(math.degrees(angle), 1) + 0.0 for angle in angles)
    return (roll, pitch, yaw)


def _minus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
