"""Pull of the slack tether on the vehicle: weight of the hanging part, catenary tension when little slack is left, and floor friction.

The taut line is still modelled by MuJoCo's tendon limit, and `Truth.tether_tension_n` is the tension of that limit alone, without this
pull. The catenary's tension grows without bound as the slack vanishes, so the slack is taken to be at least `SLACK_MIN_SHARE` of the
distance. The line's air drag is neglected: at 0.5 m/s it is below 1 mN for one hanging metre of 5 mm rope.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from companion.config.tether import Tether
from companion.model.constants import GRAVITY_M_S2
from companion.sitl_config.effects.tether_line import TetherLine as TetherLineConfig
from sitl.world.effects.rotors import Thrusts
from sitl.world.loads import Bodies
from sitl.world.tether import Tether as TautTether
from sitl.world.views import vec3_of

SLACK_MIN_SHARE = 0.005
_DRAGGED_SHARE = 0.5
_SLIDES_M_S = 0.05
"""Speed at which the smoothed friction reaches 0.7 of its full value."""
_STEPS = 40


class Hanging(NamedTuple):
    """Static equilibrium of the slack line."""

    level_n: float
    """Horizontal pull on the upper end, towards the anchor."""
    down_n: float
    """Vertical pull on the upper end."""
    on_floor_m: float


def hanging(level_m: float, height_m: float, length_m: float, weight_n_m: float) -> Hanging:
    """Return the static equilibrium of a line from an anchor on the floor.

    Args:
        level_m: horizontal distance from the anchor to the upper end.
        height_m: height of the upper end above the anchor.
        length_m: length of the line, longer than the distance between its ends.
    """
    h = max(height_m, 0.0)
    if length_m >= level_m + h:
        return Hanging(0.0, weight_n_m * h, length_m - h)
    low, high = 0.0, h + level_m
    while _length_m(level_m, h, high) > length_m:
        low, high = high, 2.0 * high
    for _ in range(_STEPS):
        a = 0.5 * (low + high)
        if _length_m(level_m, h, a) > length_m:
            low = a
        else:
            high = a
    hangs_m = math.sqrt(h * (h + 2.0 * a))
    reach_m = a * math.acosh(1.0 + h / a)
    if reach_m <= level_m:
        return Hanging(weight_n_m * a, weight_n_m * hangs_m, level_m - reach_m)
    return Hanging(weight_n_m * a, 0.5 * weight_n_m * (length_m + h / math.tanh(0.5 * level_m / a)), 0.0)


def _length_m(level_m: float, height_m: float, a_m: float) -> float:
    """Return the length, including any part on the floor, of a catenary whose horizontal tension is the weight of `a_m` of line."""
    reach_m = a_m * math.acosh(1.0 + height_m / a_m)
    if reach_m <= level_m:
        return math.sqrt(height_m * (height_m + 2.0 * a_m)) + level_m - reach_m
    return math.hypot(height_m, 2.0 * a_m * math.sinh(0.5 * level_m / a_m))


class TetherLine:
    """The slack tether.

    Args:
        taut: that tether in the model, which knows its attachment and present length.
    """

    def __init__(self, config: TetherLineConfig, tether: Tether, taut: TautTether, bodies: Bodies) -> None:
        self._weight_n_m = config.mass_g_per_m * 1e-3 * GRAVITY_M_S2
        self._friction = config.floor_friction
        self._anchor, self._whole_m = tether.anchor_world_m, tether.length_m
        self._taut, self._loads, self._base = taut, bodies.loads, bodies.body("base")
        self._centre = bodies.data.xipos[self._base]

    def restart_noise(self) -> None:
        """Do nothing: this effect has no noise."""

    def apply(self, thrust_n: Thrusts, q: Sequence[float], v: Sequence[float]) -> None:
        """Set the pull of the tether on the base."""
        x, y, z = end = self._taut.attachment_world_m
        ax, ay, az = self._anchor
        dx, dy, dz = ax - x, ay - y, az - z
        level_m = math.hypot(dx, dy)
        shortest_m = (1.0 + SLACK_MIN_SHARE) * math.hypot(level_m, dz)
        length_m = max(min(self._taut.length_m, self._whole_m), shortest_m)
        level_n, down_n, on_floor_m = hanging(level_m, -dz, length_m, self._weight_n_m)
        vx, vy = v[0], v[1]
        k = level_n / level_m if level_n > 0.0 else 0.0
        drag = (
            self._friction
            * self._weight_n_m
            * _DRAGGED_SHARE
            * on_floor_m
            / math.sqrt(vx * vx + vy * vy + _SLIDES_M_S**2)
        )
        fx, fy, fz = k * dx - drag * vx, k * dy - drag * vy, -down_n
        cx, cy, cz = vec3_of(self._centre)
        rx, ry, rz = end[0] - cx, end[1] - cy, end[2] - cz
        torque = (ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx)
        self._loads.set(self._base, "tether", (fx, fy, fz), torque)
