"""SITL knobs: what is true in the simulated world, whatever the companion believes. Set as `--set world.KEY=VALUE`."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from companion.config.base import Fraction, Model, NonNegative, Positive, Vector2, Vector3
from companion.config.explain import nearest
from companion.px4.defaults import PX4_DEFAULTS
from companion.sitl_config.faults import Fault as Fault

REAL32_MAX = 3.4e38
RelativeError = Annotated[float, Field(ge=-0.5, le=0.5)]
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]


def _each_axis_once(names: tuple[str, str, str]) -> tuple[str, str, str]:
    if {name[-1] for name in names} != {"x", "y", "z"}:
        raise ValueError(f"each of x, y and z once, with or without a minus, got {list(names)}")
    return names


def _px4_has_them(params: dict[str, float]) -> dict[str, float]:
    for name, value in params.items():
        if name not in PX4_DEFAULTS:
            close = nearest(name, [known.lower() for known in PX4_DEFAULTS])
            hint = f" (did you mean {close.upper()}?)" if close else ""
            raise ValueError(f"the simulated PX4 has no parameter {json.dumps(name)}{hint}")
        if isinstance(PX4_DEFAULTS[name], int) and value != int(value):
            raise ValueError(f"{name} is an INT32, got {value:g}")
        if abs(value) >= (2**31 if isinstance(PX4_DEFAULTS[name], int) else REAL32_MAX):
            raise ValueError(f"{name} does not hold {value:g}")
    return params


Px4Params = Annotated[dict[str, float], AfterValidator(_px4_has_them)]
SignedAxes = Annotated[tuple[SignedAxis, SignedAxis, SignedAxis], AfterValidator(_each_axis_once)]


class Push(Model):
    """A known force on the net's centre."""

    t_s: NonNegative
    """On the world's mission clock: seconds since the rotors were armed."""
    duration_s: Positive
    force_world_n: Vector3


class Servo(Model):
    """What is true of one servo and its joint, whatever the vehicle file says. Without a word it comes out of its box, with the vehicle
    file's id and baud rate."""

    id: Annotated[int, Field(ge=0, le=252)] | None = None
    """Register 7; null: the vehicle file's. Two servos may have the same: then their answers collide."""
    baud: Literal[9600, 57600, 115200, 1000000, 2000000, 3000000, 4000000] | None = None
    """Register 8; null: the vehicle file's."""
    firmware: Annotated[int, Field(ge=0, le=255)] = 48
    return_delay_us: Annotated[int, Field(ge=0, le=508, multiple_of=2)] = 500
    operating_mode: Literal[0, 3, 5] = 3
    drive_mode: Annotated[int, Field(ge=0, le=5)] = 0
    shadow_id: Annotated[int, Field(ge=0, le=255)] = 255
    current_limit_counts: Annotated[int, Field(ge=0, le=1193)] = 1193
    position_limit_counts: tuple[Annotated[int, Field(ge=0, le=4095)], Annotated[int, Field(ge=0, le=4095)]] = (0, 4095)
    connected: bool = True
    """Its plug is in."""
    reversed: bool = False
    """Mounted the other way round: its counts run against the vehicle file's sign."""
    zero_error_deg: float = 0.0
    """The joint's zero is so much further in the direction of the joint angle than the vehicle file says."""
    torque_per_amp_error: RelativeError = 0.0
    """Relative error of the vehicle file's torque constant against the truth."""


class World(Model):
    """The simulated world."""

    payload_kg: Annotated[float, Field(ge=0, le=2)] = 0.2
    """0: nothing is thrown."""
    seed: Annotated[int, Field(ge=0)] = 1
    catch_at_m: Vector2 = (0.0, 0.0)
    """Where the vehicle is when the payload arrives in the net; thrown on its first pass in the direction of +x, at most 0.5 m
    to the left or right."""
    throw_velocity_m_s: Vector3 = (-2.0, 0.15, -1.5)
    """Velocity of the payload on arrival, world frame."""
    throws: Annotated[int, Field(ge=1, le=1000)] = 1
    """More than one: the payload is taken out of the net `keep_s` after it was caught, and thrown again on the next such pass."""
    keep_s: Positive = 6.0
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
    accel_vibration_m_s2: NonNegative = 0.0
    """Amplitude of the vibration of armed rotors on each axis of the accelerometer, as its raw samples have it; PX4 sends means."""
    accel_vibration_hz: Positive = 120.0
    force_noise_n: NonNegative = 0.05
    force_bias_n: Vector3 = (1.2, -0.8, 2.5)
    force_scale: Positive = 1.0
    """The force sensor's readings are larger than the truth by this."""
    net_weight_kg: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Somebody hangs it on the net's centre while the force sensor is being read, and takes it off when that ends."""
    net_weight_t_s: NonNegative = 8.0
    """From the first reading until it hangs there."""
    joint_friction_nm: NonNegative = 0.04
    joint_damping_nms: NonNegative = 0.02
    servos: tuple[Servo, Servo] | None = None
    """Null: both as `Servo` says without a word."""
    arm_hand: bool = False
    """A hand holds the arm whenever it is limp, and moves it as `companion arm zero` asks: on whenever the servos' lights go on."""
    wind_m_s: Vector3 = (0.0, 0.0, 0.0)
    mass_error: RelativeError = 0.0
    """Relative error of the vehicle file's base mass against the truth."""
    link_mass_error: tuple[RelativeError, RelativeError] = (0.0, 0.0)
    """Relative error of the vehicle file's link masses against the truth; the base's mass stays as it is."""
    battery_start: Fraction = 1.0
    battery_life_s: Positive = 900.0
    """Of a full battery, from arming on."""
    push: Push | None = None
    """For tests of the impedance."""
    natnet_version: Literal["3.0", "4.1"] = "4.1"
    mocap_axes: SignedAxes = ("x", "y", "z")
    """What the streamed x, y and z truly are, "-y" and so on; a left-handed set is what a badly configured server may stream."""
    mocap_body_yaw_deg: float = 0.0
    """The rigid body's zero is off: its streamed yaw is larger than the true one by this."""
    mocap_body_tilt_deg: Vector2 = (0.0, 0.0)
    """The same for roll and pitch."""
    mocap_other_id: Annotated[int, Field(ge=0)] | None = None
    """Streaming id of another rigid body, which lies on the floor of the room."""
    hand: bool = False
    """A hand carries the machine through the guided hand test, rotors off, again and again."""
    hand_t_s: NonNegative = 20.0
    """World time at which it first does."""
    hand_taps: Annotated[int, Field(ge=0, le=100)] = 0
    """More than none: the hand only lifts and holds the machine, and another one taps its frame so often a round."""
    hand_tap_n: Positive = 30.0
    """Peak of a tap's force."""
    px4_params: Px4Params = Field(default={})
    """Parameters of PX4 that somebody has spoiled after it was set up, by name."""
    faults: tuple[Fault, ...] = ()

    def servo(self, joint: int) -> Servo:
        """The servo of joint 0 or 1."""
        return Servo() if self.servos is None else self.servos[joint]

    def overridden_px4_params(self) -> dict[str, float | int]:
        """`px4_params` in PX4's types."""
        return {
            name: int(value) if isinstance(PX4_DEFAULTS[name], int) else value
            for name, value in self.px4_params.items()
        }
