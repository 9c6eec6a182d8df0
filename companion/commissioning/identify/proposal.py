"""What follows from the identified quantities: changes to the vehicle file, and a world fitted to the machine."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import Any

from companion.commissioning.arm.friction import one_constant
from companion.commissioning.identify.identification import Identification
from companion.commissioning.identify.quantity import Quantity
from companion.config.base import Location
from companion.config.document import Data
from companion.config.shipped import shipped_file
from companion.config.yaml_strict import read_document
from companion.config.yaml_text import flow_text
from companion.model.constants import GRAVITY_M_S2
from companion.model.rotors import motor_signal, thrust_share
from companion.sitl_config.effects.rotors import BODY_DRAG_N_PER_M_S

BASE = "lab"
_DELAY_S = 0.012
"""Delay of a setpoint in the laboratory: `setpoint_delay_s` and the link."""
_REACTION_S = 0.014
"""Part of the thrust lag that is not the rotors': that delay and the IMU's averaging."""
_ERROR_MAX = 0.5
"""Largest relative error that a world accepts."""


HOVER_THRUST = ("airframe", "hover_thrust")
"""Key of a vehicle file; a file without it leaves the hover thrust to PX4's MPC_THR_HOVER, with whose value the log has the key."""


def vehicle_changes(found: Identification) -> dict[Location, Data]:
    """Return the values of the flight's vehicle that contradict the flight: those outside of the 95 % intervals."""
    arm, hover = found.flight.vehicle.arm, found["hover_thrust"]
    configured = found.flight.vehicle.airframe.hover_thrust
    changes: dict[Location, Data] = {}
    if hover.value is not None and configured is not None and not hover.contains(configured):
        changes[HOVER_THRUST] = round(hover.value, 4)
    together = one_constant(arm)
    constants = [found[f"joint{number + 1}_torque_per_amp_nm_a"] for number in range(len(arm.joints))]
    wrong = [one.known and not one.contains(has) for one, has in zip(constants, arm.torque_constants_nm_a, strict=True)]
    if together and constants and all(wrong):
        changes["arm", "torque_per_amp_nm_a"] = round(_mean(constants), 3)
    elif not together:
        for index, (one, is_wrong) in enumerate(zip(constants, wrong, strict=True)):
            if is_wrong and one.value is not None:
                changes["arm", "joints", index, "torque_per_amp_nm_a"] = round(one.value, 3)
    frictions = [found[f"joint{number + 1}_friction_nm"] for number in range(len(arm.joints))]
    if frictions and all(one.known and not one.contains(arm.joint_friction_nm) for one in frictions):
        changes["arm", "joint_friction_nm"] = round(_mean(frictions), 3)
    return changes


def _mean(quantities: list[Quantity]) -> float:
    return statistics.mean(one.value for one in quantities if one.value is not None)


def world_text(found: Identification, name: str) -> str:
    """Return a world file: the laboratory with what was identified in place of its draws."""
    lab: dict[str, Any] = read_document(shipped_file("worlds", BASE)).data
    lines = [
        "# yaml-language-server: $schema=../schema/world.schema.json",
        f"# The laboratory, fitted to the flight {name} by companion identify.",
        "# Every value that the flight does not show is drawn as in the laboratory. A section that is given replaces that of",
        f"# {BASE}.yaml, so it is repeated in full.",
        f"extends: {BASE}",
    ]
    for section, keys in _world(found, lab).items():
        if "" in keys:
            value, remark = keys[""]
            lines += ["", f"{section}: {flow_text(value)}  # {remark}"]
            continue
        own = lab[section]
        lines += ["", f"{section}:"]
        for key, value in {**own, **{key: value for key, (value, _) in keys.items()}}.items():
            remark = f"  # {keys[key][1]}" if key in keys else ""
            lines.append(f"  {key}: {flow_text(value)}{remark}")
    return "\n".join(lines) + "\n"


_Found = dict[str, dict[str, tuple[Any, str]]]
"""Values of a world file, each with its remark, by section and key. A key outside of all sections has a section of its own name."""


def _world(found: Identification, lab: Mapping[str, Any]) -> _Found:
    world: _Found = {}
    rotors, hover, lag = dict[str, tuple[Any, str]](), found["hover_thrust"], found["thrust_lag_s"]
    if hover.value is not None:
        share = round(hover.sigma / hover.value, 4)
        world["hover_thrust_error"] = {
            "": (_normal(0.0, share), "once hover_thrust or MPC_THR_HOVER is set as proposed")
        }
        error = _thrust_error(found, lab)
        if error is not None:
            count = found.flight.vehicle.airframe.rotor_layout.count
            remark = f"hover thrust {hover.value:.4f} as flown"
            rotors["thrust_error"] = ([_normal(round(error, 3), 0.01)] * count, remark)
    if lag.value is not None:
        up, down = _ends(lab, "lag_up_s"), _ends(lab, "lag_down_s")
        # Rotors that speed up faster than they slow down follow small changes with the harmonic mean.
        usual = statistics.harmonic_mean([sum(up) / 2.0, sum(down) / 2.0])
        low, high = (max(0.01, end - _REACTION_S) / usual for end in lag.interval)
        for key, (least, most) in (("lag_up_s", up), ("lag_down_s", down)):
            middle = 0.5 * (least + most)
            rotors[key] = (_uniform(low * middle, high * middle), f"thrust lag {1e3 * lag.value:.0f} ms in all")
    drag = found["drag_1_s"]
    if drag.value is not None:
        body = BODY_DRAG_N_PER_M_S / found.flight.vehicle.airframe.mass_kg
        low, high = (max(0.0, (end - body) / GRAVITY_M_S2) for end in drag.interval)
        if high > low:
            rotors["drag_s_m"] = (_uniform(low, high), f"drag over mass {drag.value:.2f} 1/s")
    if rotors:
        world["rotors"] = rotors
    gains = {
        parameter: round(1.0 / (one.value - _DELAY_S), 2)
        for parameter, one in (("MC_ROLL_P", found["roll_lag_s"]), ("MC_PITCH_P", found["pitch_lag_s"]))
        if one.value is not None and one.value > 2.0 * _DELAY_S
    }
    if gains:
        world["px4_params"] = {"": (gains, "lag of the attitude loop: 1 / gain + delay")}
    delay = found["mocap_delay_s"]
    if delay.value is not None:
        world["mocap_latency_s"] = {"": (round(max(0.0, delay.value), 4), delay.how)}
    carried = found["payload_kg"]
    if carried.value is not None:
        world["payload_kg"] = {"": (_uniform(*carried.interval), carried.how)}
    world |= _servos(found)
    return world


def _servos(found: Identification) -> _Found:
    count = len(found.flight.vehicle.arm.joints)
    constants = [found[f"joint{number + 1}_torque_per_amp_nm_a"] for number in range(count)]
    configured = found.flight.vehicle.arm.torque_constants_nm_a
    if not any(one.known for one in constants):
        return {}
    errors = [
        _errors(*one.interval, has) if one.known else {"uniform": [-0.1, 0.1]}
        for one, has in zip(constants, configured, strict=True)
    ]
    return {
        "servo_mechanics": {"torque_per_amp_error": (errors, "torque constants as flown, against the vehicle file")}
    }


def _errors(low: float, high: float, configured: float) -> dict[str, list[float]]:
    """Return the range of the configured value's relative error, as far as a world accepts it."""
    ends = [max(-_ERROR_MAX, min(_ERROR_MAX, configured / max(end, 1e-6) - 1.0)) for end in (high, low)]
    return _uniform(ends[0], ends[1]) if ends[0] < ends[1] else {"uniform": [-0.1, 0.1]}


def _thrust_error(found: Identification, lab: Mapping[str, Any]) -> float | None:
    """Return the relative error of all rotors with which the laboratory's hover thrust, at the voltage flown, is that of the flight."""
    hover, fit = found["hover_thrust"].value, found.hover
    if hover is None or fit is None or fit.voltage_mean_v is None:
        return None
    airframe = found.flight.vehicle.airframe
    battery, rotors = lab["battery"], lab["rotors"]
    full_v = statistics.mean(battery["full_thrust_v"]["uniform"]) * airframe.battery_cells / 4.0
    signal = motor_signal(hover, rotors.get("thr_mdl_fac", 0.3))
    share = thrust_share(signal, statistics.mean(rotors["thrust_curve"]["uniform"]))
    full_n = airframe.thrust_max_n * (fit.voltage_mean_v / full_v) ** 2
    error = GRAVITY_M_S2 * airframe.mass_kg / (share * full_n) - 1.0
    return error if abs(error) + 3.0 * 0.01 < _ERROR_MAX and math.isfinite(error) else None


def _ends(lab: Mapping[str, Any], key: str) -> tuple[float, float]:
    rotors = lab["rotors"]
    low, high = rotors[key]["uniform"]
    return low, high


def _uniform(low: float, high: float) -> dict[str, list[float]]:
    return {"uniform": [float(f"{low:.3g}"), float(f"{high:.3g}")]}


def _normal(mean: float, sigma: float) -> dict[str, list[float]]:
    return {"normal": [mean, max(1e-4, sigma)]}
