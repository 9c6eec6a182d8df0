"""Mass of the payload, from the force sensor before and after the catch."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from companion.commissioning.identify.quantity import Quantity, combined
from companion.commissioning.identify.response import Array, long_run
from companion.commissioning.identify.samples import Flight
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import PhaseKind

_BEFORE_S = 2.5
_SCALE_SHARE = 0.03
"""Standard error of the sensor's scale and mounting, relative."""
_FORCE_SIGMA_N = 0.04
"""Standard error of drift and downwash between the two windows."""
_LAGS = 100


def payload(flight: Flight) -> Quantity:
    """Return the mass of the payload in the net."""
    mass = Quantity("payload_kg", "payload", "kg", 3)
    if not flight.vehicle.has_net:
        return replace(mass, how="the vehicle has no net")
    if flight.catch is None:
        return replace(mass, how="nothing was caught; fly catch")
    if flight.vehicle.devices.force is None:
        return replace(mass, how="the vehicle has no force sensor")

    def force_up_n(begin: int, end: int) -> Array:
        forces = [
            (o.control.force_measured_world_n or o.control.force_ext_world_n)[2]
            for _, o, _ in flight.rows(begin, end)
            if o.control is not None and o.phase_kind is PhaseKind.FLIGHT
        ]
        return np.array(forces, dtype=np.float64)

    caught_s = flight.t_s[flight.catch]
    after = np.concatenate([[], *(force_up_n(begin, end) for begin, end in flight.airborne if begin > flight.catch)])
    first = int(np.searchsorted(flight.t_s, caught_s - _BEFORE_S))
    before = np.concatenate(
        [[], *(force_up_n(max(begin, first), end) for begin, end in flight.airborne if first < end <= flight.catch)]
    )
    if len(after) < 2 * _LAGS or len(before) < 2 * _LAGS:
        return replace(mass, how="too little flight before or after the catch; fly catch to its end")
    value = float(before.mean() - after.mean()) / GRAVITY_M_S2
    sigma = combined(_mean_sigma(before), _mean_sigma(after), _FORCE_SIGMA_N) / GRAVITY_M_S2
    sigma = combined(sigma, _SCALE_SHARE * value)
    if value < 3.0 * sigma:
        return replace(mass, how="nothing stayed in the net after the impact; fly catch again")
    how = "weight on the force sensor, after minus before the catch"
    return replace(mass, how=how, value=value, sigma=sigma)


def _mean_sigma(values: Array) -> float:
    return math.sqrt(float(long_run((values - values.mean())[:, None], _LAGS)[0, 0])) / len(values)
