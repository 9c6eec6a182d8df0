"""All rows of a preflight, room by room, in the order in which people look at them. Pure."""

from __future__ import annotations

from companion.config.loader import FlightConfig
from companion.model.observations import Observations, Waiting
from companion.model.rows import Row, refusals
from companion.preflight import arm, estimator, force, frames, machine, mission, mocap, px4, tether
from companion.preflight.checks import Check
from companion.px4 import wanted

CHECKS: tuple[Check, ...] = (
    *estimator.CHECKS,
    *mocap.CHECKS,
    *frames.CHECKS,
    *arm.CHECKS,
    *force.CHECKS,
    *tether.CHECKS,
    *mission.CHECKS,
    *machine.CHECKS,
)
"""Beside these there is one row for PX4's firmware and one for each of its parameters (`companion.preflight.px4`)."""
SETTLE_S = 30.0
"""A PX4 that has just started may take that long until its estimate is steady."""
BEGIN_S = 2.0
"""And that long to fuse poses that have just begun to come."""
_SETTLES = {check.id: check.title for check in CHECKS if check.settles}


def rows(o: Observations, config: FlightConfig) -> list[Row]:
    """Every check, one row each; what could not be looked at because its device is missing has none."""
    vehicle = config.vehicle
    link, *state = estimator.rows(o, vehicle)
    return [
        link,
        *px4.rows(o.firmware, o.params, vehicle),  # before what follows from a wrong parameter
        *state,
        *mocap.rows(o, vehicle),
        *(frames.rows(o, config.mission, vehicle) if o.mocap and o.vehicle else ()),
        *arm.rows(o, vehicle),
        *force.rows(o, vehicle),
        *tether.rows(o, vehicle),
        *mission.rows(o, config),
        *machine.rows(o, vehicle),
    ]


def unsettled(o: Observations, config: FlightConfig) -> Waiting | None:
    """What may come right by waiting; None: nothing.

    When something refuses that no waiting mends, only so long that the rest is told as it is, not as it was when motion capture began
    to flow.
    """
    refusing = refusals(rows(o, config))
    settling = [_SETTLES[row.id] for row in refusing if row.id in _SETTLES]
    if not settling:
        return None
    return Waiting(", ".join(settling), SETTLE_S if len(settling) == len(refusing) else BEGIN_S)


def param_names() -> tuple[str, ...]:
    """PX4's parameters that the rows are made of."""
    return wanted.names()
