"""The state of an interception. Pure."""

from __future__ import annotations

import math
from enum import Enum

from companion.model.codec import Record
from companion.model.outputs import ChaseState
from companion.model.types import Reference, Vec3
from companion.phases.intercept.ball import Candidate
from companion.phases.intercept.lag import Lag
from companion.phases.intercept.meeting import Plan
from companion.phases.intercept.motion import Motion, State


class Mode(Enum):
    """What the vehicle does."""

    WAIT = "wait"
    CHASE = "chase"  # move to the meeting point
    DODGE = "dodge"  # move aside for a ball that comes to the rotors
    STOP = "stop"  # come to rest after the meeting, and stay
    RETURN = "return"  # move back to where it waited

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


PUSHED = (Mode.CHASE, Mode.DODGE)
"""Modes in which the reference is pushed from tick to tick."""


class Dodge(Record, frozen=True):
    """How the vehicle moves aside."""

    push_m_s2: Vec3
    """Acceleration of the reference."""
    until_s: float
    """Time at which the ball is nearest."""


class Interception(Record, frozen=True, kw_only=True):
    """The state in the air."""

    mode: Mode
    begun_s: float
    home: Reference
    """The plan's reference, at rest."""
    now: State
    """Motion of the reference in this tick."""
    lag: Lag = Lag()
    """The reference's lagging acceleration."""
    motion: Motion | None = None
    """Motion that is flown; None while waiting, during a chase, and before a stop is planned."""
    braking: Motion | None = None
    """Stop that a chase or a dodge follows as long as the limits allow nothing else; None otherwise."""
    plan: Plan | None = None
    """Way to the meeting that was planned last."""
    dodge: Dodge | None = None
    """The way aside that was begun last."""
    candidates: tuple[Candidate, ...] = ()
    frame_number: int = -1
    beside_m: Vec3 = (0.0, 0.0, 0.0)
    """Mean position of the net minus that of its reference."""
    chase: ChaseState | None = None
    """Figures of `plan` for the log; None before the first plan."""
    passing_m: float | None = None
    """Smallest distance from the waiting net of the ball that is seen; None if none is seen."""
    seen: bool = False
    """Whether a ball was seen since the start."""
    judged_s: float = -math.inf
    """When it was last chosen what to do about a ball that comes to the rotors."""
    at_rotors: bool = False
    """Whether the ball that is seen flies through the rotor disks."""
