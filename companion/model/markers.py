"""Single markers of a motion-capture frame, and the ball among them."""

from __future__ import annotations

from companion.model.codec import Record

MARKERS_MAX = 32
"""Number of markers of a frame that are kept: those nearest to the vehicle."""


class Marker(Record, frozen=True):
    """A marker that belongs to no rigid body. It has no identity: the order in a frame means nothing."""

    position_world_m: tuple[float, float, float]


class MarkerFrame(Record, frozen=True, kw_only=True):
    """Markers of one motion-capture frame that belong to no rigid body, in the world frame of the mission.

    A ball covered with reflective tape is one of them.
    """

    stamp_s: float
    """Flight clock at the arrival of the frame."""
    exposed_s: float
    """Flight clock at mid-exposure; equal to `stamp_s` if the system does not stamp exposures."""
    frame_number: int
    markers: tuple[Marker, ...]
    """At most `MARKERS_MAX`."""


class BallState(Record, frozen=True, kw_only=True):
    """The ball that is seen, and where the net is to meet it, for the log and the displays."""

    position_world_m: tuple[float, float, float]
    """Estimate at the mid-exposure of the newest frame."""
    meeting_world_m: tuple[float, float, float] | None = None
    """Predicted place of the ball when the net meets it; None if no meeting is planned."""
    meeting_s: float | None = None
    """Flight clock at that meeting."""
    sigma_m: float | None = None
    """Standard deviation of that place on each axis."""
