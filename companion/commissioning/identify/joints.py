"""Torque constant and friction of the joints, from the arm's motion in flight.

The regression is that of `companion arm friction`, with two differences. The load includes the base's acceleration, the inertia of the
links and the force on the net. And a gear's friction grows with its load, so that the load times the direction is a further column;
without it, the torque constant would come out too low.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.commissioning.arm.friction import BINS_MIN, robust_fit
from companion.commissioning.identify.quantity import SIGMAS_95, Quantity, combined
from companion.commissioning.identify.response import STEP_S, Array
from companion.commissioning.identify.samples import Flight
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.model.frames import quat_conjugate, quat_rotate
from companion.model.types import Vec3

_BIN_S = 0.25
_RATE_MIN_RAD_S = 0.12
"""Slower motion may stand still within the backlash."""
_ACCELERATED = 5
"""Samples at both ends of a bin whose mean rates give its acceleration."""
_SIGMAS = (math.inf, 0.15, 0.05, math.radians(2.0), 0.4, 0.06, 0.05, 0.3)
"""Priors about 0: dry friction in N m, viscous friction in N m s, angle of gravity in rad, friction over load, a constant torque in N m
such as that of the downwash, and in m the lever of a payload that hangs beside the centre of the net.
"""
_CONSTANT_SHARE = 0.11
"""Relative standard error due to causes that cannot be seen in a flight: errors of the vehicle file's masses and centres of mass, and
downwash on the arm."""
_FRICTION_SHARE, _FRICTION_SIGMA_NM = 0.08, 0.012
_CONSTANT_SIGMA_MAX = 0.17
_FRICTION_SIGMA_MAX_NM = 0.06


class _Motion(NamedTuple):
    """Load and motion of all joints in one part of the flight, one row per tick."""

    t_s: Array
    rate_rad_s: Array
    current_a: Array
    load_nm: Array
    """Gravity with the base's acceleration, Coriolis torques, and the force on the net."""
    slope_nm: Array
    """Change of the load per radian by which the arm is turned."""
    pull_n: Array
    """Size of the force on the net."""
    mass: Array
    """Inertia matrix of the arm, (ticks, joints, joints)."""


def joints(flight: Flight) -> list[Quantity]:
    """Return torque constant and friction of each joint."""
    arm = flight.vehicle.arm
    found: list[Quantity] = []
    parts = [_motion(flight, begin, end) for begin, end in flight.airborne] if arm.joints else []
    for joint, constant_nm_a in enumerate(arm.torque_constants_nm_a):
        rows, currents, chains = _bins([part for part in parts if part is not None], joint)
        found += _joint(joint, rows, currents, chains, constant_nm_a, arm.joint_friction_nm)
    return found


def _joint(
    joint: int, rows: Array, currents: Array, chains: list[int], constant_nm_a: float, friction_nm: float
) -> tuple[Quantity, Quantity]:
    name = f"joint {joint + 1}"
    constant = Quantity(f"joint{joint + 1}_torque_per_amp_nm_a", f"{name}: torque constant", "N m/A", 3)
    rubbing = Quantity(f"joint{joint + 1}_friction_nm", f"{name}: friction while it moves", "N m", 3)
    both_ways = len(rows) >= BINS_MIN and abs(float(np.mean(rows[:, 1]))) < 0.8
    if not both_ways:
        how = (
            f"moved for {_BIN_S * len(rows):.1f} s; {BINS_MIN * _BIN_S:g} s in both directions are needed, as in catch"
        )
        return replace(constant, how=how), replace(rubbing, how=how)
    fit = robust_fit(rows, currents, chains, _SIGMAS, constant_nm_a)
    k = 1.0 / float(fit.theta[0])
    speed, load = float(np.mean(np.abs(rows[:, 2]))), float(np.mean(np.abs(rows[:, 0])))
    at = np.array([0.0, 1.0, speed, 0.0, load, 0.0, 0.0, load * speed])
    friction = k * float(at @ fit.theta)
    slope = k * at
    slope[0] -= k * friction
    k_sigma = combined(k * k * math.sqrt(max(0.0, float(fit.covariance[0, 0]))), _CONSTANT_SHARE * k)
    c_sigma = combined(
        math.sqrt(max(0.0, float(slope @ fit.covariance @ slope))), _FRICTION_SHARE * friction, _FRICTION_SIGMA_NM
    )
    constant, rubbing = replace(constant, now=f"{constant_nm_a:g}"), replace(rubbing, now=f"{friction_nm:g}")
    if 0.0 < k_sigma <= _CONSTANT_SIGMA_MAX * k:
        how = "current against gravity and inertia while the joint moves, masses as in the vehicle file"
        constant = replace(constant, how=how, value=k, sigma=k_sigma)
    else:
        how = f"known only to ± {100 * SIGMAS_95 * abs(k_sigma / k):.0f} %; companion arm friction measures it"
        constant = replace(constant, how=how)
    if c_sigma <= _FRICTION_SIGMA_MAX_NM:
        how = f"difference between the directions, at {speed:.1f} rad/s and {load:.2f} N m"
        rubbing = replace(rubbing, how=how, value=friction, sigma=c_sigma)
    else:
        how = f"known only to ± {SIGMAS_95 * c_sigma:.2f} N m; companion arm friction measures it"
        rubbing = replace(rubbing, how=how)
    return constant, rubbing


def _motion(flight: Flight, begin: int, end: int) -> _Motion | None:
    vehicle = flight.vehicle
    manipulator, dynamics = manipulator_of(vehicle), dynamics_of(vehicle)
    constants = np.array(vehicle.arm.torque_constants_nm_a)
    force = np.gradient(flight.delta_velocity_m_s[begin:end], flight.t_s[begin:end], axis=0)
    small = 1e-3
    rows: list[tuple[float, Array, Array, Array, Array, float, Array]] = []
    for (i, o, _), up in zip(flight.rows(begin, end), force, strict=True):
        if i.arm is None or i.vehicle is None or len(i.arm.angle_rad) != len(constants):
            return None
        angle, rate = i.arm.angle_rad, i.arm.velocity_rad_s
        up_body: Vec3 = (float(up[0]), float(up[1]), float(up[2]))
        gravity = np.array(manipulator.joint_terms(angle, up_body)[1])
        turned = np.array(manipulator.joint_terms((angle[0] + small, *angle[1:]), up_body)[1])
        own = dynamics.arm_terms(angle, rate)
        carried, pull_n = np.zeros(len(constants)), 0.0
        if o.control is not None:
            pull = o.control.force_measured_world_n or o.control.force_ext_world_n
            pull_n = math.hypot(*pull)
            carried = np.array(
                manipulator.joint_torque_from_force(angle, quat_rotate(quat_conjugate(i.vehicle.attitude_wxyz), pull))
            )
        load = gravity + np.array(own.coriolis) - carried
        rows.append(
            (
                i.t_s,
                np.array(rate),
                np.array(i.arm.torque_nm) / constants,
                load,
                (turned - gravity) / small,
                pull_n,
                np.array(own.mass),
            )
        )
    return _Motion(*(np.array(column) for column in zip(*rows, strict=True)))


def _bins(parts: list[_Motion], joint: int) -> tuple[Array, Array, list[int]]:
    """Return the rows of the design matrix, the mean currents and the chain of each row."""
    rows, currents, chains, chain = list[list[float]](), list[float](), list[int](), 0
    width = round(_BIN_S / STEP_S)
    for part in parts:
        chain += 1
        at = 0
        while at + width <= len(part.t_s):
            span = slice(at, at + width)
            rate = part.rate_rad_s[span, joint]
            long = part.t_s[at + width - 1] - part.t_s[at] > 1.5 * _BIN_S
            if long or not (np.all(rate > _RATE_MIN_RAD_S) or np.all(rate < -_RATE_MIN_RAD_S)):
                at += 1
                if chains and chains[-1] == chain:
                    chain += 1
                continue
            first, last = part.rate_rad_s[span][:_ACCELERATED], part.rate_rad_s[span][-_ACCELERATED:]
            between_s = part.t_s[span][-_ACCELERATED:].mean() - part.t_s[span][:_ACCELERATED].mean()
            acceleration = (last.mean(axis=0) - first.mean(axis=0)) / between_s
            load = float(part.load_nm[span, joint].mean() + part.mass[span].mean(axis=0)[joint] @ acceleration)
            way = math.copysign(1.0, float(rate[0]))
            rows.append(
                [
                    load,
                    way,
                    float(rate.mean()),
                    float(part.slope_nm[span, joint].mean()),
                    way * abs(load),
                    1.0,
                    float(part.pull_n[span].mean()),
                    abs(load) * float(rate.mean()),
                ]
            )
            currents.append(float(part.current_a[span, joint].mean()))
            chains.append(chain)
            at += width
    return np.array(rows).reshape(-1, 8), np.array(currents), chains
