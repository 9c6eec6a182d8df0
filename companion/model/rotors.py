"""The rotors of a multirotor: PX4's standard layouts, and how PX4 allocates torques and thrust to the rotors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from companion.model.types import Vec3

ROTORS_MIN, ROTORS_MAX = 4, 12
"""Fewest rotors that control roll, pitch, yaw and thrust, and most rotors of PX4 (ActuatorEffectivenessRotors::NUM_ROTORS_MAX)."""
LayoutName = Literal["quad_x", "quad_plus", "hexa_x", "hexa_plus", "octa_x", "octa_plus"]
CW, CCW = -1, 1
"""Spin directions seen from above."""

LAYOUTS: Mapping[LayoutName, tuple[tuple[float, int], ...]] = {
    "quad_x": ((-45.0, CCW), (135.0, CCW), (45.0, CW), (-135.0, CW)),
    "quad_plus": ((-90.0, CCW), (90.0, CCW), (0.0, CW), (180.0, CW)),
    "hexa_x": ((-90.0, CW), (90.0, CCW), (30.0, CW), (-150.0, CCW), (-30.0, CCW), (150.0, CW)),
    "hexa_plus": ((0.0, CW), (180.0, CCW), (120.0, CW), (-60.0, CCW), (60.0, CCW), (-120.0, CW)),
    "octa_x": (
        (-22.5, CW), (157.5, CW), (-67.5, CCW), (-157.5, CCW), (22.5, CCW), (112.5, CCW), (67.5, CW), (-112.5, CW),
    ),
    "octa_plus": (
        (0.0, CW), (180.0, CW), (-45.0, CCW), (-135.0, CCW), (45.0, CCW), (135.0, CCW), (90.0, CW), (-90.0, CW),
    ),
}  # fmt: skip
"""Rotors of each standard layout in PX4's order: angle of the rotor from the body's x axis to the left in deg, and spin direction.

The layouts are those of PX4's airframes 4001, 5001, 6001, 7001, 8001 and 9001 (ROMFS/px4fmu_common/init.d/airframes and
src/lib/mixer/MultirotorMixer/geometries)."""

_SINGULAR = 1e-6
_SMALL = 1e-3
"""Magnitude below which PX4 sets an element of the allocation matrix to zero."""


@dataclass(frozen=True, slots=True)
class RotorLayout:
    """Positions and spin directions of N rotors whose thrust points along the body's z axis, in PX4's order."""

    positions_body_m: tuple[Vec3, ...]
    """Position of each rotor, body FLU."""
    spins: tuple[int, ...]
    """Spin direction of each rotor seen from above, `CW` or `CCW`."""
    arm_m: float
    """Mean distance of the rotors from the body's z axis."""

    @property
    def count(self) -> int:
        """Number of rotors."""
        return len(self.spins)

    @property
    def height_m(self) -> float:
        """Height of the lowest rotor above the body origin."""
        return min(z for _, _, z in self.positions_body_m)


class SingularLayoutError(ValueError):
    """The rotors cannot control roll, pitch, yaw and thrust; the text states what they cannot do."""


def standard_layout(name: LayoutName, arm_m: float, height_m: float) -> RotorLayout:
    """Return a standard layout whose rotors lie `arm_m` from the body's z axis and `height_m` above the body origin."""
    rows = LAYOUTS[name]
    positions = tuple((*_on_circle(angle_deg, arm_m), height_m) for angle_deg, _ in rows)
    return RotorLayout(positions, tuple(spin for _, spin in rows), arm_m)


def listed_layout(positions_body_m: Sequence[Vec3], spins: Sequence[int]) -> RotorLayout:
    """Return the layout of rotors that are given one by one."""
    arm_m = sum(math.hypot(x, y) for x, y, _ in positions_body_m) / len(positions_body_m)
    return RotorLayout(tuple(positions_body_m), tuple(spins), arm_m)


def logged_layout(airframe: Mapping[str, Any]) -> RotorLayout:
    """Return the layout in the section `airframe` of a logged configuration; older logs have no layout, the oldest no rotor arm.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the section is not that of a vehicle file.
    """
    listed = airframe.get("rotors")
    if listed:
        places = [(float(x), float(y), float(z)) for x, y, z in (rotor["position_body_m"] for rotor in listed)]
        return listed_layout(places, [CCW if rotor["spin"] == "ccw" else CW for rotor in listed])
    arm_m = float(airframe.get("rotor_arm_m", 0.6 * airframe["radius_m"]))
    return standard_layout(airframe.get("layout", "quad_x"), arm_m, float(airframe.get("rotor_height_m", 0.03)))


def disk_radius_m(rotors: RotorLayout, radius_m: float) -> float:
    """Return the radius of the rotor disks of a vehicle whose outermost blade reaches `radius_m` from the body's z axis."""
    return radius_m - max(math.hypot(x, y) for x, y, _ in rotors.positions_body_m)


def _on_circle(angle_deg: float, arm_m: float) -> tuple[float, float]:
    x, y = (round(of(math.radians(angle_deg)), 15) for of in (math.cos, math.sin))
    if angle_deg % 90.0 == 45.0:
        offset_m = arm_m / math.sqrt(2.0)
        return math.copysign(offset_m, x), math.copysign(offset_m, y)
    return arm_m * x, arm_m * y


def allocation(rotors: RotorLayout) -> tuple[tuple[float, float, float, float], ...]:
    """Return PX4's normalised allocation matrix.

    It is the pseudo-inverse of the effectiveness matrix, scaled as by ControlAllocationPseudoInverse of PX4 1.16: roll and pitch by
    the larger of the root mean squares of their non-zero elements times the root of 2, yaw by its largest element, thrust by its mean.

    Returns:
        Shape (N, 4): change of each rotor's command per unit of roll, pitch and yaw torque (FRD) and of collective thrust.

    Raises:
        SingularLayoutError: the rotors cannot control roll, pitch, yaw and thrust independently.
    """
    arm_m = rotors.arm_m or 1.0
    effects = [
        [y / arm_m for _, y, _ in rotors.positions_body_m],
        [x / arm_m for x, _, _ in rotors.positions_body_m],
        [1.0] * rotors.count,
        [float(spin) for spin in rotors.spins],
    ]
    if _inverse(_gram(effects[:3])) is None:
        raise SingularLayoutError("they lie on one line and cannot control roll and pitch independently")
    inverse = _inverse(_gram(effects))
    if inverse is None:
        raise SingularLayoutError(
            "their spin directions give no yaw torque that is independent of roll, pitch and thrust"
        )
    roll, pitch, thrust, yaw = (
        [sum(k * effect[i] for k, effect in zip(row, effects, strict=True)) for i in range(rotors.count)]
        for row in inverse
    )
    tilt_scale = max(_rms(roll), _rms(pitch)) * math.sqrt(2.0)
    scales = (tilt_scale, tilt_scale, max(yaw), sum(thrust) / rotors.count)
    return tuple(
        tuple(_without_noise(value / scale) for value, scale in zip(row, scales, strict=True))  # type: ignore[misc]
        for row in zip(roll, pitch, yaw, thrust, strict=True)
    )


def _without_noise(element: float) -> float:
    return 0.0 if abs(element) < _SMALL else element


def _rms(column: list[float]) -> float:
    """Return the root mean square of the non-zero elements."""
    used = [value * value for value in column if abs(value) > _SMALL]
    return math.sqrt(sum(used) / len(used))


def _gram(rows: list[list[float]]) -> list[list[float]]:
    return [[sum(a * b for a, b in zip(row, other, strict=True)) for other in rows] for row in rows]


def _inverse(matrix: list[list[float]]) -> list[list[float]] | None:
    """Return the inverse of a square matrix, or None if it is singular (Gauss-Jordan elimination)."""
    size = len(matrix)
    rows = [[*row, *(float(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    for k in range(size):
        best = max(range(k, size), key=lambda i: abs(rows[i][k]))
        if abs(rows[best][k]) < _SINGULAR:
            return None
        rows[k], rows[best] = rows[best], rows[k]
        pivot = rows[k][k]
        rows[k] = [value / pivot for value in rows[k]]
        for i in range(size):
            if i != k and rows[i][k]:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[size:] for row in rows]


def thrust_share(signal: float, factor: float) -> float:
    """Return the fraction of full thrust at a motor signal of 0 to 1; `factor` is defined like THR_MDL_FAC."""
    return signal * (factor * signal + 1.0 - factor)


def motor_signal(command: float, factor: float) -> float:
    """Return the motor signal (0 to 1) for a normalised thrust command (0 to 1). `factor` is THR_MDL_FAC: PX4 assumes that thrust is
    factor * signal^2 + (1 - factor) * signal (FunctionMotors::updateValues).
    """
    if factor <= 0.0 or command <= 0.0:
        return command
    half = (1.0 - factor) / (2.0 * factor)
    return math.sqrt(half * half + command / factor) - half
