"""Decides from the mission to what kind of vehicle people throw, where the world leaves it open."""

from __future__ import annotations

import itertools

from companion.mission.plan import Plan
from companion.sitl_config.loader import SitlConfig

THROW_BESIDE_M = 0.5
"""Largest lateral distance from `catch_at_m` at which a payload is thrown to a passing vehicle."""
PASSES_M_S = 0.05
"""Smallest speed in the +x direction of a passing vehicle."""
_STEP_S = 0.05


def with_throws(config: SitlConfig) -> SitlConfig:
    """Return the configuration with `throw_to: either` resolved, as the people in a room know beforehand what is going to be flown."""
    if config.world.throw_to != "either":
        return config
    throw_to = "passing" if _passes(config) else "hovering"
    return config.model_copy(update={"world": config.world.model_copy(update={"throw_to": throw_to})})


def _passes(config: SitlConfig) -> bool:
    plan, (at_x, at_y) = Plan.build(config.mission, config.vehicle), config.world.catch_at_m
    course = [plan.reference(n * _STEP_S) for n in range(int(plan.duration_s / _STEP_S))]
    return any(
        a.position_world_m[0] < at_x <= b.position_world_m[0]
        and b.velocity_world_m_s[0] > PASSES_M_S
        and abs(b.position_world_m[1] - at_y) <= THROW_BESIDE_M
        for a, b in itertools.pairwise(course)
    )
