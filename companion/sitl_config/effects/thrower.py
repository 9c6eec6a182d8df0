"""Section `thrower` of the simulated world: scatter of a person's throws; and the people who throw."""

from __future__ import annotations

from companion.config.base import Model, NonNegative, Positive, Vector3
from companion.sitl_config.effects import Effect


class Person(Model):
    """A person who throws the payload from a fixed place."""

    from_m: Vector3
    """Point at which the payload leaves the hand, world frame."""
    flight_s: Positive = 0.45
    """Time from the throw to the arrival at the net: a long flight is a lob."""
    aims_m: Vector3 = (0.0, 0.0, 0.0)
    """Point at which the person aims, from the net's centre: the rotors, for example."""


class Thrower(Effect):
    """A person who throws the payload. Every value is a standard deviation; the errors are drawn anew for each throw. Without this
    effect, each throw meets the predicted position of the net with `throw_velocity_m_s`.
    """

    scatter: NonNegative = 1.0
    """Factor on every error below: 1 for a skilled person, 3 for a person without practice, 6 for a careless one (e)."""
    speed_error: NonNegative = 0.02
    """Relative error of the release speed. Skilled basketball players: 0.05 to 0.13 m/s of about 7 m/s (p: Slegers et al. 2021)."""
    direction_error_deg: NonNegative = 1.3
    """Error of the release direction, sideways and in elevation. Skilled basketball players: 1.3 (p: Slegers et al. 2021)."""
    release_error_m: NonNegative = 0.05
    """Scatter of the release point on each axis. The thrower aims from that point, so the scatter changes the payload's speed and
    direction at the net, but not its point of arrival (e).
    """
    prediction_error_s: NonNegative = 0.05
    """Error of the time over which the person extrapolates the vehicle's motion (e)."""
