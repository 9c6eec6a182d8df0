"""Physical and timing constants that several packages share."""

from __future__ import annotations

GRAVITY_M_S2 = 9.81
"""Gravity in control, safety, preflight and the simulated world."""

STANDARD_GRAVITY_M_S2 = 9.80665
"""The unit g of PX4 (CONSTANTS_ONE_G) and of MAVLink messages in milli-g."""

TICK_PERIOD_S = 0.005
"""Nominal period of the control loop: 200 Hz. A tick that starts more than this behind its schedule is missed."""

GRADED_POSE_MAX_AGE_S = 0.1
"""Max age of a motion-capture pose that telemetry and log analysis compare with the reference."""
