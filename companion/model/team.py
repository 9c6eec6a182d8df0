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
    hardware_error: int | None = None
    """Hardware error (register 70), which switches the servo's torque off; None if there is none."""


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


class Together(Record, frozen=True, kw_only=True):
    """What two members need to begin a motion of the bar at one instant: the lift, and what follows a hold."""

    go_server_s: float | None = None
    """Time on the motion-capture server's clock at which both begin; None until the left member has set it."""
    plan_s: float = 0.0
    """Plan time since the start of the phase: a hold stops the two at slightly different places of their plans."""
    waits: bool = False
    """Whether it holds only because the other does, or has been resumed, and goes on as soon as the other may, too."""


class TeamState(Record, frozen=True, kw_only=True):
    """What a member of the team announces 50 times a second."""

    grip: Grip
    together: Together = Together()
    holds: bool
    """Whether it has stopped where it is, or does more than that."""
    lands: bool
    """Whether it lands because of an event."""
    px4_lands: bool
    """Whether PX4 lands it."""
    position_world_m: tuple[float, float, float]
    """Position of the body's origin, world frame."""
    server_s: float | None = None
    """When it was said, on the clock of the motion-capture server, which both share: exposure of the newest frame; None if unknown."""
    system_id: int | None = None
    """MAVLink system id of its PX4 (MAV_SYS_ID); None if it is unknown, and in older logs."""
    agreed: str | None = None
    """`FlightConfig.agreed` of the member; None from its guardian, and in older logs."""


class PartnerState(Record, frozen=True, kw_only=True):
    """The newest announcement of the other member."""

    stamp_s: float
    """Flight clock at its arrival."""
    said: TeamState


class CarryState(Record, frozen=True, kw_only=True):
    """How a member carries its end of the bar, for the log and the displays."""

    tension_n: float | None
    """Measured force of the bar on the clamp, towards the other end, less what accelerates the bar; low-passed. None while the force is
    not known.
    """
    weight_n: float | None
    """Measured downward force of the bar on the clamp, low-passed; None while the force is not known."""
    offset_m: float
    """Offset of the reference along the bar, towards the other end."""
    rate_m_s: float
    centre_world_m: tuple[float, float, float]
    """Planned centre of the bar, between its handles."""
    yaw_rad: float
    """Planned yaw of the bar: of the direction from its right to its left end."""
