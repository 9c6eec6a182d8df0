"""All rows of a preflight in display order. Pure functions."""

from __future__ import annotations

from companion.config.loader import FlightConfig
from companion.config.vehicle import Vehicle
from companion.model.check_row import Row, refusals
from companion.model.observations import Observations, Waiting
from companion.preflight import arm, estimator, force, frames, machine, mission, mocap, px4, tether
from companion.preflight.checks import Check
from companion.px4 import required, rotors

CHECKS: tuple[Check, ...] = (
    *px4.CHECKS,
    *estimator.CHECKS,
    *mocap.CHECKS,
    *frames.CHECKS,
    *arm.CHECKS,
    *force.CHECKS,
    *tether.CHECKS,
    *mission.CHECKS,
    *machine.CHECKS,
)
"""All checks except those of `companion.preflight.px4`: one row for PX4's firmware and one for each parameter."""
SETTLE_S = 30.0
"""Longest time that PX4's estimate takes to become steady after PX4 has started."""
BEGIN_S = 2.0
"""Longest time from the arrival of the first poses until PX4 fuses them."""
_SETTLES = {check.id: check.title for check in CHECKS if check.settles}


def rows(o: Observations, config: FlightConfig) -> list[Row]:
    """Return one row for every check, except for the checks of a missing device."""
    vehicle = config.vehicle
    link, *state = estimator.rows(o, vehicle)
    return [
        link,
        *px4.rows(o.firmware, o.params, vehicle),  # before the consequences of a wrong parameter
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
    """Return the failed checks that may still pass, with the longest time to wait for them; None if there are none.

    The time is `SETTLE_S`. If a check has also failed that cannot pass by waiting, the time is only `BEGIN_S`: long enough that the
    observation no longer contains the moment when poses began to arrive.
    """
    refusing = refusals(rows(o, config))
    settling = [_SETTLES[row.id] for row in refusing if row.id in _SETTLES]
    if not settling:
        return None
    return Waiting(", ".join(settling), SETTLE_S if len(settling) == len(refusing) else BEGIN_S)


def param_names(vehicle: Vehicle) -> tuple[str, ...]:
    """Return the PX4 parameters that the rows need."""
    return (*required.BY_NAME, required.KILL_CHANNEL, *rotors.names(vehicle.airframe.rotor_layout.count))
