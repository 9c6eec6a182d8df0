"""Flies the flights of `companion tune`.

A flight is {controller, world, until_mission_s}: the settings of its control law, the keys of the world in which it differs from the
configuration, and the time on the mission's clock at which it is cut short (null for the whole mission).
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

from companion.config.controller import LAWS
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import Flown, fly_to_end, laboratory_of, row_of, with_world
from sitl.campaigns.runner import Data


def prepare(job: Data, _: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job."""
    flights: list[Data] = job["flights"]
    return flights


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row: that of `companion.campaigns.compare.aggregate` without controller, preset and seed.

    `payload_kg` is 0 if the mission expects no payload.
    """
    given, until_s = flight["controller"], flight["until_mission_s"]
    controller = LAWS[given["law"]].model_validate_json(json.dumps(given))
    config = with_world(config.model_copy(update={"controller": controller}), flight["world"])
    flown = fly_to_end(config, math.inf if until_s is None else until_s)
    return {"row": graded(flown, cut=until_s is not None)}


def graded(flown: Flown, cut: bool) -> Data:
    """Return the row of a flight, from which `companion.campaigns.cost.flight_cost` computes its cost; `cut` is as in `row_of`."""
    config = flown.config
    row, _ = row_of(config.flight, flown.result, flown.caught_t_s, flown.error, cut=cut)
    payload_kg = config.world.payload_kg if config.mission.catch is not None else 0.0
    return {"payload_kg": payload_kg, **laboratory_of(config), **row}
