"""The trial of a control law on the ground: a law that cannot be built, raises an exception or returns a malformed command is
refused.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from itertools import product
from typing import Any

import msgspec
from msgspec.structs import replace

from companion.config.controller import ControllerConfig, law_class
from companion.config.vehicle import Vehicle
from companion.control.types import Law, PlantState, Wrench
from companion.model.constants import TICK_PERIOD_S
from companion.model.types import IDENTITY_QUAT, Joints, Reference, Vec3
from companion.plugins import CONTROL_LAWS, find, one_line

HOVER_THRUST = 0.5
"""Normalised hover thrust of a trial for a vehicle file without one."""
_ZERO: Vec3 = (0.0, 0.0, 0.0)
_POSITION: Vec3 = (0.0, 0.0, 1.0)


def at_rest(arm_rad: Joints) -> PlantState:
    """Return the state of a vehicle at rest, 1 m above the origin."""
    return PlantState(
        position_world_m=_POSITION,
        velocity_world_m_s=_ZERO,
        acceleration_world_m_s2=_ZERO,
        attitude_wxyz=IDENTITY_QUAT,
        angular_rate_body_rad_s=_ZERO,
        arm_rad=arm_rad,
        arm_rate_rad_s=(0.0,) * len(arm_rad),
    )


def hover(arm_rad: Joints) -> Reference:
    """Return the reference of a vehicle that stays as in `at_rest`."""
    still = (0.0,) * len(arm_rad)
    return Reference(
        position_world_m=_POSITION,
        velocity_world_m_s=_ZERO,
        acceleration_world_m_s2=_ZERO,
        yaw_rad=0.0,
        yaw_rate_rad_s=0.0,
        arm_rad=arm_rad,
        arm_rate_rad_s=still,
        arm_acceleration_rad_s2=still,
        jerk_world_m_s3=_ZERO,
    )


def build_law(config: ControllerConfig, vehicle: Vehicle) -> Law:
    """Return a new instance of the configured law.

    Raises:
        PluginError: the law is not installed, or cannot be built.
    """
    try:
        law: Law = law_class(config.law)(config, vehicle, vehicle.airframe.hover_thrust or HOVER_THRUST)
    except Exception as error:
        raise find(CONTROL_LAWS, config.law).error(f"cannot be built: {one_line(error)}") from error
    return law


def try_law(config: ControllerConfig, vehicle: Vehicle, start_arm_rad: Joints) -> None:
    """Build the law and run it for some ticks at hover: on the ground and in the air, with and without a force sample.

    Raises:
        PluginError: the law is not installed, cannot be built, raises an exception, returns a malformed command, or takes longer
            than a tick.
    """
    plugin = find(CONTROL_LAWS, config.law)
    law = build_law(config, vehicle)
    resting, reference = at_rest(start_arm_rad), hover(start_arm_rad)
    fastest_s = math.inf
    for force, airborne, offset_m in product((None, (0.0, 0.0, -1.0)), (False, True), (0.0, 0.1)):
        position: Vec3 = (offset_m, 0.0, 1.0)
        state = replace(resting, position_world_m=position, force_ext_world_n=force, airborne=airborne)
        begin_s = time.perf_counter()
        try:
            law.hover_thrust = HOVER_THRUST
            wrench = law.step(TICK_PERIOD_S, state, reference, 1.0 if airborne else 0.5)
        except Exception as error:
            raise plugin.error(f"step raises {one_line(error)}") from error
        fastest_s = min(fastest_s, time.perf_counter() - begin_s)
        problem = problem_of(wrench, joints=len(start_arm_rad))
        if problem is not None:
            raise plugin.error(f"step returns {problem}")
    if fastest_s > TICK_PERIOD_S:
        raise plugin.error(f"step takes {fastest_s * 1e3:.1f} ms or more (limit {TICK_PERIOD_S * 1e3:g} ms, one tick)")


def problem_of(wrench: object, joints: int) -> str | None:
    """Return why a command cannot be sent to a vehicle with this number of joints (wrong type or shape, a non-finite number, or no
    attitude), or None if it can.
    """
    if not isinstance(wrench, Wrench):
        return f"a {type(wrench).__name__}, not a companion.control.types.Wrench"
    try:
        plain = msgspec.to_builtins(wrench)
        converted = msgspec.convert(plain, Wrench)
    except (TypeError, ValueError) as error:
        return f"a malformed Wrench: {one_line(error)}"
    for path, value in _numbers(plain):
        if not math.isfinite(value):
            return f"{path} = {value}, which is not finite"
    if converted != wrench:
        return "a Wrench with a list in place of a tuple"
    log = wrench.log
    torque, rows = wrench.arm_torque_nm, (log.error, log.error_rate, log.sliding, log.gamma, log.tau, log.e_tau)
    if len(torque) != joints:
        return f"arm_torque_nm of length {len(torque)}, expected {joints}, one value for each joint"
    if any(len(one) != 6 + joints for one in rows):
        return f"a log with rows of another length than {6 + joints} (6 and one for each joint)"
    norm = math.hypot(*wrench.attitude_wxyz)
    if abs(norm - 1.0) > 1e-6:
        return f"attitude_wxyz of norm {norm:g}, expected 1"
    if wrench.collective_n < 0.0:
        return f"collective_n = {wrench.collective_n:g}, expected 0 or more"
    return None


def _numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{path}.{key}".lstrip("."))
    elif isinstance(value, (list, tuple)):
        for index, inner in enumerate(value):
            yield from _numbers(inner, f"{path}[{index}]")
    elif value is not None:
        yield path, value
