"""Implementations of `companion.control.manipulator` and `companion.control.dynamics`, and the choice between them."""

from __future__ import annotations

from companion.config.vehicle import Vehicle
from companion.control.arm_model.planar_dynamics import PlanarDynamics
from companion.control.arm_model.planar_manipulator import PlanarManipulator
from companion.control.dynamics import Dynamics
from companion.control.manipulator import Manipulator


def manipulator_of(vehicle: Vehicle) -> Manipulator:
    """Return kinematics and gravity torques of the vehicle's arm."""
    return PlanarManipulator(vehicle.arm, vehicle.tool)


def dynamics_of(vehicle: Vehicle, mass_scale: float = 1.0) -> Dynamics:
    """Return the dynamics of the vehicle and its arm.

    Args:
        vehicle: masses, geometry, inertia of the base and of the joints.
        mass_scale: factor on every mass and inertia of the model; 1 is the vehicle file's model.
    """
    return PlanarDynamics(vehicle, mass_scale)
