"""For authors of control laws (docs/own-law.md): settings, inputs, outputs, and the parts that the companion's own laws share."""

from companion.config.base import NonNegative, Positive, Positive3
from companion.config.controller import LawConfig
from companion.config.gains import NonNegative3, NonNegativeJoints, PositiveJoints, fitted
from companion.config.tuned_gain import TunedGain
from companion.config.vehicle import Vehicle
from companion.control.arm_model import dynamics_of, manipulator_of
from companion.control.common import Actuation, DesiredForce, ForceFilter, tracking_errors, wrench_of
from companion.control.compensation import Compensation
from companion.control.manipulator import Manipulator
from companion.control.types import Law, PlantState, Wrench
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import body_x_z_axes_world, quat_conjugate, quat_rotate, yaw_from_quat
from companion.model.types import Joints, Quat, Reference, Vec3

__all__ = [
    "GRAVITY_M_S2",
    "Actuation",
    "Compensation",
    "DesiredForce",
    "ForceFilter",
    "Joints",
    "Law",
    "LawConfig",
    "Manipulator",
    "NonNegative",
    "NonNegative3",
    "NonNegativeJoints",
    "PlantState",
    "Positive",
    "Positive3",
    "PositiveJoints",
    "Quat",
    "Reference",
    "TunedGain",
    "Vec3",
    "Vehicle",
    "Wrench",
    "body_x_z_axes_world",
    "dynamics_of",
    "fitted",
    "manipulator_of",
    "quat_conjugate",
    "quat_rotate",
    "tracking_errors",
    "wrench_of",
    "yaw_from_quat",
]
