"""Section `markers` of the simulated world: single markers in the frames of motion capture. They are streamed only if the vehicle file
has `devices.mocap.ball`.

Sources: (p) published, (e) an estimate.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import NonNegative, Positive, Vector3
from companion.sitl_config.effects import Effect


class Markers(Effect):
    """Errors of single markers. Without this effect, the cameras see every ball in every frame, and nothing else."""

    noise_m: NonNegative = 0.001
    """Standard deviation per axis of a ball's position, in addition to `mocap_noise_m`: tape covers it unevenly. (p) Merriaux et al.,
    Sensors 17 (2017): below 2 mm in motion."""
    range_m: Positive = 5.0
    """Largest horizontal distance from the origin at which the cameras see a ball (e)."""
    hidden_near_m: NonNegative = 0.12
    """Distance from the net's centre within which the hoop and the mesh hide a ball (e: a hoop of 9 cm)."""
    hidden_behind_m: NonNegative = 0.25
    """Distance from the centre of the base within which the airframe hides a ball (e)."""
    lost_share: Annotated[float, Field(ge=0, le=0.5)] = 0.03
    """Fraction of the frames in which a ball is not seen for any other reason (e)."""
    lost_burst_s: Positive = 0.015
    """Mean duration of such a gap; durations are exponentially distributed (e)."""
    stray_per_s: NonNegative = 2.0
    """Mean number of reflections that appear per second at random places around the vehicle (e)."""
    stray_s: Positive = 0.03
    """Mean time for which such a reflection is seen; it does not move (e)."""
    fixed_m: Annotated[tuple[Vector3, ...], Field(max_length=8)] = ()
    """Reflections that are always there, such as on a shiny floor, world frame."""
    wand_at_m: Vector3 | None = None
    """Centre of the circle of 0.4 m on which a person swings a marker wand at one turn per second; null for none."""
