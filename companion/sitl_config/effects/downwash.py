"""Section `downwash` of the simulated world: the rotors' wakes on arm, net and payload."""

from __future__ import annotations

from companion.config.base import NonNegative, Positive
from companion.sitl_config.effects import Effect


class Downwash(Effect):
    """The four wakes and their drag on arm, net and payload. The radius of a rotor is `rotors.radius_m`, even if that effect is off."""

    spread: Positive = 0.2
    """Standard deviation of the sideways spread of a wake's momentum, divided by the distance below the rotor. The four wakes merge
    into one jet at the depth where the spread equals the rotors' distance from the vehicle's planes of symmetry, 0.23 m: with 0.14 at
    2.5 vehicle sizes (p: Bauersfeld et al., arXiv 2403.13321), with 0.44 at three rotor radii (p: "a few", Wolf et al., Experiments
    in Fluids 2024).
    """
    turbulence_intensity: NonNegative = 0.25
    """RMS of the velocity's fluctuation along each axis, divided by the local mean velocity (p: 0.25 on the axis of a round turbulent
    jet,
    Hussein et al., J. Fluid Mech. 1994)."""
    correlation_time_s: Positive = 0.03
    """Correlation time of the fluctuation (e: eddies with the size of a wake's radius that move at the induced velocity)."""
    link_width_m: NonNegative = 0.03
    """Width of the links across the flow (e; m: an XM430 is 28.5 mm wide)."""
    link_drag_coefficient: NonNegative = 1.1
    """Drag coefficient of a link for flow across its axis (p: long cylinder below the critical Reynolds number, Hoerner 1965)."""
    net_drag_area_m2: NonNegative = 0.009
    """Drag coefficient times area of the net (e: 0.005 for a hoop of 8 mm tube and 0.004 for a mesh of solidity 0.15)."""
    payload_drag_coefficient: NonNegative = 0.47
    """Drag coefficient of the payload (p: sphere below the critical Reynolds number, Hoerner 1965)."""
