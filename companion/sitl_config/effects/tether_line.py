"""Section `tether_line` of the simulated world: weight and floor friction of the slack tether."""

from __future__ import annotations

from companion.config.base import NonNegative
from companion.sitl_config.effects import Effect


class TetherLine(Effect):
    """The slack tether. Its anchor, length and attachment are given by the vehicle file; the anchor is on the floor."""

    mass_g_per_m: NonNegative = 16.0
    """Mass per length (p: 5 mm polyester rope, 16 g/m and 3.4 kN, engineeringtoolbox.com; 6 mm 24 to 29 g/m; e: 10 to 30)."""
    floor_friction: NonNegative = 0.3
    """Friction coefficient of the part that lies on the floor; a moving vehicle drags half of that part (e)."""
