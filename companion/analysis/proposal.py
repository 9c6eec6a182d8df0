"""The controller file that is proposed after a flight with an optimised target impedance (`controller.online`)."""

from __future__ import annotations

from pathlib import Path

from companion.analysis.log import FlightLog, writer
from companion.config.controller import AdaptiveConfig
from companion.control.scaled_gains import controller_yaml, written_for
from companion.model.types import PhaseKind

PROPOSAL = "controller.yaml"
"""Name of the file in the folder of the flight."""
CHANGE_MIN = 0.02
"""Smallest change of the scale that is proposed."""


def write_proposal(log: FlightLog, path: Path) -> None:
    """Write the flown gains with the last scale before the landing; no file if the flight did not optimise or hardly changed them.

    Raises:
        OSError: the file cannot be written.
    """
    flown = [
        o.control.impedance_scale for o in log.outputs if o.control is not None and o.phase_kind is PhaseKind.FLIGHT
    ]
    if not flown or (scale := flown[-1]) is None or abs(scale - 1.0) < CHANGE_MIN or log.config_json is None:
        return
    config = log.flight_config()
    controller = config.controller
    if not isinstance(controller, AdaptiveConfig):
        return
    found = written_for(controller.with_impedance_scale(scale), config.vehicle)
    remarks = [
        f"Optimised in the flight {log.path}, mission {config.mission.name}, vehicle {config.vehicle.name},",
        f"by {writer(log.metadata)}: Phi and Lambda of x, y and z are {scale:.3f} times those of",
        f"{controller.law}/{controller.preset}. One flight: judge them by `companion compare` before they replace others.",
    ]
    path.write_text(controller_yaml(found, f"{controller.preset}_online", remarks), encoding="utf-8")
