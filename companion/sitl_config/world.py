"""True parameters of the simulated world, which the flight does not know. Set them with `--set world.KEY=VALUE`."""

from __future__ import annotations

import json
import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from companion.config.base import JOINTS_MAX, Fraction, Model, NonNegative, Positive, RelativeError, Vector2, Vector3
from companion.config.devices import NatNetVersion, ServoBaud
from companion.config.explain import nearest
from companion.model.servos import ServoName
from companion.px4.defaults import PX4_DEFAULTS
from companion.px4.versions import Release
from companion.sitl_config.bar import Bar
from companion.sitl_config.effects.air import Air
from companion.sitl_config.effects.barometer import Barometer
from companion.sitl_config.effects.battery import Battery
from companion.sitl_config.effects.compliance import Compliance
from companion.sitl_config.effects.downwash import Downwash
from companion.sitl_config.effects.force_sensor import ForceSensor
from companion.sitl_config.effects.imu import Imu
from companion.sitl_config.effects.machine import Machine
from companion.sitl_config.effects.markers import Markers
from companion.sitl_config.effects.mocap import Mocap
from companion.sitl_config.effects.net import Net
from companion.sitl_config.effects.rotors import Rotors
from companion.sitl_config.effects.servo_mechanics import ServoMechanics
from companion.sitl_config.effects.tether_line import TetherLine
from companion.sitl_config.effects.thrower import Person, Thrower
from companion.sitl_config.faults import Fault as Fault
from companion.sitl_config.per_joint import RelativeErrors
from companion.sitl_config.surfaces import Surface

REAL32_MAX = 3.4e38
SignedAxis = Literal["x", "y", "z", "-x", "-y", "-z"]


def _each_axis_once(names: tuple[str, str, str]) -> tuple[str, str, str]:
    if {name[-1] for name in names} != {"x", "y", "z"}:
        raise ValueError(f"expected each of x, y and z once, with or without a minus sign, got {list(names)}")
    return names


def _px4_can_hold_them(params: dict[str, float]) -> dict[str, float]:
    for name, value in params.items():
        if re.fullmatch("[A-Z0-9_]{1,16}", name) is None:
            raise ValueError(
                f"expected a parameter name with 1 to 16 of the characters A-Z, 0-9 and _, got {json.dumps(name)}"
            )
        integer = isinstance(PX4_DEFAULTS.get(name), int)
        if integer and value != int(value):
            raise ValueError(f"expected a whole number for {name}, an INT32, got {value:g}")
        if abs(value) >= (2**31 if integer else REAL32_MAX):
            raise ValueError(f"{name} cannot hold {value:g}")
    return params


Px4Params = Annotated[dict[str, float], AfterValidator(_px4_can_hold_them)]
SignedAxes = Annotated[tuple[SignedAxis, SignedAxis, SignedAxis], AfterValidator(_each_axis_once)]


class Push(Model):
    """A force on the centre of the net."""

    t_s: NonNegative
    """Time since arming."""
    duration_s: Positive
    force_world_n: Vector3


class Servo(Model):
    """True settings of one servo and its joint. The defaults are the factory settings, with the id and baud rate of the vehicle
    file.
    """

    id: Annotated[int, Field(ge=0, le=252)] | None = None
    """Servo id (register 7); null for the id in the vehicle file. The answers of two servos with the same id collide."""
    baud: Literal[9600, ServoBaud] | None = None
    """Baud rate (register 8); null for the baud rate in the vehicle file."""
    model: ServoName | None = None
    """Model of the servo; null for the model in the vehicle file."""
    firmware: Annotated[int, Field(ge=0, le=255)] | None = None
    """Firmware version (register 6); null for that of the model as delivered."""
    return_delay_us: Annotated[int, Field(ge=0, le=508, multiple_of=2)] = 500
    operating_mode: Literal[0, 3, 5] = 3
    drive_mode: Annotated[int, Field(ge=0, le=5)] = 0
    shadow_id: Annotated[int, Field(ge=0, le=255)] = 255
    current_limit_counts: Annotated[int, Field(ge=0, le=2352)] | None = None
    """Current limit (register 38); null for the factory setting of the model."""
    position_limit_counts: tuple[Annotated[int, Field(ge=0, le=4095)], Annotated[int, Field(ge=0, le=4095)]] = (0, 4095)
    connected: bool = True
    """Whether the servo is plugged in."""
    reversed: bool = False
    """Whether the servo's counts increase in the direction opposite to the sign in the vehicle file."""
    zero_error_deg: float = 0.0
    """True zero of the joint minus the zero in the vehicle file, in the direction of the joint angle."""
    torque_per_amp_error: RelativeError = 0.0
    """Relative error of the vehicle file's torque constant with respect to the true constant."""


class World(Model):
    """The simulated world."""

    extends: Literal["careless", "ideal", "lab", "pair", "robustness", "wall"] | None = None
    """Built-in world whose values hold for every key that this file does not give; null for the default of each key."""
    payload_kg: Annotated[float, Field(ge=0, le=2)] = 0.2
    """Mass of the payload; 0 if nothing is thrown."""
    payload_radius_m: Annotated[float, Field(ge=0.01, le=0.08)] = 0.035
    payload_drag_coefficient: NonNegative = 0.0
    """Drag coefficient of the payload in flight, in still air; about 0.47 for a ball. The wakes' drag is in `downwash`."""
    seed: Annotated[int, Field(ge=0)] = 1
    catch_at_m: Vector2 = (0.0, 0.0)
    """x and y of the vehicle when the payload arrives in the net. The payload is thrown on the first pass in the +x direction that is
    at most 0.5 m to the left or right of this point."""
    throw_to: Literal["passing", "hovering", "either"] = "passing"
    """Vehicle to which the payload is thrown: passing (see `catch_at_m`); hovering, which is one that has hovered within 0.2 m of
    `catch_at_m` for `throw_after_s`, its net at rest; or either: hovering if the mission's plan never passes, else passing."""
    throw_after_s: Positive = 1.0
    """Time for which a vehicle hovers before the payload is thrown to it."""
    throw_velocity_m_s: Vector3 = (-2.0, 0.15, -1.5)
    """Velocity of the payload on arrival, world frame; not used if there are `people`."""
    throw_flight_s: Annotated[float, Field(ge=0.2, le=2.0)] = 0.45
    """Time from the throw to the arrival; not used if there are `people`."""
    people: Annotated[tuple[Person, ...], Field(max_length=8)] = ()
    """People who throw. Each throw is by one of them, drawn from the seed; without any, the payload is thrown from where it arrives
    with `throw_velocity_m_s` after `throw_flight_s`."""
    throws: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of throws. The payload is removed from the net `keep_s` after a catch and thrown again on the next pass."""
    keep_s: Positive = 6.0
    hover_thrust_error: RelativeError = 0.0
    """Relative error of MPC_THR_HOVER with respect to the true hover thrust."""
    rotor_lag_s: Positive = 0.04
    """Time constant of each rotor's thrust; with `rotors.on`, the time constants of that section apply instead."""
    setpoint_delay_s: NonNegative = 0.010
    """Delay from the arrival of a setpoint to its effect in the attitude loop, in addition to the delay of the link."""
    arm_delay_s: NonNegative = 0.0
    """Delay from writing a goal current to its effect, in addition to the delay of the bus."""
    mocap_rate_hz: Positive = 200.0
    mocap_latency_s: NonNegative = 0.005
    mocap_noise_m: NonNegative = 0.0002
    mocap_noise_deg: NonNegative = 0.05
    gyro_noise_rad_s: NonNegative = 0.01
    accel_noise_m_s2: NonNegative = 0.15
    force_noise_n: NonNegative = 0.05
    force_bias_n: Vector3 = (1.2, -0.8, 2.5)
    force_scale: Positive = 1.0
    """The force sensor's readings divided by the true force."""
    net_weight_kg: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Mass that hangs from the centre of the net while the force sensor is being read, for its calibration."""
    net_weight_t_s: NonNegative = 8.0
    """Time from the first reading until the mass is attached."""
    joint_friction_nm: NonNegative = 0.04
    """Constant friction of each joint; with `servo_mechanics.on`, the friction of that section applies instead."""
    joint_damping_nms: NonNegative = 0.02
    """Viscous friction of each joint, N m s/rad; with `servo_mechanics.on`, the friction of that section applies instead."""
    servos: Annotated[tuple[Servo, ...], Field(max_length=JOINTS_MAX)] | None = None
    """Settings of the servos, from the shoulder outwards. Servos that are not listed have the defaults of `Servo`; surplus settings are
    ignored. null for the defaults.
    """
    arm_handling: bool = False
    """Whether a simulated user holds the limp arm and, whenever a servo's LED is switched on, moves it as `companion arm zero`
    requests.
    """
    wind_m_s: Vector3 = (0.0, 0.0, 0.0)
    mass_error: RelativeError = 0.0
    """Relative deviation of the true mass of the base (without arm and tool) from the vehicle file."""
    link_mass_error: RelativeErrors = (0.0, 0.0)
    """Relative deviations of the true link masses from the vehicle file, from the shoulder outwards. The last value also holds for
    further links, and surplus values are ignored. The mass of the base does not change."""
    model_error: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """Relative difference of base mass, inertia, link masses and torque constants between the vehicle file and the true vehicle, in
    addition to the other errors. Each is multiplied by 1 plus or minus this value, with a sign drawn from the seed (the moments of
    inertia share one sign)."""
    battery_start: Fraction = 1.0
    battery_life_s: Positive = 900.0
    """Time from arming until a full battery is empty; with `battery.on`, the hover time with a full battery."""
    push: Push | None = None
    """A push on the net, with which the impedance can be tested; null for none."""
    natnet_version: NatNetVersion = "4.1"
    """NatNet version that the simulated Motive streams."""
    mocap_axes: SignedAxes = ("x", "y", "z")
    """True axis of each streamed axis x, y and z, such as "-y". A left-handed set represents a misconfigured server."""
    mocap_body_yaw_deg: float = 0.0
    """Error of the rigid body's streamed yaw."""
    mocap_body_tilt_deg: Vector2 = (0.0, 0.0)
    """Errors of the rigid body's streamed roll and pitch."""
    mocap_other_id: Annotated[int, Field(ge=0)] | None = None
    """Streaming id of another rigid body, which lies on the floor; null for none."""
    handling: bool = False
    """Whether a simulated user repeatedly carries the vehicle through the guided hand test, with the rotors off."""
    handling_t_s: NonNegative = 20.0
    """World time at which the first hand test begins."""
    handling_taps: Annotated[int, Field(ge=0, le=100)] = 0
    """Number of taps on the frame per round. If it is above 0, the vehicle is only lifted and held, for latency measurement."""
    handling_tap_n: Positive = 30.0
    """Peak force of a tap."""
    px4_version: Literal["1.16", "1.18"] = "1.16"
    """Version of PX4 that the stub imitates where they differ: LAND and Hold of 1.18 start with the acceleration of that moment."""
    px4_params: Px4Params = Field(default={})
    """PX4 parameters by name; they override the parameters of the simulated vehicle. The stub has fewer of them than a real PX4."""
    faults: tuple[Fault, ...] = ()
    surfaces: Annotated[tuple[Surface, ...], Field(max_length=8)] = ()
    """Surfaces that the tip of the arm can touch. Touching one with a rotor is a crash."""
    bar: Bar | None = None
    """The bar of a team of two vehicles; null for the defaults of `Bar`."""
    air: Air = Air()
    downwash: Downwash = Downwash()
    tether_line: TetherLine = TetherLine()
    machine: Machine = Machine()
    force_sensor: ForceSensor = ForceSensor()
    imu: Imu = Imu()
    barometer: Barometer = Barometer()
    mocap: Mocap = Mocap()
    markers: Markers = Markers()
    net: Net = Net()
    thrower: Thrower = Thrower()
    rotors: Rotors = Rotors()
    battery: Battery = Battery()
    servo_mechanics: ServoMechanics = ServoMechanics()
    compliance: Compliance = Compliance()

    def servo(self, joint: int) -> Servo:
        """Return the settings of a joint's servo; joints are counted from 0."""
        return self.servos[joint] if self.servos is not None and joint < len(self.servos) else Servo()

    @property
    def px4_release(self) -> Release:
        """Return `px4_version` as numbers."""
        major, minor = map(int, self.px4_version.split("."))
        return major, minor

    @property
    def thr_mdl_fac(self) -> float:
        """Return PX4's THR_MDL_FAC: from `px4_params`, else from `rotors` if that effect is on, or 0 for linear rotors."""
        return self.px4_params.get("THR_MDL_FAC", self.rotors.thr_mdl_fac if self.rotors.on else 0.0)

    def overridden_px4_params(self) -> dict[str, float | int]:
        """Return `px4_params` in PX4's types, or as float where only a real PX4 knows the type."""
        return {
            name: int(value) if isinstance(PX4_DEFAULTS.get(name), int) else value
            for name, value in self.px4_params.items()
        }

    def unknown_to_the_stub(self) -> list[str]:
        """Return one message for each of `px4_params` that the stub does not have."""
        lines = []
        for name in self.px4_params:
            if name not in PX4_DEFAULTS:
                close = nearest(name, [known.lower() for known in PX4_DEFAULTS])
                hint = f" (did you mean {close.upper()}?)" if close else ""
                lines.append(
                    f"world.px4_params: the simulated PX4 has no parameter {json.dumps(name)}{hint}; a real one may (--sitl=px4)"
                )
        return lines
