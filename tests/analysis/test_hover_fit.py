"""The fit of the hover thrust: the truth within its uncertainty, whatever was flown with; a slope only where one is to be seen."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import cache

import msgspec
import pytest

from companion.analysis.hover_fit import FIT_MIN_S, SLOPE_MIN_V, HoverFitError, fit_hover_thrust
from companion.analysis.log import FlightLog
from companion.model.outputs import Outputs
from companion.model.types import Inputs
from sitl.campaigns.flights import log_of
from tests.control.test_hover import configured, flown, true_hover_thrust

ERROR = 0.1
"""Of the parameter that is flown with, which does not adapt."""


@cache
def logged() -> FlightLog:
    config = configured(ERROR, False)
    airframe = config.vehicle.airframe.model_copy(update={"hover_thrust": true_hover_thrust() * (1.0 + ERROR)})
    vehicle = config.vehicle.model_copy(update={"airframe": airframe})
    return log_of(config.model_copy(update={"vehicle": vehicle}), flown(ERROR, 16.0, adapt=False), None)


def changed(log: FlightLog, change: Callable[[Inputs, Outputs], tuple[Inputs, Outputs]]) -> FlightLog:
    inputs, outputs = zip(*(change(i, o) for i, o, _ in log.rows()), strict=True)
    return dataclasses.replace(log, inputs=inputs, outputs=outputs)


def with_battery(log: FlightLog, drop_v: float, slope_per_v: float) -> FlightLog:
    """The same motion with a battery that loses `drop_v` evenly, so that the same force takes another thrust."""
    end_s = log.inputs[-1].t_s

    def change(i: Inputs, o: Outputs) -> tuple[Inputs, Outputs]:
        assert i.status is not None
        voltage_v = 16.0 - drop_v * i.t_s / end_s
        i = msgspec.structs.replace(i, status=msgspec.structs.replace(i.status, battery_voltage_v=voltage_v))
        if o.attitude is None:
            return i, o
        thrust = o.attitude.thrust * (1.0 + slope_per_v * (voltage_v - 16.0) / true_hover_thrust())
        return i, msgspec.structs.replace(o, attitude=msgspec.structs.replace(o.attitude, thrust=thrust))

    return changed(log, change)


def test_the_fit_is_the_truth_within_its_uncertainty() -> None:
    """Whatever the parameter was, with a payload for two thirds of the flight."""
    fit = fit_hover_thrust(logged())
    assert fit.hover_thrust == pytest.approx(true_hover_thrust(), rel=0.005)
    assert abs(fit.hover_thrust - true_hover_thrust()) < 4.0 * fit.standard_error
    assert fit.standard_error < 0.002 * true_hover_thrust()
    assert fit.used_s > 10.0
    assert fit.configured == pytest.approx(true_hover_thrust() * (1.0 + ERROR))
    assert fit.last_estimate == pytest.approx(true_hover_thrust() * (1.0 + ERROR), rel=0.01)


@pytest.mark.parametrize("slope_per_v", [-0.02, 0.0])
def test_the_fitted_slope_over_voltage_agrees_with_the_truth_within_its_standard_error(slope_per_v: float) -> None:
    fit = fit_hover_thrust(with_battery(logged(), 1.5, slope_per_v))
    assert fit.slope is not None and fit.voltage_mean_v is not None and fit.voltage_span_v is not None
    assert fit.slope.per_v == pytest.approx(slope_per_v, abs=min(0.003, 4.0 * fit.slope.standard_error_per_v))
    at_mean = true_hover_thrust() + slope_per_v * (fit.voltage_mean_v - 16.0)
    assert fit.hover_thrust == pytest.approx(at_mean, rel=0.005)
    assert SLOPE_MIN_V < fit.voltage_span_v < 1.5


def test_a_voltage_that_hardly_changes_or_is_not_known_gives_no_slope() -> None:
    still = fit_hover_thrust(with_battery(logged(), 0.5 * SLOPE_MIN_V, 0.0))
    assert still.slope is None
    assert still.voltage_mean_v == pytest.approx(16.0, abs=SLOPE_MIN_V)

    def forget(i: Inputs, o: Outputs) -> tuple[Inputs, Outputs]:
        if i.status is None or i.tick % 100:
            return i, o
        return msgspec.structs.replace(i, status=msgspec.structs.replace(i.status, battery_voltage_v=None)), o

    blind = fit_hover_thrust(changed(with_battery(logged(), 1.5, 0.0), forget))
    assert (blind.slope, blind.voltage_mean_v, blind.voltage_span_v) == (None, None, None)
    assert blind.hover_thrust == pytest.approx(still.hover_thrust)


def test_less_flight_is_less_certain() -> None:
    """A quarter of the flight: about twice the uncertainty."""
    log = logged()
    whole = fit_hover_thrust(log)
    begin = next(k for k, o in enumerate(log.outputs) if o.phase_kind.value == "flight")
    count = begin + round(whole.used_s / 4.0 / 0.005)
    short = fit_hover_thrust(
        dataclasses.replace(log, inputs=log.inputs[:count], outputs=log.outputs[:count], sent=log.sent[:count])
    )
    assert short.used_s < 0.3 * whole.used_s
    assert short.standard_error > 1.2 * whole.standard_error


def test_a_log_without_hovering_is_refused_in_one_line() -> None:
    log = logged()
    short = dataclasses.replace(log, inputs=log.inputs[:900], outputs=log.outputs[:900], sent=log.sent[:900])
    with pytest.raises(
        HoverFitError, match=rf"^fast: 0\.\d s of steady flight, expected {FIT_MIN_S:g} s or more[^\n]*$"
    ):
        fit_hover_thrust(short)
    bare = dataclasses.replace(log, metadata={"config": {"json": json.dumps({})}})
    with pytest.raises(HoverFitError, match=r"^fast: no vehicle\.airframe\.mass_kg[^\n]*$"):
        fit_hover_thrust(bare)
