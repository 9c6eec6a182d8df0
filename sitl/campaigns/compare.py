"""Flies the flights of `companion compare`.

A flight is {controller, preset, payload_kg, seed, model_error, series}; `series` requests a time series.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import Array, FlightLog
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import fly_to_end, laboratory_of, row_of, with_world
from sitl.campaigns.runner import Data

SERIES_EVERY = 4
"""Ticks per point of a time series: 50 Hz."""


def prepare(job: Data, _: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job."""
    flights: list[Data] = job["flights"]
    return flights


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row (see `companion.campaigns.compare.aggregate`) and its time series, if requested."""
    changes = {key: flight[key] for key in ("payload_kg", "seed", "model_error")}
    flown = fly_to_end(with_world(config, changes))
    row, log = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)
    head = {key: flight[key] for key in ("controller", "preset", "payload_kg", "seed")}
    return {
        "row": {**head, **laboratory_of(flown.config), **row},
        "series": series_of(log) if flight["series"] and log.inputs else None,
    }


def series_of(log: FlightLog) -> Data:
    """Return the errors and joint angles in flight against mission time, for plots; an unknown value is None."""
    pre, post = metrics.flight_masks(log)
    used = np.flatnonzero(pre | post)[::SERIES_EVERY]
    columns = log.columns
    angles, wanted = np.degrees(columns.arm_rad), np.degrees(columns.arm_reference_rad)
    caught = metrics.catch_index(log)
    return {
        "t_s": _points(columns.mission_t_s[used]),
        "e_p_m": _points(np.sqrt((metrics.position_error_m(log)[used] ** 2).sum(axis=1))),
        "e_q_deg": _points(np.degrees(np.sqrt((metrics.attitude_error_rad(log)[used] ** 2).sum(axis=1)))),
        "alpha_deg": [_points(angles[used, j]) for j in range(log.joint_count)],
        "alpha_reference_deg": [_points(wanted[used, j]) for j in range(log.joint_count)],
        "catch_t_s": log.outputs[caught].mission_t_s if caught is not None else None,
    }


def _points(values: Array) -> list[float | None]:
    return [round(value, 6) if math.isfinite(value) else None for value in values.tolist()]
