"""Section `compliance` of the simulated world: flexible arm links and a flexible arm mount."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import NonNegative
from companion.sitl_config.effects import Effect
from companion.sitl_config.effects.servo_mechanics import GEAR_MIN_DEG_PER_NM

DegPerNm = Annotated[float, Field(ge=GEAR_MIN_DEG_PER_NM, le=10)]


class Compliance(Effect):
    """Springs about the joints' axes, one in series with each joint, whose deflection the servos' encoders do not measure."""

    mount_deg_per_nm: DegPerNm = 1.0
    """Tilt of the shoulder servo and its mount under the shoulder's torque, deg per N m (e: 0.5 to 2)."""
    link_deg_per_nm: DegPerNm = 1.0
    """Rotation of the next joint, or of the tool, relative to a servo's output shaft under that servo's torque, deg per N m, for every
    joint but the shoulder: twist of the horn and bending of the link (e: 0.5 to 2)."""
    relaxation_s: NonNegative = 0.0006
    """Damping divided by stiffness of both springs (e: 2 to 4 % of critical damping at the arm's frequencies of 10 to 20 Hz)."""
