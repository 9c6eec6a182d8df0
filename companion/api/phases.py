"""For authors of mission phases (docs/own-phase.md): settings, plan, checks, behaviour in the air, and events."""

from companion.config.phase import Duration, PhaseSettings
from companion.mission.air import NOTHING, Air, Expectation
from companion.mission.phase import Checking, Phase, Planning
from companion.model.codec import Record
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Quat, Reference, SafetyAction, Severity, Vec2, Vec3
from companion.safety.notices import EventDefinition

__all__ = [
    "GRAVITY_M_S2",
    "NOTHING",
    "Air",
    "Checking",
    "Duration",
    "EventDefinition",
    "Expectation",
    "Phase",
    "PhaseSettings",
    "Planning",
    "Quat",
    "Record",
    "Reference",
    "SafetyAction",
    "Severity",
    "Vec2",
    "Vec3",
]
