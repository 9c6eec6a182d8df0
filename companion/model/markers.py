"""Single markers of a motion-capture frame."""

from __future__ import annotations

from companion.model.codec import Record

MARKERS_MAX = 8
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
