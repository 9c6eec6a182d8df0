"""Implementations of `companion.control.manipulator` and `companion.control.dynamics`, and the choice between them: the planar 2R arm
has closed forms, which cost a fraction; every other arm is computed as a chain.
"""

from __future__ import annotations

from companion.config.arm_chain import chain_of
from companion.config.vehicle import Vehicle
from companion.control.arm_model.chain_dynamics import ChainDynamics
from companion.control.arm_model.chain_manipulator import ChainManipulator
from companion.control.arm_model.planar_dynamics import PlanarDynamics
from companion.control.arm_model.planar_manipulator import PlanarManipulator, is_planar_2r
from companion.control.dynamics import Dynamics
from companion.control.manipulator import Manipulator


def manipulator_of(vehicle: Vehicle) -> Manipulator:
    """Return kinematics and gravity torques of the vehicle's arm."""
    chain = chain_of(vehicle)
    return PlanarManipulator(chain) if is_planar_2r(chain) else ChainManipulator(chain)


def dynamics_of(vehicle: Vehicle, mass_scale: float = 1.0) -> Dynamics:
    """Return the dynamics of the vehicle and its arm.

    Args:
        vehicle: masses, geometry, inertia of the base and of the joints.
        mass_scale: factor on every mass and inertia of the model; 1 is the vehicle file's model.
    """
    chain, airframe = chain_of(vehicle), vehicle.airframe
    if is_planar_2r(chain):
        return PlanarDynamics(chain, airframe.mass_kg, airframe.inertia_kg_m2, mass_scale)
    return ChainDynamics(chain, airframe.mass_kg, airframe.inertia_kg_m2, mass_scale)
