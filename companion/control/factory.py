"""Build the configured control law. `companion.control` says where a new law begins."""

from __future__ import annotations

from companion.config.controller import AdaptiveConfig, ControllerConfig, CscConfig, PscConfig
from companion.config.vehicle import Vehicle
from companion.control.adaptive import AdaptiveController
from companion.control.csc import CscController
from companion.control.psc import PscController
from companion.control.types import Law


def build_controller(config: ControllerConfig, vehicle: Vehicle, hover_thrust: float) -> Law:
    """Return a new controller. `hover_thrust` is the normalised thrust that carries the vehicle without payload."""
    match config:
        case AdaptiveConfig():
            return AdaptiveController(config, vehicle, hover_thrust)
        case CscConfig():
            return CscController(config, vehicle, hover_thrust)
        case PscConfig():
            return PscController(config, vehicle, hover_thrust)
