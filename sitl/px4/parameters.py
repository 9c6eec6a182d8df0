"""Parameters set on a real PX4 so that it can fly the simulated vehicle: those that the simulation requires, then the user's
overrides.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.config.airframe import Airframe
from companion.px4.required import simulated_values
from companion.px4.rotors import geometry_of
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.params import PX4_DEFAULTS, VEHICLE_DEFAULTS, Value, mav_type

BEFORE_BOOT: Mapping[str, Value] = {
    "SDLOG_MODE": 1,
    "SDLOG_PROFILE": 1 | 2 | 16,
    "SENS_IMU_MODE": 1,
    "EKF2_MULTI_IMU": 0,
}
"""Parameters set before PX4 boots: one IMU, and logging from boot until disarming, at a high rate and with the estimator's inputs."""
ROLL_PITCH_SHARE = 1.0 / math.sqrt(2.0)
"""Root mean square of the fractions of a roll or pitch command that reach the rotors, given by the scale of PX4's allocation matrix
(ControlAllocationPseudoInverse::updateControlAllocationMatrixScale).
"""

_GAINS = (
    "MC_ROLL_P", "MC_PITCH_P", "MC_YAW_P", "MC_YAW_WEIGHT", "MC_ROLLRATE_MAX", "MC_PITCHRATE_MAX", "MC_YAWRATE_MAX", "MC_YAWRATE_P",
    "MC_YAWRATE_I", "MC_YAWRATE_D", "MC_RR_INT_LIM", "MC_PR_INT_LIM", "MC_YR_INT_LIM", "MC_AIRMODE",
)  # fmt: skip
_MIXED_GAINS = (
    "MC_ROLLRATE_P", "MC_ROLLRATE_I", "MC_ROLLRATE_D", "MC_PITCHRATE_P", "MC_PITCHRATE_I", "MC_PITCHRATE_D",
)  # fmt: skip
_MOTOR_1 = 101
"""PX4's output function of the first motor."""


def rotor_geometry(airframe: Airframe) -> dict[str, Value]:
    """Return MAV_TYPE, the parameters CA_*, and the outputs of the rotors.

    PX4's simulator sends the outputs PWM_MAIN in HIL_ACTUATOR_CONTROLS.
    """
    layout = airframe.rotor_layout
    outputs = {f"PWM_MAIN_FUNC{i + 1}": _MOTOR_1 + i for i in range(layout.count)}
    kind = {"CA_AIRFRAME": 0, "CA_ROTOR_COUNT": layout.count, "MAV_TYPE": mav_type(layout.count)}
    return {**kind, **geometry_of(airframe), **outputs}


SIMULATORS_OWN = "CBRK_SUPPLY_CHK"
"""PX4's simulator keeps its own value: that of 1.15 has no supply voltage, and its check would refuse to arm."""


def parameters(airframe: Airframe, config: WorldConfig, hover_command: float) -> dict[str, Value]:
    """Return every parameter that is set on a real PX4 before it flies, by name.

    Args:
        hover_command: true normalised hover thrust.
    """
    gains = {name: PX4_DEFAULTS[name] for name in _GAINS}
    mixed = {name: PX4_DEFAULTS[name] / ROLL_PITCH_SHARE for name in _MIXED_GAINS}
    required = {
        name: value for name, value in {**simulated_values(), **VEHICLE_DEFAULTS}.items() if name != SIMULATORS_OWN
    }
    return {
        **required,
        **BEFORE_BOOT,
        **gains,
        **mixed,
        **rotor_geometry(airframe),
        "THR_MDL_FAC": config.thr_mdl_fac,
        "MPC_THR_HOVER": hover_command * (1.0 + config.hover_thrust_error),
        "SIM_BAT_ENABLE": int(not config.battery.on),  # with this effect the world sends the battery's state
        "SIM_BAT_DRAIN": 0.0
        if config.battery.on
        else config.battery_life_s,  # the same for a PX4 without SIM_BAT_ENABLE
        "SIM_BAT_MIN_PCT": 0.0,
        "BAT1_N_CELLS": airframe.battery_cells,
        **config.overridden_px4_params(),
    }
