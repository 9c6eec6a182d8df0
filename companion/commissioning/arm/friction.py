"""Torque constant, dry and viscous friction of every joint, from slow sweeps against gravity. Pure functions.

At constant speed a joint's motor carries gravity and friction alone: `K i = G(alpha) + c sign(rate) + b rate`, with G from the
vehicle file's masses. Divided by K this is linear in 1/K, c/K and b/K. A fourth unknown is the angle by which the machine is not
level or the zero is wrong; a prior with the standard deviation `LEVEL_DEG` keeps it small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.commissioning.arm.sweep import Sample
from companion.config.arm import Arm
from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.model.servos import ServoKind
from companion.model.types import IDENTITY_QUAT, Joints

BIN_S: Final = 0.25
"""Samples are averaged over this time, because the samples of neighbouring control ticks are not independent."""
BINS_MIN: Final = 12
LEVEL_DEG: Final = 2.0
HUBER: Final = 2.0
"""Residual from which a bin loses weight, in standard deviations as estimated by the median."""
CONSTANT_ERROR_MAX: Final = 0.05
"""Relative standard error beyond which a torque constant counts as undetermined."""
FRICTION_ERROR_MAX_NM: Final = 0.015
CONSTANT_SAME: Final = 0.02
FRICTION_SAME_NM: Final = 0.008
"""Smaller differences from the vehicle file's values are ignored."""
JOINTS_SAME: Final = 0.06
"""Largest relative difference between the torque constants of two servos of the same model."""
PLAUSIBLE: Final = (0.54, 1.69)
"""Plausible torque constants, relative to the servo's stall torque over its stall current."""
_SURE: Final = 3.0
"""Number of standard errors at which a difference is certain."""

_Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its standard error, in the same unit."""

    value: float
    standard_error: float

    def text(self, digits: int) -> str:
        """Return the value and its error, such as `1.30 ± 0.02`."""
        return f"{self.value:.{digits}f} ± {self.standard_error:.{digits}f}"


@dataclass(frozen=True, slots=True)
class JointFit:
    """Torque constant and friction of one joint."""

    torque_per_amp_nm_a: Estimate
    dry_nm: Estimate
    viscous_nms: Estimate
    off_deg: Estimate
    """Angle between the measured direction of gravity and the direction that the joint angles imply."""
    gravity_span_nm: float
    """Change of the gravity torque along the sweep."""
    residual_a: float
    bins: int


@dataclass(frozen=True, slots=True)
class FrictionFit:
    """Torque constant and friction of every joint, and the values for the vehicle file."""

    joints: tuple[JointFit | None, ...]
    """Fit of each joint; None with too few samples."""
    torque_constants_nm_a: tuple[Estimate | None, ...]
    """Torque constant of each joint's servo, the mean of all servos of its model; None if the data do not determine it."""
    joint_friction_nm: Estimate | None
    """Mean of all joints; None if the data do not determine it."""
    notes: tuple[str, ...]

    @property
    def torque_per_amp_nm_a(self) -> Estimate | None:
        """Torque constant of all servos; None if the data do not determine it or it differs from model to model."""
        return self.torque_constants_nm_a[0] if len(set(self.torque_constants_nm_a)) == 1 else None

    def changes(self, vehicle: Vehicle) -> dict[Location, Data]:
        """Return the values to change in the vehicle file; empty if the data do not contradict it."""
        wanted: dict[Location, Data] = {}
        arm = vehicle.arm
        together = one_constant(arm)
        for index, (found, has_nm_a) in enumerate(
            zip(self.torque_constants_nm_a, arm.torque_constants_nm_a, strict=True)
        ):
            if found is not None and _differs(found, has_nm_a, CONSTANT_SAME * has_nm_a):
                at: Location = ("arm",) if together else ("arm", "joints", index)
                wanted[(*at, "torque_per_amp_nm_a")] = round(found.value, 3)
        friction = self.joint_friction_nm
        if friction is not None and _differs(friction, arm.joint_friction_nm, FRICTION_SAME_NM):
            wanted["arm", "joint_friction_nm"] = max(0.0, round(friction.value, 3))
        return wanted


def one_constant(arm: Arm) -> bool:
    """Return whether the vehicle file has one torque constant for all joints, whose servos are of one model."""
    return len({joint.servo for joint in arm.joints}) == 1 and not any(
        joint.torque_per_amp_nm_a for joint in arm.joints
    )


def _differs(found: Estimate, has: float, same: float) -> bool:
    return abs(found.value - has) > max(same, _SURE * found.standard_error)


def fit(samples: Sequence[Sample], vehicle: Vehicle) -> FrictionFit:
    """Fit all joints.

    Args:
        samples: sweeps of all joints in both directions, at two speeds or more.
    """
    count = len(vehicle.arm.joints)
    fits = tuple(fit_joint([one for one in samples if one.joint == joint], vehicle, joint) for joint in range(count))
    known: list[Estimate | None] = [None] * count
    frictions, notes = [], []
    for number, one in enumerate(fits, 1):
        if one is None:
            notes.append(f"joint {number}: too few samples at constant speed; nothing can be determined")
            continue
        k, c, off = one.torque_per_amp_nm_a, one.dry_nm, one.off_deg
        if k.standard_error <= CONSTANT_ERROR_MAX * abs(k.value):
            known[number - 1] = k
        else:
            notes.append(
                f"joint {number}: the data do not determine the torque constant ({k.text(2)} N m/A): gravity changes by "
                f"only {one.gravity_span_nm:.2f} N m along the sweep"
            )
        if c.standard_error <= FRICTION_ERROR_MAX_NM:
            frictions.append(c)
        else:
            notes.append(f"joint {number}: the data do not determine the dry friction ({c.text(3)} N m)")
        if abs(off.value) > LEVEL_DEG + _SURE * off.standard_error:
            turned = f"gravity acts as if the arm were turned by {off.value:+.1f} deg"
            notes.append(f"joint {number}: {turned}: check that the machine is level and the zero is correct")
    kinds = [joint.kind for joint in vehicle.arm.joints]
    constants = {
        kind: _constant(kind, [k for k, its in zip(known, kinds, strict=True) if its is kind], notes) for kind in kinds
    }
    return FrictionFit(fits, tuple(constants[kind] for kind in kinds), _together(frictions), tuple(notes))


def _constant(kind: ServoKind, found: Sequence[Estimate | None], notes: list[str]) -> Estimate | None:
    """Return the torque constant of one model from those of its servos, and note what contradicts it."""
    known = [one for one in found if one is not None]
    constant = _together(known)
    low, high = (share * kind.torque_per_amp_nm_a for share in PLAUSIBLE)
    if constant is not None and not low <= constant.value <= high:
        notes.append(
            f"{constant.value:.2f} N m/A is implausible for an {kind.name} ({low:.2g} to {high:.2g}): check the masses and centres of "
            "mass of the vehicle file first; nothing is proposed"
        )
        constant = None
    if len(known) > 1:
        a, b = min(known, key=lambda one: one.value), max(known, key=lambda one: one.value)
        apart = b.value - a.value
        if apart > JOINTS_SAME * a.value and apart > _SURE * math.hypot(a.standard_error, b.standard_error):
            notes.append(
                f"the joints' torque constants differ, {' and '.join(f'{one.value:.3f}' for one in known)} N m/A: servos of one model "
                "should agree; check the masses, lengths and centres of mass of the vehicle file"
            )
    return constant


def fit_joint(samples: Sequence[Sample], vehicle: Vehicle, joint: int) -> JointFit | None:
    """Fit one joint; return None if there are too few samples."""
    rows, currents, chains = _binned(samples, vehicle, joint)
    if len(currents) < BINS_MIN:
        return None
    sigmas = (math.inf, math.inf, math.inf, math.radians(LEVEL_DEG))
    robust = robust_fit(rows, currents, chains, sigmas, vehicle.arm.torque_constants_nm_a[joint])
    return _as_joint_fit(robust.theta, robust.covariance, rows, robust.scatter_a)


@dataclass(frozen=True, slots=True)
class RobustFit:
    """Robust regression of a joint's current."""

    theta: _Array
    """Factor of each column; the first is 1/K, the others are divided by K."""
    covariance: _Array
    """Covariance of the factors, inflated for correlated residuals."""
    scatter_a: float


def robust_fit(
    rows: _Array, currents: _Array, chains: list[int], sigmas: Sequence[float], constant_nm_a: float
) -> RobustFit:
    """Regress the currents on the rows, whose first column is the load.

    Args:
        rows: one row for each bin.
        currents: mean current of each bin, A.
        chains: bins with the same number follow each other without a gap.
        sigmas: standard deviation of the prior of each factor times K, about 0; infinite for none.
        constant_nm_a: the vehicle file's torque constant, for the scale of the priors.
    """
    # Repeated, because the weights and that of the prior depend on the scatter of the currents.
    known = [index for index, sigma in enumerate(sigmas) if math.isfinite(sigma)]
    columns = rows.shape[1]
    scatter, theta, covariance, weights = 0.01, np.zeros(columns), np.eye(columns), np.ones(len(currents))
    for _ in range(8):
        prior = np.zeros((len(known), columns))
        for row, index in enumerate(known):
            prior[row, index] = scatter / sigmas[index] * constant_nm_a
        root = np.sqrt(weights)
        design, wanted = np.vstack([rows * root[:, None], prior]), np.append(currents * root, np.zeros(len(known)))
        inverse = np.linalg.pinv(design.T @ design)
        theta = inverse @ design.T @ wanted
        residual = currents - rows @ theta
        weights = _huber(residual)
        clipped = weights * residual
        freedom = max(1.0, (len(currents) - 3) * float(np.mean(weights == 1.0)) ** 2)
        scatter = max(1e-4, math.sqrt(float(clipped @ clipped) / freedom))
        covariance = scatter**2 * _inflation(clipped, chains) * inverse
    return RobustFit(theta, covariance, scatter)


def _huber(residual: _Array) -> _Array:
    """Return Huber's weights, so that a moment in which the arm was touched or the computer stalled does not dominate the fit."""
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return np.minimum(1.0, HUBER * spread / np.maximum(np.abs(residual), 1e-9))


def _binned(samples: Sequence[Sample], vehicle: Vehicle, joint: int) -> tuple[_Array, _Array, list[int]]:
    """Return the rows of the design matrix, the currents, and the leg of each row."""
    manipulator = manipulator_of(vehicle)
    small = 1e-3
    bins: dict[tuple[int, int], list[tuple[float, ...]]] = {}
    began: dict[int, float] = {}
    for one in samples:
        since = one.t_s - began.setdefault(one.leg, one.t_s)
        turned: Joints = (one.angle_rad[0] + small, *one.angle_rad[1:])
        gravity = manipulator.gravity_torque_nm(one.angle_rad, IDENTITY_QUAT)[joint]
        slope = (manipulator.gravity_torque_nm(turned, IDENTITY_QUAT)[joint] - gravity) / small
        row = (gravity, float(one.direction), one.velocity_rad_s, slope, one.current_a)
        bins.setdefault((one.leg, int(since / BIN_S)), []).append(row)
    keys = sorted(bins)
    means = np.array([np.mean(bins[key], axis=0) for key in keys]).reshape(-1, 5)
    return means[:, :4], means[:, 4], [leg for leg, _ in keys]


def _inflation(residual: _Array, chains: list[int]) -> float:
    """Return the factor by which correlated neighbours increase a variance: (1 + r) / (1 - r) with their correlation r."""
    pairs = [(a, b) for a, b, i, j in zip(residual, residual[1:], chains, chains[1:], strict=False) if i == j]
    power = float(residual @ residual) / len(residual)
    if len(pairs) < BINS_MIN // 2 or power <= 0.0:
        return 1.0
    r = min(0.95, max(0.0, float(sum(a * b for a, b in pairs)) / len(pairs) / power))
    return (1.0 + r) / (1.0 - r)


def _as_joint_fit(theta: _Array, covariance: _Array, rows: _Array, scatter: float) -> JointFit:
    """Convert 1/K, c/K, b/K, e/K to K, c, b, e."""
    inverse = float(theta[0])
    if abs(inverse) < 1e-6:
        inverse = math.copysign(1e-6, inverse)
    k = 1.0 / inverse

    def ratio(index: int, scale: float = 1.0) -> Estimate:
        gradient = np.zeros(4)
        gradient[index] = k
        gradient[0] = -float(theta[index]) * k * k
        return Estimate(
            scale * float(theta[index]) * k, scale * math.sqrt(max(0.0, float(gradient @ covariance @ gradient)))
        )

    constant = Estimate(k, k * k * math.sqrt(max(0.0, float(covariance[0, 0]))))
    span = float(np.ptp(rows[:, 0]))
    return JointFit(
        torque_per_amp_nm_a=constant,
        dry_nm=ratio(1),
        viscous_nms=ratio(2),
        off_deg=ratio(3, math.degrees(1.0)),
        gravity_span_nm=span,
        residual_a=scatter,
        bins=len(rows),
    )


def _together(estimates: Sequence[Estimate]) -> Estimate | None:
    """Return the mean weighted by the standard errors, with a larger error if the values scatter more; None without values."""
    if not estimates:
        return None
    weights = [1.0 / max(one.standard_error, 1e-6) ** 2 for one in estimates]
    value = sum(w * one.value for w, one in zip(weights, estimates, strict=True)) / sum(weights)
    error = 1.0 / math.sqrt(sum(weights))
    if len(estimates) > 1:
        squares = sum(w * (one.value - value) ** 2 for w, one in zip(weights, estimates, strict=True))
        error *= max(1.0, math.sqrt(squares / (len(estimates) - 1)))
    return Estimate(value, error)
