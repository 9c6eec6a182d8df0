"""The laboratories in which `companion tune` searches, and those in which it judges what it found. No laboratory is among both."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.campaigns.robustness.campaign import world_key
from companion.config.mission import Catch, Mission
from companion.config.vehicle import Vehicle
from companion.mission.plan import Plan
from companion.model.types import PhaseKind

TRAINING_FROM, HELD_OUT_FROM, APART = 1_000_000, 500_000_000, 10_000
"""Laboratories are those from here on plus `APART` times the seed of the search; tables of comparisons use smaller numbers."""
PAYLOAD_SHARE = (0.2, 1.0)
"""Range of the payload, as a fraction of the largest one that the mission expects."""
SETPOINT_DELAY_S = (0.03, 0.06)
"""Range of the delay of setpoints in every other laboratory."""
AFTER_CATCH_S = 5.0
"""Time after the expected catch at which a flight of the search ends."""
WITHOUT_CATCH_S = 20.0
"""Duration of a flight of the search whose mission expects no payload, from the start of the take-off."""
_STEP_S, _BESIDE_M = 0.05, 0.02


@dataclass(frozen=True, slots=True)
class Draws:
    """Laboratories of one kind, in order."""

    first: int
    """Number of the first one, which is its world's seed; the others follow."""
    count: int
    until_mission_s: float | None
    """Time on the mission's clock at which their flights end; None for whole missions."""
    payload_max_kg: float | None
    """Largest payload; None if the mission expects none."""
    fixed: frozenset[str]
    """Keys of the world that the user has set, which are not drawn."""

    def flight(self, settings: dict[str, Any], number: int) -> dict[str, Any]:
        """Return a flight of `sitl.campaigns.tune`.

        Args:
            number: number of the draw, from 0.
        """
        rng = np.random.default_rng(self.first + number)
        payload, delay_s = rng.uniform(*PAYLOAD_SHARE), rng.uniform(*SETPOINT_DELAY_S)
        world: dict[str, Any] = {"seed": self.first + number}
        if self.payload_max_kg is not None:
            world["payload_kg"] = round(self.payload_max_kg * payload, 3)
        if number % 2 == 1:
            world["setpoint_delay_s"] = round(delay_s, 4)
        return {
            "variant": 0,
            "controller": settings,
            "world": {key: value for key, value in world.items() if key not in self.fixed},
            "until_mission_s": self.until_mission_s,
        }

    @property
    def text(self) -> str:
        """Return the numbers of the laboratories."""
        return f"laboratories {self.first} to {self.first + self.count - 1}"


def draws_of(
    mission: Mission, vehicle: Vehicle, overrides: Sequence[str], seed: int, training: int, held_out: int
) -> tuple[Draws, Draws]:
    """Return the laboratories of the search, whose flights end some seconds after the catch, and the held-out ones."""
    plan = Plan.build(mission, vehicle)
    payload_kg = mission.catch.payload_max_kg if mission.catch is not None else None
    fixed = frozenset(key for override in overrides if (key := world_key(override)))
    until_s = WITHOUT_CATCH_S if mission.catch is None else _catch_s(plan, mission.catch) + AFTER_CATCH_S
    cut_s = until_s if until_s < plan.duration_s else None
    return (
        Draws(TRAINING_FROM + APART * seed, training, cut_s, payload_kg, fixed),
        Draws(HELD_OUT_FROM + APART * seed, held_out, None, payload_kg, fixed),
    )


def _catch_s(plan: Plan, catch: Catch) -> float:
    """Return the time on the mission's clock at which the vehicle first passes the place of the expected catch."""
    times = [n * _STEP_S for n in range(int(plan.duration_s / _STEP_S))]
    flown = [t_s for t_s in times if plan.segment(t_s).kind is PhaseKind.FLIGHT] or times
    away_m = [math.dist(plan.reference(t_s).position_world_m[:2], catch.expected_at_m) for t_s in flown]
    nearest_m = min(away_m)
    return next(t_s for t_s, m in zip(flown, away_m, strict=True) if m <= nearest_m + _BESIDE_M)
