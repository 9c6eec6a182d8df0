"""Errors of motion capture beyond white noise and latency.

Sources: (m) the manufacturer, (p) published, (e) an estimate.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import NonNegative, Positive, Vector2, Vector3
from companion.sitl_config.effects import Effect


class Mocap(Effect):
    """Errors of the rigid body's pose, and lost frames."""

    pivot_offset_m: Vector3 = (0.008, -0.006, 0.01)
    """Position of the rigid body's pivot in the body frame; the vehicle file assumes the body's origin. (e) 5 to 20 mm: the
    pivot is placed by eye or at a marker, and the centre of mass moves with the battery."""
    body_yaw_deg: float = 1.0
    """Error of the streamed yaw because the rigid body was created askew; it is added to `mocap_body_yaw_deg`. (e)"""
    body_tilt_deg: Vector2 = (0.3, -0.3)
    """Errors of the streamed roll and pitch; they are added to `mocap_body_tilt_deg`. (e)"""
    lost_share: Annotated[float, Field(ge=0, le=0.5)] = 0.005
    """Fraction of frames in which the body is not tracked. (e) 0.1 to 1 %."""
    lost_burst_s: Positive = 0.02
    """Mean duration of a burst of such frames; durations are exponentially distributed. (e)"""
    wobble_m: NonNegative = 0.002
    """Standard deviation per axis of the position error while some markers are hidden. (p) Merriaux et al., "A Study of Vicon System
    Positioning Performance", Sensors 17 (2017): below 2 mm in motion, 0.15 mm at rest."""
    wobble_deg: NonNegative = 0.3
    """Standard deviation per axis of the attitude error while some markers are hidden: the position error divided by the distance
    between the markers, 0.2 to 0.4 m. (e)
    """
    wobble_s: Positive = 1.0
    """Time for which markers are hidden; the error rises and falls as sin^2. (e)"""
    wobble_every_s: Positive = 8.0
    """Mean time from the end of one such event to the beginning of the next. (e)"""
    delivery_jitter_s: NonNegative = 0.0005
    """Mean of the additional delay of each frame, exponentially distributed, caused by network and operating system; frames keep their
    order. (e)
    """
