"""Torque constant, dry and viscous friction of both joints, from slow sweeps against gravity. Pure.

At constant speed a joint's motor carries gravity and friction alone: `K i = G(alpha) + c sign(rate) + b rate`, with G from the
vehicle file's masses. Divided by K this is linear in 1/K, c/K and b/K; a fourth unknown is the small angle by which the machine is
not level and the zero is off, which a person keeps within `LEVEL_DEG`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from companion.commissioning.arm.sweep import Sample
from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.control.manipulator import Manipulator
from companion.model.types import IDENTITY_QUAT, Vec2

BIN_S: Final = 0.25
"""Samples are averaged over so long: what the control loop does from tick to tick is no noise of its own each time."""
BINS_MIN: Final = 12
LEVEL_DEG: Final = 2.0
CONSTANT_ERROR_MAX: Final = 0.05
"""Relative standard error beyond which a torque constant is not told."""
FRICTION_ERROR_MAX_NM: Final = 0.015
CONSTANT_SAME: Final = 0.02
FRICTION_SAME_NM: Final = 0.008
"""Nearer than this to the vehicle file is the same."""
JOINTS_SAME: Final = 0.06
"""Torque constants of two servos of one kind."""
PLAUSIBLE_NM_A: Final = (0.7, 2.2)
"""Of an XM430-W210, whose stall torque and current make 1.3."""
_SURE: Final = 3.0
"""Standard errors."""

_Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value and its standard error, in the same unit."""

    value: float
    error: float

    def as_json(self) -> dict[str, float]:
        """For `--json`."""
        return {"value": self.value, "standard_error": self.error}


@dataclass(frozen=True, slots=True)
class JointFit:
    """One joint."""

    torque_per_amp_nm_a: Estimate
    dry_nm: Estimate
    viscous_nms: Estimate
    off_deg: Estimate
    """The angle by which gravity pulls otherwise than the joint angles say."""
    gravity_span_nm: float
    """Between the ends of the sweep."""
    residual_a: float
    bins: int

    @property
    def tells_constant(self) -> bool:
        """The torque constant is known well enough."""
        found = self.torque_per_amp_nm_a
        return found.error <= CONSTANT_ERROR_MAX * abs(found.value)

    @property
    def tells_friction(self) -> bool:
        """The dry friction is known well enough."""
        return self.dry_nm.error <= FRICTION_ERROR_MAX_NM

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        return {
            "torque_per_amp_nm_a": self.torque_per_amp_nm_a.as_json(),
            "dry_nm": self.dry_nm.as_json(),
            "viscous_nms": self.viscous_nms.as_json(),
            "off_deg": self.off_deg.as_json(),
            "gravity_span_nm": self.gravity_span_nm,
            "residual_a": self.residual_a,
            "bins": self.bins,
        }


@dataclass(frozen=True, slots=True)
class FrictionFit:
    """Both joints, and what the vehicle file should say."""

    joints: tuple[JointFit | None, JointFit | None]
    """None: too few samples."""
    torque_per_amp_nm_a: Estimate | None
    """Of both; None: the data cannot tell."""
    joint_friction_nm: Estimate | None
    notes: tuple[str, ...]
    """What somebody should know, one line each."""

    def changes(self, vehicle: Vehicle) -> dict[Location, Data]:
        """For the vehicle file; empty: it is right as far as the data can tell."""
        wanted: dict[Location, Data] = {}
        found, have = self.torque_per_amp_nm_a, vehicle.arm.torque_per_amp_nm_a
        if found is not None and abs(found.value - have) > max(CONSTANT_SAME * have, _SURE * found.error):
            wanted[("arm", "torque_per_amp_nm_a")] = round(found.value, 3)
        found, have = self.joint_friction_nm, vehicle.arm.joint_friction_nm
        if found is not None and abs(found.value - have) > max(FRICTION_SAME_NM, _SURE * found.error):
            wanted[("arm", "joint_friction_nm")] = max(0.0, round(found.value, 3))
        return wanted


def fit(samples: Sequence[Sample], vehicle: Vehicle) -> FrictionFit:
    """Fit both joints.

    Args:
        samples: of both joints' sweeps, both ways, at two speeds or more.
        vehicle: masses, lengths; its torque constant and friction are what is compared with.
    """
    first, second = (fit_joint([one for one in samples if one.joint == joint], vehicle, joint) for joint in (0, 1))
    notes: list[str] = []
    constants = _telling(first, second, "constant", notes)
    frictions = _telling(first, second, "friction", notes)
    constant = _together([one.torque_per_amp_nm_a for one in constants])
    if constant is not None and not PLAUSIBLE_NM_A[0] <= constant.value <= PLAUSIBLE_NM_A[1]:
        low, high = PLAUSIBLE_NM_A
        notes.append(
            f"{constant.value:.2f} N m/A is none of an XM430-W210 ({low} to {high}): look at the masses and centres of mass of "
            "the vehicle file first; nothing is proposed"
        )
        constant = None
    if len(constants) == 2:
        a, b = (one.torque_per_amp_nm_a for one in constants)
        apart = abs(a.value - b.value)
        if apart > JOINTS_SAME * a.value and apart > _SURE * math.hypot(a.error, b.error):
            notes.append(
                f"the joints' torque constants differ, {a.value:.3f} and {b.value:.3f} N m/A: servos of one kind do not; look at the "
                "masses, lengths and centres of mass of the vehicle file"
            )
    for joint, one in enumerate((first, second)):
        if one is not None and abs(one.off_deg.value) > LEVEL_DEG + _SURE * one.off_deg.error:
            turned = f"gravity pulls as if the arm were turned by {one.off_deg.value:+.1f} deg"
            notes.append(f"joint {joint + 1}: {turned}: is the machine level, is zero right?")
    return FrictionFit((first, second), constant, _together([one.dry_nm for one in frictions]), tuple(notes))


def _telling(first: JointFit | None, second: JointFit | None, what: str, notes: list[str]) -> list[JointFit]:
    telling = []
    for joint, one in enumerate((first, second)):
        name = f"joint {joint + 1}"
        if one is None:
            if what == "constant":
                notes.append(f"{name}: too few samples at constant speed, the data cannot tell anything")
        elif what == "constant" and not one.tells_constant:
            k = one.torque_per_amp_nm_a
            notes.append(
                f"{name}: the data cannot tell the torque constant ({k.value:.2f} +- {k.error:.2f} N m/A): gravity changes by "
                f"{one.gravity_span_nm:.2f} N m along the sweep alone"
            )
        elif what == "friction" and not one.tells_friction:
            c = one.dry_nm
            notes.append(f"{name}: the data cannot tell the dry friction ({c.value:.3f} +- {c.error:.3f} N m)")
        else:
            telling.append(one)
    return telling


def fit_joint(samples: Sequence[Sample], vehicle: Vehicle, joint: int) -> JointFit | None:
    """One joint; None: too few samples."""
    rows, currents, chains = _binned(samples, vehicle, joint)
    if len(currents) < BINS_MIN:
        return None
    # Twice: the first time tells how much the currents scatter, which is what the one prior is weighed against.
    scatter, theta, covariance = 0.01, np.zeros(4), np.eye(4)
    for _ in range(3):
        prior = np.array([[0.0, 0.0, 0.0, scatter / math.radians(LEVEL_DEG) * vehicle.arm.torque_per_amp_nm_a]])
        design, wanted = np.vstack([rows, prior]), np.append(currents, 0.0)
        inverse = np.linalg.pinv(design.T @ design)
        theta = inverse @ design.T @ wanted
        residual = currents - rows @ theta
        freedom = max(1, len(currents) - 3)
        scatter = max(1e-4, math.sqrt(float(residual @ residual) / freedom))
        covariance = scatter**2 * _inflation(residual, chains) * inverse
    return _as_joint_fit(theta, covariance, rows, scatter)


def _binned(samples: Sequence[Sample], vehicle: Vehicle, joint: int) -> tuple[_Array, _Array, list[int]]:
    """Rows of the design, currents, and the leg of each."""
    manipulator = Manipulator(vehicle.arm, vehicle.tool)
    small = 1e-3
    bins: dict[tuple[int, int], list[tuple[float, ...]]] = {}
    began: dict[int, float] = {}
    for one in samples:
        since = one.t_s - began.setdefault(one.leg, one.t_s)
        turned: Vec2 = (one.angle_rad[0] + small, one.angle_rad[1])
        gravity = manipulator.gravity_torque_nm(one.angle_rad, IDENTITY_QUAT)[joint]
        slope = (manipulator.gravity_torque_nm(turned, IDENTITY_QUAT)[joint] - gravity) / small
        row = (gravity, float(one.direction), one.velocity_rad_s, slope, one.current_a)
        bins.setdefault((one.leg, int(since / BIN_S)), []).append(row)
    keys = sorted(bins)
    means = np.array([np.mean(bins[key], axis=0) for key in keys]).reshape(-1, 5)
    return means[:, :4], means[:, 4], [leg for leg, _ in keys]


def _inflation(residual: _Array, chains: list[int]) -> float:
    """By how much neighbours that err alike widen a variance: (1 + r) / (1 - r) with their correlation r."""
    pairs = [(a, b) for a, b, i, j in zip(residual, residual[1:], chains, chains[1:], strict=False) if i == j]
    power = float(residual @ residual) / len(residual)
    if len(pairs) < BINS_MIN // 2 or power <= 0.0:
        return 1.0
    r = min(0.95, max(0.0, float(sum(a * b for a, b in pairs)) / len(pairs) / power))
    return (1.0 + r) / (1.0 - r)


def _as_joint_fit(theta: _Array, covariance: _Array, rows: _Array, scatter: float) -> JointFit:
    """From 1/K, c/K, b/K, e/K to K, c, b, e."""
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
    return JointFit(constant, ratio(1), ratio(2), ratio(3, math.degrees(1.0)), span, scatter, len(rows))


def _together(estimates: Sequence[Estimate]) -> Estimate | None:
    """Weighed by their standard errors; where they scatter more than these say, they are believed less."""
    if not estimates:
        return None
    weights = [1.0 / max(one.error, 1e-6) ** 2 for one in estimates]
    value = sum(w * one.value for w, one in zip(weights, estimates, strict=True)) / sum(weights)
    error = 1.0 / math.sqrt(sum(weights))
    if len(estimates) > 1:
        scatter = sum(w * (one.value - value) ** 2 for w, one in zip(weights, estimates, strict=True)) / (
            len(estimates) - 1
        )
        error *= max(1.0, math.sqrt(scatter))
    return Estimate(value, error)
