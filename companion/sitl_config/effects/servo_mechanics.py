"""Section `servo_mechanics` of the simulated world: the mechanics between a servo's goal current and the torque on its link."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from companion.config.base import NonNegative, Positive
from companion.sitl_config.effects import Effect
from companion.sitl_config.per_joint import RelativeErrors

GEAR_MIN_DEG_PER_NM = 0.15
"""Smallest compliance of the gear; with a stiffer gear, the lightest rotor and link would oscillate too fast for the physics step of
2 ms.
"""
Share = Annotated[float, Field(ge=0, lt=0.5)]


class ServoMechanics(Effect):
    """Current loop, torque constant, friction, backlash and gear stiffness of the servos.

    The friction model is M4 of Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators" (ICRA 2025),
    which Rhoban/bam has identified for a Dynamixel MX-64, an MX-106 and an XL330. The XM430-W210 is not among them; its torques are
    scaled from those of the MX-64 and the MX-106 by stall torque (3.0 against 6.0 and 8.4 N m at 12 V).
    """

    torque_per_amp_error: RelativeErrors = (0.0, 0.0)
    """Relative errors of the vehicle file's torque constant with respect to each servo's true constant, from the shoulder outwards, in
    addition to those in `servos`. The last value also holds for further servos, and surplus values are ignored (m: the MX-106's differs
    by 5 % between stall currents; e: +-10 % between servos)."""
    current_loop_s: NonNegative = 0.003
    """Time constant of the current loop; 0 for none (e: ROBOTIS discloses only that the loop runs much faster than 1 kHz)."""
    friction_nm: NonNegative = 0.015
    """Coulomb friction without load, in addition to `stiction_nm`, N m (p, scaled: MX-64 0.031, MX-106 0)."""
    stiction_nm: NonNegative = 0.025
    """Additional friction without load at rest, which decays with increasing speed, N m (p, scaled: MX-64 0.012, MX-106 0.037)."""
    load_friction: Share = 0.005
    """Additional Coulomb friction divided by the load of the gear. The load is the difference between the motor's torque and the link's
    torque on the gear: twice the torque that the servo holds (p: MX-64 0, MX-106 0.009, XL330 0.07)."""
    load_stiction: Share = 0.2
    """Additional stiction, which decays with increasing speed, divided by the load of the gear (p: MX-64 0.234, MX-106 0.222, XL330
    0.07).
    """
    stribeck_rad_s: Positive = 1.6
    """Joint speed at which the stiction has fallen to 1/e (p: MX-64 1.52, MX-106 1.62)."""
    stribeck_exponent: Annotated[float, Field(ge=0.5, le=4)] = 1.33
    """Exponent of the stiction's decay with speed (p: MX-64 1.33, MX-106 1.32)."""
    viscous_nms: NonNegative = 0.012
    """Viscous friction, N m s/rad (p, scaled: MX-64 0.007, MX-106 0.018)."""
    backlash_deg: NonNegative = 0.25
    """Free play of the gear, from one end to the other (m: 15 arcmin)."""
    gear_deg_per_nm: Annotated[float, Field(ge=GEAR_MIN_DEG_PER_NM, le=5)] = GEAR_MIN_DEG_PER_NM
    """Twist of the gear under load, deg per N m (e: not published; the default is the stiffest that the physics step permits)."""
    gear_relaxation_s: Annotated[float, Field(ge=0, le=0.0015)] = 0.0015
    """Damping of the gear divided by its stiffness (e: gear meshes damp well; 0.25 of critical damping at 50 Hz)."""
    warm_up_k: NonNegative = 25.0
    """Final rise of the motor's temperature above the temperature of the torque calibration (e; an XL330 in Rhoban/bam's recordings
    warms by 11 K in 2 min).
    """
    warm_up_s: Positive = 600.0
    """Time constant of the warm-up (e)."""
    warm_since_s: NonNegative = 0.0
    """Time for which the motors have been warming up when the world starts."""
    torque_constant_per_k: Annotated[float, Field(ge=-0.01, le=0.01)] = -0.0011
    """Relative change of the torque constant per kelvin (p: value of a Maxon motor, quoted in the LEO robot's file for its
    XM430-W210).
    """
    friction_per_k: Annotated[float, Field(ge=-0.02, le=0.02)] = -0.005
    """Relative change of all friction per kelvin (e)."""
