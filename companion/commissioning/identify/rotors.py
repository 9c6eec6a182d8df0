"""Hover thrust, lag of the thrust, and drag of the rotors."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from companion.analysis.hover_fit import HoverFit, HoverFitError, fit_hover_thrust
from companion.commissioning.identify.quantity import Quantity, combined
from companion.commissioning.identify.response import STEP_S, Array, Piece, Prior, Spectrum, fit_response, long_run
from companion.commissioning.identify.samples import Flight
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_conjugate, quat_rotate

HOVER_SHARE = 0.012
"""Standard error of the hover thrust, relative, that no flight shows: bias of the vertical accelerometer, the tether's weight, ground
effect, downwash on the arm. Measured in drawn laboratories (docs/internals/identify.md).
"""
_DELAY = Prior(0.018, 0.008)
"""Delay before the rotors react, s: link, PX4's cycle, motor controllers."""
_LAG_LN = Prior(math.log(0.055), 0.7)
_SLOPE = Prior(1.1, 0.12)
"""Slope of the thrust over the setpoint at hover, as a multiple of weight / hover thrust: above 1 if the true curve is steeper than
THR_MDL_FAC says.
"""
_CUTOFF_HZ = 6.0
"""Above it, vibration that the law feeds back hides the response."""
_SLOW_HZ = 0.5
"""Below it, the ground effect, the drag and the payload change the specific force, too."""
_LAG_SIGMA_S = 0.008
"""Standard error from describing rotors that speed up faster than they slow down by one time constant, and from the vibration that the
accelerometer brings into the thrust setpoint.
"""
_LAG_SIGMA_MAX_S = 0.025
_THRUST_MOVED = 0.003
"""Smallest standard deviation of the thrust setpoint that excites the rotors."""
_DRAG_BIN_S = 0.1
_SPEED_MIN_M_S = 0.15
"""Smallest RMS of the speed that shows drag."""
_TETHER_N = 0.06
"""Standard deviation of the friction of a slack tether on the floor, which acts against the velocity like drag."""
_DRAG_SHARE = 0.1


def hover_thrust(flight: Flight) -> tuple[Quantity, HoverFit | None]:
    """Return the hover thrust, and the fit with its slope over the battery voltage."""
    hover = Quantity("hover_thrust", "hover thrust", "", 4)
    try:
        fit = fit_hover_thrust(flight.log)
    except HoverFitError as error:
        return replace(hover, how=str(error).removeprefix(f"{flight.log.path}: ")), None
    at = "" if fit.voltage_mean_v is None else f" at {fit.voltage_mean_v:.1f} V"
    slope = "" if fit.slope is None else f", {fit.slope.per_v:+.4f} ± {1.96 * fit.slope.standard_error_per_v:.4f} per V"
    configured = "" if fit.configured is None else f"{fit.configured:.4f}"
    how = f"force balance of {fit.used_s:.0f} s of steady flight{at}{slope}"
    sigma = combined(fit.standard_error, HOVER_SHARE * fit.hover_thrust)
    return replace(hover, how=how, value=fit.hover_thrust, sigma=sigma, now=configured), fit


def thrust_lag(flight: Flight, hover: float | None) -> Quantity:
    """Return the time from a thrust setpoint to the thrust: delay plus time constant."""
    lag = Quantity("thrust_lag_s", "thrust lag (delay + time constant)", "ms", 0, scale=1e3)
    velocity = flight.delta_velocity_m_s[:, 2]
    pieces = []
    for begin, end in flight.airborne:
        grid_s = flight.grid(begin, end)
        total = np.interp(grid_s, flight.t_s, velocity)
        thrust = flight.on_grid(grid_s, flight.t_s, flight.thrust)
        pieces.append(Piece(thrust, np.gradient(total, STEP_S)))
    moved = float(np.std(np.concatenate([piece.input - piece.input.mean() for piece in pieces])))
    if hover is None or moved < _THRUST_MOVED:
        how = f"the thrust setpoint moved by {moved:.4f} (standard deviation); fly climbs and descents, such as circuit"
        return replace(lag, how=how)
    gain = GRAVITY_M_S2 / hover

    def transfer(p: Array, s: Spectrum) -> Spectrum:
        return np.asarray(np.exp(-p[1] * s) / (1.0 + math.exp(p[0]) * s), dtype=np.complex128)

    fit = fit_response(
        pieces,
        transfer,
        [np.array([math.log(lag_s), delay_s]) for lag_s in (0.02, 0.06, 0.12) for delay_s in (0.008, 0.03)],
        [_LAG_LN, _DELAY],
        (np.array([math.log(0.005), 0.0]), np.array([math.log(0.5), 0.1])),
        cutoff_hz=_CUTOFF_HZ,
        slow_hz=_SLOW_HZ,
        order=6,
        gain=Prior(_SLOPE.mean * gain, _SLOPE.sigma * gain),
    )
    value, sigma = fit.of(lambda p: math.exp(p[0]) + p[1])
    sigma = combined(sigma, _LAG_SIGMA_S)
    if sigma > _LAG_SIGMA_MAX_S:
        how = f"the thrust moved too little: known only to ± {1e3 * 1.96 * sigma:.0f} ms; fly climbs and descents, such as circuit"
        return replace(lag, how=how)
    how = f"thrust setpoint to vertical specific force, below {_CUTOFF_HZ:g} Hz"
    return replace(lag, how=how, value=value, sigma=sigma, now="lab 54 to 76 ms")


def drag(flight: Flight) -> Quantity:
    """Return the drag over mass and speed: the specific force across the rotor axis against the velocity."""
    found = Quantity("drag_1_s", "drag over mass", "1/s", 2)
    every = max(1, round(_DRAG_BIN_S / STEP_S))
    velocity_world = flight.log.column(lambda i, o, s: i.vehicle.velocity_world_m_s if i.vehicle else None, 3)
    attitude = flight.log.column(lambda i, o, s: i.vehicle.attitude_wxyz if i.vehicle else None, 4)
    forces, speeds, signs = [], [], []
    for begin, end in flight.airborne:
        ticks = np.arange(begin, end, every)
        if len(ticks) < 10:
            continue
        body = np.array(
            [
                quat_rotate(quat_conjugate(tuple(q)), tuple(v))
                for q, v in zip(attitude[begin:end], velocity_world[begin:end], strict=True)
            ]
        )[:, :2]
        mean = np.stack([body[a - begin : b - begin].mean(axis=0) for a, b in pairwise(ticks)])
        step_s = np.diff(flight.t_s[ticks])[:, None]
        force = np.diff(flight.delta_velocity_m_s[ticks, :2], axis=0) / step_s
        size = np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 0.05)
        line = np.linspace(-1.0, 1.0, len(mean))
        slow = np.stack([np.ones(len(line)), line], axis=1)
        project = np.eye(len(line)) - slow @ np.linalg.pinv(slow)
        for axis in range(2):
            forces.append(project @ force[:, axis])
            speeds.append(project @ mean[:, axis])
            signs.append(project @ (mean[:, axis] / size[:, 0]))
    force_m_s2, speed, sign = map(np.concatenate, (forces, speeds, signs))
    rms = float(np.sqrt(2.0 * np.mean(speed**2)))
    if rms < _SPEED_MIN_M_S:
        how = f"the vehicle moved at {rms:.2f} m/s (RMS); fly at 0.5 m/s or more, such as circuit"
        return replace(found, how=how)
    tethered = flight.vehicle.tether is not None
    rows = np.stack([-speed, -sign] if tethered else [-speed], axis=1)
    scatter = float(np.std(force_m_s2))
    prior = np.diag([0.0, (scatter * flight.vehicle.airframe.mass_kg / _TETHER_N) ** 2][: rows.shape[1]])
    inverse = np.linalg.inv(rows.T @ rows + prior)
    value = inverse @ rows.T @ force_m_s2
    residual = force_m_s2 - rows @ value
    lags = round(1.0 / _DRAG_BIN_S)
    covariance = inverse @ (long_run(rows * residual[:, None], lags) + prior * scatter**2) @ inverse
    sigma = combined(math.sqrt(float(covariance[0, 0])), _DRAG_SHARE * abs(float(value[0])))
    how = f"specific force across the rotor axis against the velocity, {rms:.2f} m/s RMS"
    return replace(found, how=how, value=float(value[0]), sigma=sigma, now="lab 0.20 to 0.62 1/s")
