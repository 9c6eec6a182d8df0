"""Single markers of a motion-capture frame as the core receives them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from companion.model.markers import MARKERS_MAX, Marker, MarkerFrame
from companion.model.types import Vec3


def marker_frame(
    stamp_s: float, age_s: float | None, number: int, positions_world_m: Iterable[Vec3], vehicle_world_m: Vec3
) -> MarkerFrame:
    """Return the markers of a frame, at most the `MARKERS_MAX` nearest to the vehicle.

    Args:
        stamp_s: arrival of the frame.
        age_s: time from mid-exposure to arrival; None if the system does not stamp exposures.
        positions_world_m: finite positions of the markers.
        vehicle_world_m: the newest position at which the vehicle was tracked.
    """
    found = list(positions_world_m)
    if len(found) > MARKERS_MAX:
        found = sorted(found, key=lambda position: math.dist(position, vehicle_world_m))[:MARKERS_MAX]
    return MarkerFrame(
        stamp_s=stamp_s,
        exposed_s=stamp_s - (age_s or 0.0),
        frame_number=number,
        markers=tuple([Marker(position_world_m=position) for position in found]),
    )
