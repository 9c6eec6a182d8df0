"""The state of a vehicle that touches a surface, in the conventions of `companion.model.types`."""

from __future__ import annotations

from enum import Enum

from companion.model.codec import Record
from companion.model.types import Vec3


class ContactMode(Enum):
    """What the flight does about a surface during its contact phases."""

    TARE = "tare"  # at rest before the approach: average the force that is there without contact
    APPROACH = "approach"  # move along the direction until the surface is touched
    PRESS = "press"  # touched: hold the force
    SLIDE = "slide"  # move the tip along the surface while the force is held
    LOST = "lost"  # the force has ended: wait at rest, then approach again
    BACK = "back"  # a point was touched: move back from the surface
    SHIFT = "shift"  # move in front of the next point, or turn to the surface
    LEAVE = "leave"  # release the force, then move back
    RETURN = "return"  # move back to the plan

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


class ContactShift(Record, frozen=True, kw_only=True):
    """A straight move of the reference, from rest to rest, perpendicular to the direction of an approach. Yaw and the last joint turn
    during the move. All values are relative to the plan.
    """

    from_m: Vec3 = (0.0, 0.0, 0.0)
    to_m: Vec3 = (0.0, 0.0, 0.0)
    from_yaw_rad: float = 0.0
    to_yaw_rad: float = 0.0
    from_tool_rad: float = 0.0
    """Turn of the last joint."""
    to_tool_rad: float = 0.0
    length_m: float = 0.0
    """Length of the way; a turn counts as 1 m per rad if that is longer."""
    way_m: float = 0.0
    """Way that is done, its rate and its acceleration."""
    rate_m_s: float = 0.0
    acceleration_m_s2: float = 0.0


class TouchedPoint(Record, frozen=True):
    """A point of a surface that the tool has touched."""

    t_s: float
    tip_world_m: Vec3
    """Mean measured position of the tip's centre."""
    force_n: float
    """Mean measured force."""


class FoundSurface(Record, frozen=True):
    """Plane through the touched points."""

    point_world_m: Vec3
    """Centre of the touched points, on the surface."""
    normal_world: Vec3
    """Unit vector out of the surface, towards the vehicle."""


class ContactState(Record, frozen=True, kw_only=True):
    """Contact with a surface: the part of the reference that depends on the measured force."""

    mode: ContactMode
    since_s: float
    """Flight clock at the beginning of the mode."""
    direction_world: Vec3
    """Unit vector of the approach, into the surface."""
    offset_m: float
    """Offset of the reference from the plan along the direction, its rate and its acceleration."""
    rate_m_s: float
    acceleration_m_s2: float
    bias_n: float
    """Mean force against the direction before the approach."""
    force_n: float
    """Force of the surface against the direction: the sensor's, less `bias_n`, plus `unseen_n`."""
    beyond_s: float
    """Time for which the force has been beyond the threshold that ends the mode."""
    wanted_n: float
    """Force that is to be measured now; 0 without contact."""
    correction_n: float
    """Integral of the force error."""
    push_n: float
    """Force along the direction that the vehicle adds to what its control law needs."""
    tilting_n: float
    """Low-passed push, for which the reference has moved with the vehicle's tilt."""
    tip_per_n_m: Vec3
    """Shift of the reference per push that keeps the tip in place, m/N, world frame."""
    touches: int
    touched_offset_m: float
    failed: bool
    """Whether the contact ended before its planned end."""
    disagreement_bias_n: float = 0.0
    """Mean before the approach of the force that the vehicle's motion shows minus the measured one, both against the direction."""
    disagreement_n: float = 0.0
    """The same difference now, less its mean and low-passed."""
    unopposed_n: float = 0.0
    """Push minus the force that the vehicle's motion shows, low-passed: what the vehicle pushes against nothing."""
    disagreed_s: float = 0.0
    """Time for which one of the two has been beyond `safety.contact_disagreement_n`."""
    shift: ContactShift = ContactShift()
    points: tuple[TouchedPoint, ...] = ()
    """Points touched so far by a `probe`, or by an approach that turns to the surface."""
    samples: int = 0
    """Number of samples of the point that is touched now, their mean position and their mean force."""
    mean_tip_m: Vec3 = (0.0, 0.0, 0.0)
    mean_force_n: float = 0.0
    surface: FoundSurface | None = None
    """Surface through the touched points; None before the last of them."""
    free_m: float = 0.0
    """Offset up to which the way is known to be free."""
    beside_m: Vec3 = (0.0, 0.0, 0.0)
    """Place of the tip minus that of its reference when a slide begins: its path begins where the tip is."""
    lag_m: float = 0.0
    """Distance of the tip behind its reference along a slide."""
    lag_integral_n: float = 0.0
    """Integral part of the force along a slide."""
    slide_world_n: Vec3 = (0.0, 0.0, 0.0)
    """Force along the surface that moves the tip against friction."""
    unseen_n: float = 0.0
    """Force against the direction that the sensor does not measure, averaged: the vehicle's motion shows it during a slide."""
    steer_rad: float = 0.0
    """Turn of the yaw setpoint that steers a sliding tip towards its path."""
    stuck_s: float = 0.0
    """Time for which the tip has been too far behind its reference."""
