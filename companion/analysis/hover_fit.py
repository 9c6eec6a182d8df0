"""Fits the hover thrust (without payload) to the steady parts of a flight log, on the force balance of
`companion.control.hover_thrust`: thrust = h . load, with a slope over the battery voltage if that changed enough.

The load comes from the accelerometer. Least squares would divide h by 1 + the variance of its noise: by 1.2 with strong vibration. The
fit therefore balances sums over time, in which the noise cancels (instrumental variables: 1 and the voltage).
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np

from companion.analysis.log import Array, FlightLog
from companion.control.hover_thrust import Balance
from companion.control.sensing import MeanAcceleration
from companion.model.types import PhaseKind

FIT_MIN_S = 2.0
PIECE_S = 1.0
"""Length of the pieces of data that are treated as independent: the vertical control loop correlates neighbouring ticks, but not
pieces of this length.
"""
SLOPE_MIN_V = 0.3
"""Smallest change of the voltage for which a slope is fitted."""


class HoverFitError(ValueError):
    """The log does not contain enough hovering. The text is one line for the user."""


@dataclass(frozen=True, slots=True)
class VoltageSlope:
    """Change of the hover thrust with the battery voltage."""

    per_v: float
    """Normalised thrust per volt; negative, because a lower voltage needs more."""
    standard_error_per_v: float


@dataclass(frozen=True, slots=True)
class HoverFit:
    """Result of the fit; hover thrust is normalised, 0 to 1."""

    hover_thrust: float
    """Hover thrust at `voltage_mean_v`."""
    standard_error: float
    """Standard error due to noise alone; it does not include the error of the configured mass."""
    used_s: float
    """Duration of the steady flight that was used, s."""
    configured: float | None
    """Hover thrust at the start of the flight."""
    last_estimate: float | None
    """Hover thrust that the vehicle had estimated by the end of the flight; equal to `configured` if the estimator was off."""
    voltage_mean_v: float | None
    """Mean battery voltage; None if PX4 did not report it throughout."""
    voltage_span_v: float | None
    """Largest minus smallest voltage, V."""
    slope: VoltageSlope | None
    """Slope over the voltage; None if the voltage is unknown or changed too little."""


def fit_hover_thrust(log: FlightLog) -> HoverFit:
    """Fit the hover thrust to a log.

    Raises:
        HoverFitError: less than `FIT_MIN_S` of steady flight under the control law, or no mass in the log's configuration.
    """
    airframe = (log.config.get("vehicle") or {}).get("airframe") or {}
    samples, learnt = _calm(log)
    dt_s, thrust, load, voltage_v = samples.T
    used_s = float(dt_s.sum())
    if used_s < FIT_MIN_S:
        what = "hover for a few seconds" if log.end_missing is None else log.end_missing
        raise HoverFitError(f"{log.path}: {used_s:.1f} s of steady flight, expected {FIT_MIN_S:g} s or more; {what}")
    pieces = np.floor(np.cumsum(dt_s) / PIECE_S)
    ones = np.ones((len(load), 1))
    values, errors = _fit(dt_s, load[:, None], ones, thrust, pieces)
    mean_v = span_v = slope = None
    if np.isfinite(voltage_v).all():
        mean_v, span_v = float(np.average(voltage_v, weights=dt_s)), float(np.ptp(voltage_v))
        if span_v >= SLOPE_MIN_V:
            instruments = np.stack([np.ones(len(load)), voltage_v - mean_v], axis=1)
            values, errors = _fit(dt_s, instruments * load[:, None], instruments, thrust, pieces)
            slope = VoltageSlope(float(values[1]), float(errors[1]))
    return HoverFit(
        hover_thrust=float(values[0]),
        standard_error=float(errors[0]),
        used_s=used_s,
        configured=airframe.get("hover_thrust"),
        last_estimate=learnt,
        voltage_mean_v=mean_v,
        voltage_span_v=span_v,
        slope=slope,
    )


def _calm(log: FlightLog) -> tuple[Array, float | None]:
    """Return the ticks of steady flight, (N, 4): duration s, normalised thrust, load over weight, battery voltage V or NaN; and the
    last estimate of the hover thrust.
    """
    vehicle = log.config.get("vehicle") or {}
    mass_kg = (vehicle.get("airframe") or {}).get("mass_kg")
    force_timeout_s = (vehicle.get("safety") or {}).get("force_timeout_s", 0.25)
    if mass_kg is None:
        raise HoverFitError(f"{log.path}: no vehicle.airframe.mass_kg in its configuration; expected a flight log")
    balance = Balance(mass_kg)
    rows = array("d")
    learnt: float | None = None
    acceleration = MeanAcceleration()
    sent: float | None = None
    before_s: float | None = None
    carrying = False
    for i, o, _ in log.every_tick():
        learnt = learnt if o.control is None else o.control.hover_thrust
        dt_s = 0.0 if before_s is None else i.t_s - before_s
        before_s = i.t_s
        carrying = carrying or any(event.id == "catch" for event in o.events)
        if sent is not None and i.vehicle is not None and o.control is not None:
            force = o.control.force_measured_world_n or o.control.force_ext_world_n
            now = balance.step(dt_s, sent, acceleration.update(i.vehicle), force, i.vehicle.attitude_wxyz)
            blind = i.force is None or i.t_s - i.force.stamp_s > force_timeout_s
            if now is not None and o.phase_kind is PhaseKind.FLIGHT and not (carrying and blind):
                voltage_v = i.status.battery_voltage_v if i.status is not None else None
                rows.extend((dt_s, *now, math.nan if voltage_v is None else voltage_v))
        sent = o.attitude.thrust if o.attitude is not None else None
    return np.array(rows).reshape(-1, 4), learnt


def _fit(dt_s: Array, columns: Array, instruments: Array, thrust: Array, pieces: Array) -> tuple[Array, Array]:
    """Return the fitted values, weighted by time, and their cluster-robust standard errors with the pieces as clusters."""
    weighted = instruments * dt_s[:, None]
    inverse = np.linalg.inv(weighted.T @ columns)
    values: Array = inverse @ (weighted.T @ thrust)
    residual = thrust - columns @ values
    _, index = np.unique(pieces, return_inverse=True)
    scores = np.zeros((int(index.max()) + 1, columns.shape[1]))
    np.add.at(scores, index, weighted * residual[:, None])
    freedom = len(scores) / max(1, len(scores) - columns.shape[1])
    errors: Array = np.sqrt(freedom * np.diag(inverse @ (scores.T @ scores) @ inverse.T))
    return values, errors
