"""What two vehicles that carry one bar tell each other, and what a vehicle commands its clamp."""

from __future__ import annotations

from enum import Enum

from companion.model.codec import Record


class ClampCommand(Enum):
    """What the clamp is to do; it keeps the last command."""

    OPEN = "open"
    CLOSE = "close"

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


class ClampState(Record, frozen=True):
    """The clamp's servo."""

    stamp_s: float
    """Flight clock at which the angle was read."""
    angle_rad: float
    """Angle of the shaft (register 132)."""


class BarPose(Record, frozen=True, kw_only=True):
    """The bar's rigid body in the newest motion-capture frame."""

    stamp_s: float
    """Flight clock at the arrival of the frame."""
    position_world_m: tuple[float, float, float]
    """Middle between the handles."""
    attitude_wxyz: tuple[float, float, float, float]
    """Attitude; x points to the left end."""
    tracking_valid: bool


class Grip(Enum):
    """What a member of the team has in its clamp."""

    FREE = "free"  # nothing
    READY = "ready"  # its end of the bar, which stands on its feet, and it can lift
    CARRYING = "carrying"  # its end of the bar, which is in the air
    STANDING = "standing"  # its end of the bar, which stands on its feet again

    # An enum's own hash is a Python function.
    __hash__ = object.__hash__


class TeamState(Record, frozen=True, kw_only=True):
    """What a member of the team announces 50 times a second."""

    grip: Grip
    lift_server_s: float | None = None
    """Time on the motion-capture server's clock at which both lift the bar; None until the left member has set it."""
    holds: bool
    """Whether it has stopped where it is, or does more than that."""
    lands: bool
    """Whether it lands because of an event."""
    px4_lands: bool
    """Whether PX4 lands it."""
    position_world_m: tuple[float, float, float]
    """Position of the body's origin, world frame."""


class PartnerState(Record, frozen=True, kw_only=True):
    """The newest announcement of the other member."""

    stamp_s: float
    """Flight clock at its arrival."""
    said: TeamState


class CarryState(Record, frozen=True, kw_only=True):
    """How a member carries its end of the bar, for the log and the displays."""

    tension_n: float
    """Measured force of the bar on the clamp, towards the other end, less what accelerates the bar; low-passed."""
    weight_n: float
    """Measured downward force of the bar on the clamp, low-passed."""
    offset_m: float
    """Offset of the reference along the bar, towards the other end."""
    rate_m_s: float
    centre_world_m: tuple[float, float, float]
    """Planned centre of the bar, between its handles."""
    yaw_rad: float
    """Planned yaw of the bar: of the direction from its right to its left end."""
