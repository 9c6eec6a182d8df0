"""For authors of mission phases (docs/own-phase.md): settings, plan, checks, behaviour in the air, and events."""

from companion.config.phase import Duration, PhaseSettings
from companion.mission.air import NOTHING, Air, Expectation, Observation
from companion.mission.arm_motion import ArmLimits
from companion.mission.minsnap import VehicleLimits, least_line_s
from companion.mission.phase import Checking, Phase, Planning
from companion.mission.plan_builder import PlanBuilder
from companion.mission.segments import Segment
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Quat, Reference, SafetyAction, Severity, Vec2, Vec3
from companion.safety.notices import EventDefinition

__all__ = [
    "GRAVITY_M_S2",
    "NOTHING",
    "Air",
    "ArmLimits",
    "Checking",
    "Duration",
    "EventDefinition",
    "Expectation",
    "Observation",
    "Phase",
    "PhaseSettings",
    "PlanBuilder",
    "Planning",
    "Quat",
    "Record",
    "Reference",
    "SafetyAction",
    "Segment",
    "Severity",
    "Vec2",
    "Vec3",
    "VehicleLimits",
    "least_line_s",
]
