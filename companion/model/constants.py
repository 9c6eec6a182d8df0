"""Physical constants and timing constants that several packages share."""

from __future__ import annotations

from typing import Final

GRAVITY_M_S2: Final = 9.81
"""Gravitational acceleration used by control, safety, preflight and the simulated world."""

STANDARD_GRAVITY_M_S2 = 9.80665
"""The unit g as defined by PX4 (CONSTANTS_ONE_G) and used in MAVLink messages in milli-g."""

TICK_PERIOD_S: Final = 0.005
"""Nominal period of the control loop: 200 Hz. A tick that starts more than one period late counts as missed."""

GRADED_POSE_MAX_AGE_S = 0.1
"""Maximum age at which telemetry and log analysis still compare a motion-capture pose with the reference."""

PX4_YAW_P: Final = 2.8
"""Rate of yaw at which PX4 turns, for each rad of its error, 1/s: the default of MC_YAW_P."""
