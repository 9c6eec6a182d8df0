"""Section `rotors` of the simulated world: thrust curve, differences between rotors, lag, drag and ground effect."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle, islice
from typing import Annotated, Final

from pydantic import Field

from companion.config.base import Fraction, NonNegative, Positive, RelativeError
from companion.config.document import Document
from companion.model.rotors import ROTORS_MAX
from companion.sitl_config.effects import Effect

BODY_DRAG_N_PER_M_S: Final = 0.25
"""Drag of the body over its airspeed in every world, in addition to that of the rotors."""
RotorErrors = Annotated[tuple[RelativeError, ...], Field(min_length=1, max_length=ROTORS_MAX)]


def repeat_for_rotors(document: Document, count: int) -> None:
    """Extend the lists of the rotors' errors in a world's document to `count` rotors by starting them again from their beginning.

    A repeated distribution is then drawn separately for each rotor.
    """
    rotors = document.data.get("rotors")
    for key in ("thrust_error", "yaw_torque_error"):
        errors = rotors.get(key) if isinstance(rotors, dict) else None
        if isinstance(errors, list) and errors:
            errors.extend(islice(cycle(errors.copy()), len(errors), max(count, len(errors))))


def of_rotors(errors: Sequence[float], count: int) -> tuple[float, ...]:
    """Return one error per rotor; the list starts again from its beginning if the vehicle has more rotors."""
    return tuple(islice(cycle(errors), count))


class Rotors(Effect):
    """The rotors of the simulated world. At full signal, their nominal total thrust is the vehicle file's `thrust_max_n`."""

    thrust_curve: Fraction = 0.5
    """f of the true static curve: thrust / full thrust = f s^2 + (1 - f) s at motor signal s. PX4's multirotor airframes set 0.25 to
    0.35 (p: ROMFS/px4fmu_common/init.d/airframes); ArduPilot's default for the same curve is 0.65 (p: MOT_THST_EXPO).
    """
    thr_mdl_fac: Fraction = 0.3
    """PX4's THR_MDL_FAC, the factor of the curve that PX4 assumes and inverts (p: 0.3 in PX4's airframes generic_250, qav250,
    px4vision).
    """
    lag_up_s: Positive = 0.04
    """Time constant of a rotor that speeds up; replaces `world.rotor_lag_s` (e: 13-inch propellers, 0.03 to 0.05)."""
    lag_down_s: Positive = 0.07
    """Time constant of a rotor that slows down, without active braking (e: 0.06 to 0.08; p: twice `lag_up_s` in RotorS and in PX4's
    Gazebo x500)."""
    thrust_error: RotorErrors = (0.015, -0.02, 0.01, -0.005)
    """Relative error of each rotor's thrust at a given signal, in PX4's order (e: +-0.03). The list starts again from its beginning if
    the vehicle has more rotors."""
    yaw_torque_error: RotorErrors = (0.05, -0.03, -0.05, 0.03)
    """Relative error of each rotor's yaw torque at a given thrust (e: +-0.1 for propellers and motor mounts), listed like
    `thrust_error`."""
    drag_s_m: NonNegative = 0.02
    """Rotor drag (H-force) divided by thrust and by the airspeed across the rotor axis (p: 0.0124 from the coefficients of PX4's
    Gazebo x500,
    0.0153 from PX4's default EKF2_MCOEF of 0.15 1/s, 0.039 and 0.055 from Faessler et al. 2018, 0.386 and 0.544 1/s)."""
    radius_m: Positive = 0.165
    """Radius of a rotor, for ground effect and downwash (m: 13-inch propellers of the Tarot 650 Sport)."""
    ground_body_lift: NonNegative = 2.0
    """Body lift coefficient of the ground effect (p: K_b of Sanchez-Cuevas et al. 2017)."""
