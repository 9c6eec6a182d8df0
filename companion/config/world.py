"""SITL knobs: what is true in the simulated world, whatever the companion believes. Set as `--set world.KEY=VALUE`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from companion.config.base import Fraction, Model, NonNegative, Positive, Vector2, Vector3
from companion.config.faults import Fault as Fault

RelativeError = Annotated[float, Field(ge=-0.5, le=0.5)]


class Push(Model):
    """A known force on the net's centre."""

    t_s: NonNegative
    """On the world's mission clock: seconds since the rotors were armed."""
    duration_s: Positive
    force_world_n: Vector3


class World(Model):
    """The simulated world."""

    payload_kg: Annotated[float, Field(ge=0, le=2)] = 0.2
    """0: nothing is thrown."""
    seed: Annotated[int, Field(ge=0)] = 1
    catch_at_m: Vector2 = (0.0, 0.0)
    """Where the vehicle is when the payload arrives in the net; thrown on its first pass in the direction of +x."""
    throw_velocity_m_s: Vector3 = (-2.0, 0.15, -1.5)
    """Velocity of the payload on arrival, world frame."""
    hover_thrust_error: RelativeError = 0.0
    """Relative error of MPC_THR_HOVER against the truth."""
    rotor_lag_s: Positive = 0.04
    setpoint_delay_s: NonNegative = 0.010
    """From MAVLink arrival to the attitude loop, beside the wire's own time."""
    arm_delay_s: NonNegative = 0.0
    """Goal currents take effect that much later than written, beside the wire's own time."""
    mocap_rate_hz: Positive = 200.0
    mocap_latency_s: NonNegative = 0.005
    mocap_noise_m: NonNegative = 0.0002
    mocap_noise_deg: NonNegative = 0.05
    gyro_noise_rad_s: NonNegative = 0.01
    accel_noise_m_s2: NonNegative = 0.15
    force_noise_n: NonNegative = 0.05
    force_bias_n: Vector3 = (1.2, -0.8, 2.5)
    joint_friction_nm: NonNegative = 0.04
    joint_damping_nms: NonNegative = 0.02
    wind_m_s: Vector3 = (0.0, 0.0, 0.0)
    mass_error: RelativeError = 0.0
    """Relative error of the vehicle file's base mass against the truth."""
    link_mass_error: tuple[RelativeError, RelativeError] = (0.0, 0.0)
    """Relative error of the vehicle file's link masses against the truth; the base's mass stays as it is."""
    battery_start: Fraction = 1.0
    push: Push | None = None
    """For tests of the impedance."""
    natnet_version: Literal["3.0", "4.1"] = "4.1"
    faults: tuple[Fault, ...] = ()
