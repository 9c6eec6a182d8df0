"""`companion hover fit`: fit the hover thrust to a flight log and compare it with the configured value."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from companion.analysis.hover_fit import SLOPE_MIN_V, HoverFit, HoverFitError, fit_hover_thrust
from companion.analysis.log import TICKS_KEPT, FlightLog, LogError
from companion.config.document import ConfigError
from companion.model.exit_codes import EXIT_OK

_DIGITS = 4
"""Decimal places of a printed or written hover thrust: 0.01 % of full thrust."""


def add_parser(commands: Any) -> None:
    hover = commands.add_parser("hover", help="fit the hover thrust to a flight log")
    parts = hover.add_subparsers(dest="part", required=True, metavar="PART")
    fit = parts.add_parser(
        "fit",
        help="fit the hover thrust to a log",
        description="Fit the hover thrust (without payload) to the steady parts of a flight, and print the lines for the vehicle file.",
    )
    fit.add_argument("log", type=Path, help="flight.mcap")
    fit.add_argument("--json", action="store_true", help="print only the result, as JSON")
    fit.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    try:
        log = FlightLog.read(arguments.log, ticks_max=TICKS_KEPT)
        fit = fit_hover_thrust(log)
    except (LogError, HoverFitError) as error:
        raise ConfigError(str(error)) from None
    log.report_missing_end()
    if arguments.json:
        print(json.dumps(jsonable(fit), indent=2, allow_nan=False))
    else:
        print("\n".join(lines(fit, _vehicle_file(log))))
    return EXIT_OK


def jsonable(fit: HoverFit) -> dict[str, Any]:
    """Return the result for scripts; None where a value is unknown. Thrust is normalised, 0 to 1."""
    slope, known = fit.slope, asdict(fit)
    del known["slope"]
    return {
        **known,
        "configured_error": _relative(fit.configured, fit),
        "slope_per_v": slope.per_v if slope else None,
        "slope_standard_error_per_v": slope.standard_error_per_v if slope else None,
        "patch": {"airframe": {"hover_thrust": round(fit.hover_thrust, _DIGITS)}},
    }


def lines(fit: HoverFit, vehicle_file: str) -> list[str]:
    """Return the result as text."""
    at = f" at {fit.voltage_mean_v:.2f} V" if fit.slope else ""
    compared = [
        f"hover thrust      {fit.hover_thrust:.{_DIGITS}f} ± {fit.standard_error:.{_DIGITS}f} (standard error){at}, "
        f"from {fit.used_s:.1f} s of steady flight"
    ]
    for name, value in (("value at the start", fit.configured), ("value at the end  ", fit.last_estimate)):
        relative = _relative(value, fit)
        if value is not None and relative is not None:
            compared.append(f"{name} {value:.{_DIGITS}f}, {100 * relative:+.2f} % of the fitted value")
    return [
        *compared,
        f"battery           {_battery(fit)}",
        "",
        f"# {vehicle_file}",
        "airframe:",
        f"  hover_thrust: {fit.hover_thrust:.{_DIGITS}f}",
    ]


def _battery(fit: HoverFit) -> str:
    if fit.voltage_mean_v is None or fit.voltage_span_v is None:
        return "voltage not always known; no slope was fitted"
    about = f"{fit.voltage_mean_v:.2f} V on average, changed by {fit.voltage_span_v:.2f} V"
    if fit.slope is None:
        return f"{about}; {SLOPE_MIN_V:g} V or more needed to fit a slope"
    per_v, error = fit.slope.per_v, fit.slope.standard_error_per_v
    return f"{about}; slope {per_v:+.{_DIGITS}f} ± {error:.{_DIGITS}f} per V"


def _relative(value: float | None, fit: HoverFit) -> float | None:
    """Return the relative difference between a value and the fitted one; positive if the value is larger."""
    return None if value is None else value / fit.hover_thrust - 1.0


def _vehicle_file(log: FlightLog) -> str:
    named = (log.config.get("sources") or {}).get("vehicle")
    return str(named) if named else "the vehicle file"
