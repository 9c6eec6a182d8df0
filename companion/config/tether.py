"""The safety tether and the room of the vehicle file."""

from __future__ import annotations

from companion.config.base import Model, NonNegative, Positive, Span, Vector3


class Tether(Model):
    """The safety tether."""

    anchor_world_m: Vector3
    length_m: Positive
    attachment_body_m: Vector3 = (0.0, 0.0, 0.0)
    margin_m: NonNegative = 0.25
    """Smallest slack at every planned point and at every point where the vehicle could stop."""
    load_rating_n: Positive = 300.0
    """Working load of the whole tether, from anchor to attachment; it must withstand the full thrust of the rotors."""
    weight_n_per_m: NonNegative = 0.1
    """Weight per length; the vehicle carries the part of the tether that hangs from it."""
    turns_max: Positive = 1.5
    """Largest number of turns, in either direction, of the tether about the vertical through the anchor and about the vehicle."""
    taut_slack_m: NonNegative = 0.05
    """Slack below which the tether counts as taut."""
    pull_min_n: Positive = 3.0
    """Smallest pull that is detected. In simulated laboratories without faults, gusts, downwash and a drifted force sensor briefly
    produced 2.8 N. A pull of 3 N tilts a vehicle of 3 kg by 6 deg.
    """
    pull_filter_s: Positive = 0.1
    """Time constant of the low-pass filter on the force that is not due to the rotors, gravity or the tool."""
    pull_time_s: NonNegative = 0.8
    """Duration from which a pull is not treated as an impact."""
    separation_m: Positive = 0.3
    """Distance beyond the tether's length at which, without a pull, the tether counts as separated."""
    rotor_inner_radius_m: NonNegative = 0.15
    """Radius around the body's z axis that is free of rotor blades, so that the tether may hang down there."""
    clearance_min_m: NonNegative = 0.01
    """Smallest distance of the tether from the rotor disks and from the space that the arm sweeps."""


class Room(Model):
    """The flying volume; no part of the vehicle may leave it."""

    x_m: Span
    y_m: Span
    z_m: Span
