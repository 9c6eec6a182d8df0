"""Flies the flights of `companion compare`.

A flight is {controller, preset, payload_kg, seed, model_error}.
"""

from __future__ import annotations

from collections.abc import Sequence

from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import fly_to_end, laboratory_of, row_of, with_world
from sitl.campaigns.runner import Data


def prepare(job: Data, _: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job."""
    flights: list[Data] = job["flights"]
    return flights


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row (see `companion.campaigns.compare.aggregate`)."""
    changes = {key: flight[key] for key in ("payload_kg", "seed", "model_error")}
    flown = fly_to_end(with_world(config, changes))
    row, _ = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)
    head = {key: flight[key] for key in ("controller", "preset", "payload_kg", "seed")}
    return {"row": {**head, **laboratory_of(flown.config), **row}}
