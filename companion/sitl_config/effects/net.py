"""Section `net` of the simulated world: entry, settling and swing of a payload in the net."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import Fraction, Positive
from companion.sitl_config.effects import Effect


class Net(Effect):
    """A hoop with a bag of elastic mesh. A payload counts as caught once it has been in the bag for 0.4 s; the time of the catch is the
    time of its first contact. Without this effect, the payload is fixed to the net at the point where it touches the net."""

    bag_depth_m: Annotated[float, Field(ge=0.05, le=0.5)] = 0.10
    """Depth of the payload's centre below the hoop at which the mesh is just taut; also the length of the pendulum (e)."""
    bag_stiffness_n_m: Annotated[float, Field(gt=0, le=5000)] = 500.0
    """Stiffness of the mesh: it stops 0.1 to 0.3 kg in 20 to 40 ms (e)."""
    restitution: Fraction = 0.3
    """Speed at which the mesh and the hoop return a payload, divided by its speed of arrival (e)."""
    pocket: Fraction = 0.5
    """Distance of the settled payload from the centre, divided by its distance at entry: 0 if it slides to the middle of the bag, 1 if
    the mesh forms a pocket at the point of entry (e).
    """
    swing_damping_ratio: Positive = 0.15
    """Damping ratio of the settled payload's swing (e)."""
