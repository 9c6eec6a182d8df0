"""The report of a flight on the momentum observer: its error against the sensor, where both were logged."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from companion.analysis import metrics
from companion.analysis.log import FlightLog
from companion.model.outputs import Outputs
from companion.model.types import PhaseKind, Vec3
from tests.analysis.synthetic_flight import log_of_rows, synthetic_flight


def flown(observed: Vec3 | None, measured: Vec3 | None) -> FlightLog:
    """A flight in which both forces are constant from take-off to touchdown."""

    def with_forces(o: Outputs) -> Outputs:
        if o.control is None:
            return o
        in_flight = o.phase_kind is PhaseKind.FLIGHT
        control = replace(
            o.control,
            force_measured_world_n=measured,
            force_observed_world_n=observed if in_flight else (9.0, 9.0, 9.0),
        )
        return replace(o, control=control)

    return log_of_rows((i, with_forces(o), s) for i, o, s in synthetic_flight(rate_hz=20.0))


def test_the_error_of_the_observer_counts_in_flight_only() -> None:
    found = metrics.force_observer_error_n(flown((0.3, 0.0, -1.6), (0.0, 0.0, -2.0)))
    assert found == pytest.approx((0.5, 0.5))


@pytest.mark.parametrize(("observed", "measured"), [(None, None), ((0.0, 0.0, -2.0), None)])
def test_the_observers_error_needs_both_forces(observed: Vec3 | None, measured: Vec3 | None) -> None:
    assert metrics.force_observer_error_n(flown(observed, measured)) is None
