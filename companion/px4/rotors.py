"""Compares the rotors of PX4's control allocation (CA_ROTORi_PX, _PY, _KM) with those of the vehicle file."""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.config.airframe import Airframe
from companion.model.rotors import CCW, RotorLayout
from companion.px4.wanted import Value

AWAY_MAX = 0.25
"""Largest distance of a rotor in PX4 from its place in the vehicle file, as a fraction of the mean rotor arm. Of eight rotors on a
circle, neighbours are 0.77 apart."""


def geometry_of(airframe: Airframe) -> dict[str, Value]:
    """Return a vehicle's CA_ROTORi_*: positions from the body origin (FRD, m), and KM, positive for counter-clockwise rotors."""
    layout, found = airframe.rotor_layout, dict[str, Value]()
    for index, ((x, y, z), spin) in enumerate(zip(layout.positions_body_m, layout.spins, strict=True)):
        found[f"CA_ROTOR{index}_PX"] = x
        found[f"CA_ROTOR{index}_PY"] = -y
        found[f"CA_ROTOR{index}_PZ"] = -z
        found[f"CA_ROTOR{index}_KM"] = spin * airframe.yaw_torque_per_thrust_m
    return found


def names(count: int) -> tuple[str, ...]:
    """Return the names of the parameters that `differences` compares for this number of rotors."""
    return tuple(f"CA_ROTOR{index}_{key}" for index in range(count) for key in ("PX", "PY", "KM"))


def differences(params: Mapping[str, Value], layout: RotorLayout) -> list[str] | None:
    """Return one text for each rotor that PX4 has elsewhere, or spinning the other way; None if PX4 lacks one of the parameters.

    PX4's positions may have any scale, which its allocation normalises away, as in the generic airframes of PX4.
    """
    if any(name not in params for name in names(layout.count)):
        return None
    rows = [tuple(float(params[f"CA_ROTOR{i}_{key}"]) for key in ("PX", "PY", "KM")) for i in range(layout.count)]
    reach_m = sum(math.hypot(x, y) for x, y, _ in rows) / layout.count
    found = []
    for index, ((x, y, _), spin, (px, py, km)) in enumerate(
        zip(layout.positions_body_m, layout.spins, rows, strict=True)
    ):
        scale = layout.arm_m / reach_m if reach_m > 0.0 else 0.0
        away_m = math.hypot(scale * px - x, -scale * py - y)
        if away_m > AWAY_MAX * layout.arm_m or km * spin <= 0.0:
            in_px4 = f"{_place(px, -py)}, {_spin(km)}"
            found.append(f"CA_ROTOR{index} is {in_px4} (vehicle file: {_place(x, y)}, {_spin(spin)})")
    return found


def _place(x_m: float, y_m: float) -> str:
    """Return where a rotor is, seen from the body origin: the angle from straight ahead."""
    if not math.hypot(x_m, y_m) > 0.0:
        return "at the centre"
    angle_deg = round(math.degrees(math.atan2(y_m, x_m)))
    if angle_deg in (0, 180, -180):
        return "ahead" if angle_deg == 0 else "behind"
    return f"{abs(angle_deg)} deg to the {'left' if angle_deg > 0 else 'right'}"


def _spin(sign: float) -> str:
    return "without yaw torque" if sign == 0.0 else "ccw" if sign * CCW > 0.0 else "cw"
