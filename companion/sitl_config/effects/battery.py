"""Section `battery` of the simulated world: internal resistance, charge, and thrust as a function of voltage."""

from __future__ import annotations

from companion.config.base import NonNegative, Positive
from companion.sitl_config.effects import Effect


class Battery(Effect):
    """True battery. Its capacity is the charge that a hover of `world.battery_life_s` draws. The values are those of four cells;
    resistance and voltage are scaled to the vehicle file's `airframe.battery_cells`."""

    resistance_ohm: NonNegative = 0.028
    """Internal resistance with leads (p: 5 to 8 mohm per cell in good health, new packs 1 to 4, aged packs 8 to 12; e: leads 4)."""
    full_thrust_v: Positive = 16.0
    """Voltage at which the vehicle file's `thrust_max_n` is correct; thrust is proportional to the square of the voltage (e)."""
    power_w_n15: Positive = 3.9
    """Electrical power of a rotor divided by thrust^1.5, W/N^1.5 (e: an efficiency of 0.56 against the ideal 2.19 for a 13-inch
    rotor; 9.5 g/W at 7.4 N).
    """
    electronics_w: NonNegative = 15.0
    """Electrical power of everything but the rotors (e: companion computer, autopilot, sensors, servos)."""
