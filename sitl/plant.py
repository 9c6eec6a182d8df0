"""The vehicle with its sensors, motors and autopilot, without the devices' protocols.

`Plant.step` advances everything by one physics step. The server adds the real protocols; the fast closed loop uses the plant directly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Protocol

from companion.config.arm import Joint
from companion.config.vehicle import Vehicle
from companion.model.algebra import scaled
from companion.model.types import Vec3
from companion.sitl_config.distributions import with_model_error
from companion.sitl_config.faults import Fault, FaultKind
from companion.sitl_config.per_joint import of_joints
from companion.sitl_config.world import Push, Servo
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.types import Battery, ImuSample, RotorCommands
from sitl.faults.injector import CELL_FULL_V, Faults
from sitl.mocap import Mocap
from sitl.servo.from_config import torque_constants_nm_a
from sitl.world.effects import barometer
from sitl.world.effects.barometer import Barometer
from sitl.world.effects.force_sensor import ForceSensor
from sitl.world.effects.imu import ImuErrors
from sitl.world.effects.transmission import Transmission, transmissions_of
from sitl.world.handling import Handling, HungWeight
from sitl.world.jaws import Jaws
from sitl.world.noise import noise
from sitl.world.scene import Scene
from sitl.world.start import MachineSpec, Start
from sitl.world.state import PHYSICS_DT_S, Truth

IMU_EVERY: Final = 2
"""Physics steps per IMU sample: 250 Hz, the rate of PX4's rate loop."""
BARO_EVERY: Final = round(barometer.PERIOD_S / PHYSICS_DT_S)
"""Physics steps per sample of the barometer."""
CELL_EMPTY_V: Final = 3.5
_COUNTS_PER_RAD = 4096.0 / (2.0 * math.pi)


class Px4(Protocol):
    """An autopilot that is stepped with IMU samples."""

    def step(self, imu: ImuSample) -> RotorCommands:
        """Process one IMU sample and return normalised rotor commands."""


class JointDrive(Protocol):
    """The motor of one servo, in the servo's own angle convention."""

    goal_delay_s: float
    """Delay from writing a goal current to its effect in s."""

    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Process the shaft's state and return the motor current in A."""


class _JointServo(NamedTuple):
    """The servo of one joint."""

    drive: JointDrive
    sign: int
    """1 if the shaft angle increases with the joint angle, -1 if it decreases."""
    zero_rad: float
    """Shaft angle at joint angle 0."""
    torque_per_amp_nm_a: float
    gear: Transmission | None
    """Gear and mount between the servo and its link; None if they are rigid."""
    q: int
    v: int
    """Indices of the joint in qpos and qvel."""


def _zero_rad(joint: Joint, servo: Servo) -> float:
    return joint.zero_count / _COUNTS_PER_RAD + joint.sign * math.radians(servo.zero_error_deg)


def battery_voltage_v(remaining: float, cells: int) -> float:
    """Return the voltage of a battery with this number of cells at a state of charge of 0 to 1."""
    return cells * (CELL_EMPTY_V + (CELL_FULL_V - CELL_EMPTY_V) * remaining)


_IMU, _FORCE, _IMU_DRIFT = 1, 2, 11
"""Second part of the seed of each sensor's noise."""


class Plant:
    """The simulated world with its sensors and motors.

    Args:
        between_steps: as in `Mocap`.
        jaws: motor of the clamp's servo; None without a clamp.
        scene: the scene of which this is machine `number`; None for a scene of its own.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        config: WorldConfig,
        px4: Px4,
        drives: Sequence[JointDrive],
        start: Start,
        *,
        between_steps: bool = False,
        jaws: JointDrive | None = None,
        scene: Scene | None = None,
        number: int = 0,
    ) -> None:
        joints = vehicle.arm.joints
        config = with_model_error(config, len(joints))
        self._config = config
        self._px4 = px4
        for drive in drives:
            drive.goal_delay_s = config.arm_delay_s
        self.scene = scene or Scene([MachineSpec(vehicle, config, start)])
        self.machine = self.scene.machines[number]
        self.number = number
        self.jaws = None if vehicle.jaws is None or jaws is None else Jaws(vehicle.jaws, jaws)
        """Jaws of the clamp; None without a clamp."""
        servos = [config.servo(joint) for joint in range(len(joints))]
        mechanics = config.servo_mechanics
        more = of_joints(mechanics.torque_per_amp_error if mechanics.on else (0.0,), len(joints))
        transmissions = transmissions_of(vehicle, config, start.arm_rad, PHYSICS_DT_S)
        gears = transmissions or (None,) * len(joints)
        self._servos = tuple(
            _JointServo(
                drive,
                -joint.sign if servo.reversed else joint.sign,
                _zero_rad(joint, servo),
                nm_a / (1.0 + servo.torque_per_amp_error) / (1.0 + error),
                gear,
                at_q,
                at_v,
            )
            for drive, joint, servo, nm_a, error, gear, at_q, at_v in zip(
                drives,
                joints,
                servos,
                torque_constants_nm_a(vehicle),
                more,
                gears,
                self.machine.layout.joint_q,
                self.machine.layout.joint_v,
                strict=True,
            )
        )
        if transmissions:
            self.machine.add_joint_inertia(transmissions)
        hover_n = self.machine.weight_n / self.machine.rotor_count
        layout, interval_s = vehicle.airframe.rotor_layout, IMU_EVERY * PHYSICS_DT_S
        self._imu_errors = ImuErrors(config.imu, interval_s, hover_n, layout) if config.imu.on else None
        rest_m, arm_m = vehicle.airframe.ground_clearance_m, layout.arm_m
        self._barometer = Barometer(config.barometer, self.machine.weight_n, rest_m, arm_m, config.seed)
        ball = vehicle.devices.mocap.ball
        self.mocap = Mocap(config, ball, self.scene, self.machine, between_steps=between_steps)
        self._seed_noise()
        self._handling = Handling(config, self.machine.weight_n) if config.handling else None
        self._weight = HungWeight(config) if config.net_weight_kg > 0.0 else None
        self.force_is_read = True
        """Whether the force sensor is being read; always true in the fast closed loop."""
        self._force_sensor = ForceSensor(config.force_sensor, config.seed) if config.force_sensor.on else None
        self._rotors: RotorCommands = (0.0,) * self.machine.rotor_count
        self._tick = 0
        self._imu_sample: ImuSample | None = None
        self.armed_t_s: float | None = None
        self.faults: Faults | None = None

    def _seed_noise(self) -> None:
        """Start one noise sequence per sensor. The sequences restart at arming, so that the noise in flight depends only on the seed,
        not on the time before arming or on the reading of other sensors.
        """
        seed = self._config.seed
        self._imu_noise, self._force_noise = noise(seed, _IMU), noise(seed, _FORCE)
        self.machine.restart_noise()

    def inject(self, faults: Faults) -> None:
        """Let the faults of this world act on what the machine does and measures."""
        self.faults = self.mocap.faults = faults

    @property
    def t_s(self) -> float:
        """World time."""
        return self.scene.t_s

    @property
    def truth(self) -> Truth:
        """True state after the last step."""
        return self.machine.truth()

    def mission_t_s(self) -> float | None:
        """Return the time since arming, or None before arming."""
        return None if self.armed_t_s is None else self.t_s - self.armed_t_s

    def fault(self, kind: FaultKind) -> Fault | None:
        """Return the active fault of this kind, or None."""
        return None if self.faults is None else self.faults.active.get(kind)

    def _load_on_net(self, push: Push | None, weight: HungWeight | None) -> Vec3:
        """Return the total force of the push and the hung weight on the centre of the net in N, world frame."""
        now, force = self.mission_t_s(), (0.0, 0.0, 0.0)
        if push is not None and now is not None and push.t_s <= now < push.t_s + push.duration_s:
            force = push.force_world_n
        if weight is None:
            return force
        x, y, z = force
        return (x, y, z - weight.pull_n(self.scene.t_s, self.force_is_read))

    def step(self, armed: bool) -> None:
        """Advance by one physics step."""
        self.act(armed)
        self.scene.step(armed)
        self.mocap.sense()

    def act(self, armed: bool) -> None:
        """Set what acts on the machine in the next step of the scene."""
        machine, config = self.machine, self._config
        t_s = self.scene.t_s
        if armed and self.armed_t_s is None:
            self.armed_t_s = t_s
            self._seed_noise()
            if self._imu_errors is not None:
                self._imu_errors.drift(noise(config.seed, _IMU_DRIFT))
            self.mocap.restart(t_s)
            self._barometer.restart()
            if machine.battery is not None:
                machine.battery.restart()
        if self.faults is not None:
            self.faults.step(t_s, self.armed_t_s)
        q, v = machine.q, machine.v
        torques_nm, pushing = [], 0
        for drive, sign, zero_rad, k_nm_a, gear, at_q, at_v in self._servos:
            angle_rad, rate_rad_s = q[at_q], v[at_v]
            if gear is not None:
                angle_rad, rate_rad_s = gear.encoder(angle_rad, rate_rad_s)
            torque_nm = sign * drive.update(t_s, zero_rad + sign * angle_rad, sign * rate_rad_s) * k_nm_a
            pushing += torque_nm != 0.0
            torques_nm.append(torque_nm if gear is None else gear.step(torque_nm))
        if machine.parked and (pushing == len(torques_nm) or (armed and pushing)):
            machine.release_arm()
        if self._tick % IMU_EVERY == 0:
            self._rotors = self._px4.step(self._imu_sample or self._imu())
            self._imu_sample = None
        self._tick += 1
        if config.push is not None or self._weight is not None:
            machine.push(self._load_on_net(config.push, self._weight))
        if self._handling is not None:
            machine.hold(None if armed else self._handling.wrench(t_s, q, v))
        if self.jaws is not None:
            bar = self.scene.bar
            self.jaws.step(t_s, bar is not None and bar.is_near(self.number))
            if bar is not None:
                bar.closed[self.number] = self.jaws.closed
        machine.command(self._rotors, tuple(torques_nm))

    @property
    def imu_due(self) -> bool:
        """Whether the next step begins with an IMU sample."""
        return self._tick % IMU_EVERY == 0

    def sample_imu(self) -> ImuSample:
        """Return the IMU sample of the next step ahead of that step, for an autopilot that needs time to answer."""
        if self._imu_sample is None:
            self._imu_sample = self._imu()
        return self._imu_sample

    def _imu(self) -> ImuSample:
        machine, config = self.machine, self._config
        s, a, g = machine.sensors(), machine.layout.accel, machine.layout.gyro
        gyro, accel = config.gyro_noise_rad_s, config.accel_noise_m_s2
        nx, ny, nz = next(self._imu_noise)
        mx, my, mz = next(self._imu_noise)
        rates = (s[g] + gyro * nx, s[g + 1] + gyro * ny, s[g + 2] + gyro * nz)
        force = (s[a] + accel * mx, s[a + 1] + accel * my, s[a + 2] + accel * mz)
        if self._imu_errors is not None:
            rates, force = self._imu_errors.measure(machine.thrust_n, rates, force)
        p, q, r = rates
        ax, ay, az = force
        baro_m = self._barometer.measure(machine.q[2], sum(machine.thrust_n)) if self._tick % BARO_EVERY == 0 else None
        return ImuSample(self.scene.t_s, (p, -q, -r), (ax, -ay, -az), baro_m)

    def battery(self) -> Battery:
        """Return the power module's measurement; without the battery effect, the charge falls linearly since arming."""
        pack, sag_v = self.machine.battery, 0.0 if self.faults is None else self.faults.sag_v
        if pack is not None:
            return Battery(pack.voltage_v - sag_v, pack.current_a, pack.remaining, pack.drawn_as / 3.6)
        flown_s = 0.0 if self.armed_t_s is None else self.scene.t_s - self.armed_t_s
        remaining = max(0.0, self._config.battery_start - flown_s / self._config.battery_life_s)
        return Battery(voltage_v=battery_voltage_v(remaining, self.machine.battery_cells) - sag_v, remaining=remaining)

    def force_torque(self) -> tuple[Vec3, Vec3]:
        """Return a reading of the force-torque sensor in N and N m, in the sensor frame, with noise, bias, faults and scale error."""
        machine = self.machine
        s, f, tq = machine.sensors(), machine.layout.force, machine.layout.torque
        fx, fy, fz = (-s[f], -s[f + 1], -s[f + 2])
        tx, ty, tz = (-s[tq], -s[tq + 1], -s[tq + 2])
        if self._force_sensor is not None:
            (fx, fy, fz), (tx, ty, tz) = self._force_sensor.measure(self.scene.t_s, (fx, fy, fz), (tx, ty, tz))
        bx, by, bz = self._config.force_bias_n
        noise_n = self._config.force_noise_n
        noise_nm = noise_n * 0.02
        nx, ny, nz = next(self._force_noise)
        mx, my, mz = next(self._force_noise)
        wrench = (
            (fx + bx + noise_n * nx, fy + by + noise_n * ny, fz + bz + noise_n * nz),
            (tx + noise_nm * mx, ty + noise_nm * my, tz + noise_nm * mz),
        )
        if self.faults is not None:
            wrench = self.faults.wrench(*wrench)
        scale = self._config.force_scale
        if scale != 1.0:
            wrench = (scaled(wrench[0], scale), scaled(wrench[1], scale))
        return wrench if self._force_sensor is None else self._force_sensor.rounded(wrench[0], wrench[1])
