"""The true battery: open-circuit voltage as a function of charge, internal resistance, and the current for the rotors' power.

Sources: open-circuit voltage of a lithium-polymer cell (Chen and Rincon-Mora, IEEE Trans. Energy Conversion 2006, eq. 2; without its RC
elements); power of a rotor proportional to thrust^1.5 (momentum theory with a constant figure of merit); thrust at a given motor signal
proportional to the square of the voltage (ESCs without voltage compensation).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from companion.config.airframe import Airframe
from companion.sitl_config.effects.battery import Battery as BatteryConfig

_CONFIGURED_CELLS = 4
"""Number of cells for which section `battery` gives resistance and voltage."""


def open_circuit_v(charge: float, cells: int) -> float:
    """Return the voltage of a battery with this number of cells without load at a state of charge (0 to 1)."""
    cell_v = 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201)) - 1.031 * math.exp(-35.0 * charge)
    return cells * cell_v


class BatteryPack:
    """The battery; call `step` once per physics step.

    Args:
        start: state of charge at arming, 0 to 1.
        life_s: hover time with a full battery.
        weight_n: weight of the vehicle, for the hover current.
        airframe: airframe of the vehicle file, for the numbers of rotors and cells.
    """

    def __init__(self, config: BatteryConfig, start: float, life_s: float, weight_n: float, airframe: Airframe) -> None:
        self._cells = airframe.battery_cells
        relative = self._cells / _CONFIGURED_CELLS
        self._resistance_ohm = relative * config.resistance_ohm
        self._power_w_n15 = config.power_w_n15
        self._electronics_w = config.electronics_w
        self._full_thrust_v = relative * config.full_thrust_v
        self._start = start
        hover_w = config.electronics_w + config.power_w_n15 * weight_n * math.sqrt(
            weight_n / airframe.rotor_layout.count
        )
        self.hover_v = self._loaded_v(open_circuit_v(start, self._cells), hover_w)
        self.capacity_as = hover_w / self._loaded_v(open_circuit_v(0.5, self._cells), hover_w) * life_s
        """Charge of the full battery in A s: the hover current at half charge multiplied by `life_s`."""
        self.restart()

    def restart(self) -> None:
        """Reset the battery to its charge at arming."""
        self.drawn_as = 0.0
        """Charge drawn since arming, A s."""
        self.voltage_v = self._loaded_v(open_circuit_v(self._start, self._cells), self._electronics_w)
        self.current_a = self._electronics_w / self.voltage_v

    def _loaded_v(self, open_v: float, power_w: float) -> float:
        """Return the voltage under a constant power: the upper root of v = open_v - resistance * power / v."""
        return 0.5 * (open_v + math.sqrt(max(0.0, open_v * open_v - 4.0 * self._resistance_ohm * power_w)))

    @property
    def remaining(self) -> float:
        """State of charge, 0 to 1."""
        return max(0.0, self._start - self.drawn_as / self.capacity_as)

    def thrust_ratio(self, voltage_v: float) -> float:
        """Return the thrust at this voltage relative to the thrust in the vehicle file, at the same motor signal."""
        ratio = voltage_v / self._full_thrust_v
        return ratio * ratio

    def step(self, dt_s: float, thrust_n: Iterable[float]) -> None:
        """Draw the current for these rotor thrusts during one physics step."""
        rotors_n15 = 0.0
        for force in thrust_n:
            rotors_n15 += force * math.sqrt(force)
        power_w = self._electronics_w + self._power_w_n15 * rotors_n15
        self.voltage_v = voltage_v = self._loaded_v(open_circuit_v(self.remaining, self._cells), power_w)
        self.current_a = current_a = power_w / voltage_v
        self.drawn_as += current_a * dt_s
