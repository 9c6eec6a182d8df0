"""What a real PX4 must know to fly the machine of the simulated world: parameters that the world tells, and the operator's own."""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.config.vehicle import Airframe
from companion.px4.wanted import WANTED, simulated_values
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.params import PX4_DEFAULTS, VEHICLE_DEFAULTS, Value
from sitl.world.model import ROTORS, rotor_offset_m

BEFORE_BOOT: Mapping[str, Value] = {
    "SDLOG_MODE": 1,
    "SDLOG_PROFILE": 1 | 2 | 16,
    "SENS_IMU_MODE": 1,
    "EKF2_MULTI_IMU": 0,
}
"""Log from boot until disarmed, with the estimator's inputs and at a high rate; there is one IMU."""
ROLL_PITCH_SHARE = 1.0 / math.sqrt(2.0)
"""Of a roll or pitch command that reaches each rotor of a quad-x: PX4 scales its allocation matrix so
(ControlAllocationPseudoInverse::updateControlAllocationMatrixScale)."""

OF_THIS_MOTION_CAPTURE: Mapping[str, Value] = {"EKF2_EV_DELAY": 10.0}
"""ms, measured on 1.16.1: exposure to fusion takes 5 ms of latency, the wires, and half a period each of lockstep and of EKF2. The stub
has the latency alone, for which the 5 of configs/px4/indoor_mocap.params are right."""

NOT_EVERYWHERE = frozenset(wanted.name for wanted in WANTED if wanted.only)
"""Versions of PX4 differ: not each has all of these."""

_GAINS = (
    "MC_ROLL_P", "MC_PITCH_P", "MC_YAW_P", "MC_YAW_WEIGHT", "MC_ROLLRATE_MAX", "MC_PITCHRATE_MAX", "MC_YAWRATE_MAX", "MC_YAWRATE_P",
    "MC_YAWRATE_I", "MC_YAWRATE_D", "MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM", "MC_AIRMODE",
)  # fmt: skip
_MIXED_GAINS = (
    "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_PITCHRATE_P", "MC_PITCHRATE_I", "MC_PITCHRATE_D",
)  # fmt: skip


def rotor_geometry(airframe: Airframe) -> dict[str, Value]:
    """CA_ROTOR*: places in FRD (m) from the centre of mass, and the yaw reaction, positive for a rotor that turns counter-clockwise."""
    found: dict[str, Value] = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": 4}
    offset = rotor_offset_m(airframe)
    for i, (x, y, yaw) in enumerate(ROTORS):
        found[f"CA_ROTOR{i}_PX"] = x * offset
        found[f"CA_ROTOR{i}_PY"] = -y * offset
        found[f"CA_ROTOR{i}_KM"] = -yaw * airframe.yaw_torque_per_thrust_m
    return found


def parameters(airframe: Airframe, config: WorldConfig, hover_command: float) -> dict[str, Value]:
    """Everything that is set on a real PX4 before it flies, by name.

    Args:
        airframe: the rotors' geometry, of the vehicle file.
        config: of the world.
        hover_command: normalised thrust that truly holds the machine.
    """
    gains = {name: PX4_DEFAULTS[name] for name in _GAINS}
    mixed = {name: PX4_DEFAULTS[name] / ROLL_PITCH_SHARE for name in _MIXED_GAINS}
    return {
        **simulated_values(),
        **VEHICLE_DEFAULTS,
        **OF_THIS_MOTION_CAPTURE,
        **BEFORE_BOOT,
        **gains,
        **mixed,
        **rotor_geometry(airframe),
        "THR_MDL_FAC": 0.0,  # the world's rotors are linear in the command
        "MPC_THR_HOVER": hover_command * (1.0 + config.hover_thrust_error),
        "SIM_BAT_DRAIN": config.battery_life_s,
        "SIM_BAT_MIN_PCT": 0.0,
        "BAT1_N_CELLS": 4,
        **config.spoiled_px4_params(),
    }
