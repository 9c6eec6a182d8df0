"""All quantities of one flight."""

from __future__ import annotations

from dataclasses import dataclass

from companion.analysis.hover_fit import HoverFit
from companion.analysis.log import FlightLog
from companion.commissioning.identify.attitude import AXES, loop, mocap_delay
from companion.commissioning.identify.joints import joints
from companion.commissioning.identify.payload import payload
from companion.commissioning.identify.quantity import Quantity
from companion.commissioning.identify.rotors import drag, hover_thrust, thrust_lag
from companion.commissioning.identify.samples import Flight


@dataclass(frozen=True)
class Identification:
    """What one flight shows of the machine and its world."""

    flight: Flight
    quantities: tuple[Quantity, ...]
    hover: HoverFit | None

    def __getitem__(self, key: str) -> Quantity:
        """Return the quantity with this key."""
        return next(one for one in self.quantities if one.key == key)


def identify(log: FlightLog) -> Identification:
    """Find everything that the flight shows.

    Raises:
        LogError: the log holds no flight that ended regularly and was long enough.
    """
    flight = Flight.of(log)
    hover, fit = hover_thrust(flight)
    quantities = (
        hover,
        thrust_lag(flight, hover.value),
        *(quantity for axis in range(len(AXES)) for quantity in loop(flight, axis)),
        mocap_delay(flight),
        drag(flight),
        *joints(flight),
        payload(flight),
    )
    return Identification(flight, quantities, fit)
