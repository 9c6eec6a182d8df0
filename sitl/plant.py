"""The machine as its devices see it: the world behind noisy sensors, motors and an autopilot, without any wire.

`Plant.step` advances everything by one physics step. The server puts real wires around it; the fast closed loop uses it as it is.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from companion.config.vehicle import Vehicle
from companion.config.world import Fault
from companion.config.world import World as WorldConfig
from companion.frames import frd_from_flu, quat_from_euler_zyx, quat_multiply
from companion.types import Quat, Vec2, Vec3, Vec4
from sitl.autopilot.autopilot import Battery
from sitl.autopilot.types import ImuSample
from sitl.world import Truth, World

IMU_EVERY = 2
"""Physics steps per IMU sample: 250 Hz, as PX4's rate loop is stepped."""
BATTERY_FULL_V, BATTERY_EMPTY_V, BATTERY_LIFE_S = 16.6, 14.0, 900.0
_COUNTS_PER_RAD = 4096.0 / (2.0 * math.pi)


class Px4(Protocol):
    """The autopilot, stepped by its IMU."""

    def step(self, imu: ImuSample) -> Vec4:
        """One IMU sample in, rotor commands out."""


class JointDrive(Protocol):
    """One servo's motor, in the servo's own angle convention."""

    def update(self, t_s: float, shaft_angle_rad: float, shaft_velocity_rad_s: float) -> float:
        """Latch what the servo measures; the current (A) that the motor gives now."""


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """One motion-capture frame, delivered `mocap_latency_s` after its exposure."""

    number: int
    exposure_t_s: float
    position_world_m: Vec3
    attitude_wxyz: Quat
    valid: bool


class Noise:
    """Standard normal numbers in blocks: a call for three costs well under a microsecond."""

    def __init__(self, seed: int, block: int = 4096) -> None:
        self._rng = np.random.default_rng(seed)
        self._block = block
        self._values: list[float] = []

    def take3(self, scale: float) -> Vec3:
        """Three independent samples."""
        if len(self._values) < 3:
            self._values = self._rng.standard_normal(self._block).tolist()
        v = self._values
        return (scale * v.pop(), scale * v.pop(), scale * v.pop())


class Plant:
    """World, sensors and motors."""

    def __init__(
        self,
        vehicle: Vehicle,
        config: WorldConfig,
        px4: Px4,
        drives: Sequence[JointDrive],
        start: tuple[Vec2, float, Vec2],
    ) -> None:
        position_m, yaw_rad, arm_rad = start
        self._vehicle = vehicle
        self._config = config
        self._px4 = px4
        self._drives = drives
        self.world = World(vehicle, config, position_m, yaw_rad, arm_rad)
        self._truth: Truth | None = None
        self._noise = Noise(config.seed)
        self._rotors: Vec4 = (0.0, 0.0, 0.0, 0.0)
        self._tick = 0
        self._mocap_queue: deque[tuple[float, MocapFrame]] = deque()
        self._mocap_next_s = 0.0
        self._mocap_number = 0
        self._servo_start = [self._servo_angle(i, angle) for i, angle in enumerate(arm_rad)]
        self.armed_t_s: float | None = None

    def _servo_angle(self, index: int, angle_rad: float) -> float:
        joint = self._vehicle.arm.joints[index]
        return joint.zero_count / _COUNTS_PER_RAD + joint.sign * angle_rad

    @property
    def t_s(self) -> float:
        """World time."""
        return self.world.t_s

    @property
    def truth(self) -> Truth:
        """The world's state after the last step; read out only when somebody looks."""
        if self._truth is None:
            self._truth = self.world.truth()
        return self._truth

    def mission_t_s(self) -> float | None:
        """Seconds since the rotors were armed."""
        return None if self.armed_t_s is None else self.t_s - self.armed_t_s

    def fault(self, kind: str) -> Fault | None:
        """The fault of that kind that is active now."""
        now = self.mission_t_s()
        if now is None:
            return None
        for fault in self._config.faults:
            if fault.kind == kind and fault.t_s <= now:
                if fault.duration_s is None or now < fault.t_s + fault.duration_s:
                    return fault
        return None

    def _push(self) -> Vec3:
        push, now = self._config.push, self.mission_t_s()
        active = push is not None and now is not None and push.t_s <= now < push.t_s + push.duration_s
        return push.force_world_n if push is not None and active else (0.0, 0.0, 0.0)

    def step(self, armed: bool) -> None:
        """Advance by one physics step."""
        if armed and self.armed_t_s is None:
            self.armed_t_s = self.t_s
        t_s = self.t_s
        angle, velocity = self.world.joints()
        torque = []
        for i, drive in enumerate(self._drives):
            joint = self._vehicle.arm.joints[i]
            current = drive.update(t_s, self._servo_angle(i, angle[i]), joint.sign * velocity[i])
            torque.append(joint.sign * current * self._vehicle.arm.torque_per_amp_nm_a)
        if self._tick % IMU_EVERY == 0:
            self._rotors = self._px4.step(self._imu(self.truth))
        self._tick += 1
        self.world.push_world_n = self._push()
        self.world.step(self._rotors, (torque[0], torque[1]), armed)
        self._truth = None
        self._expose_mocap()

    def _imu(self, truth: Truth) -> ImuSample:
        gyro = self._noise.take3(self._config.gyro_noise_rad_s)
        accel = self._noise.take3(self._config.accel_noise_m_s2)
        g, a = truth.angular_rate_body_rad_s, truth.specific_force_body_m_s2
        return ImuSample(
            t_s=truth.t_s,
            gyro_frd_rad_s=frd_from_flu((g[0] + gyro[0], g[1] + gyro[1], g[2] + gyro[2])),
            accel_frd_m_s2=frd_from_flu((a[0] + accel[0], a[1] + accel[1], a[2] + accel[2])),
        )

    def _expose_mocap(self) -> None:
        if self.t_s < self._mocap_next_s - 1e-9:
            return
        self._mocap_next_s += 1.0 / self._config.mocap_rate_hz
        self._mocap_number += 1
        p = self.truth.position_world_m
        n = self._noise.take3(self._config.mocap_noise_m)
        roll, pitch, yaw = self._noise.take3(math.radians(self._config.mocap_noise_deg))
        frame = MocapFrame(
            number=self._mocap_number,
            exposure_t_s=self.t_s,
            position_world_m=(p[0] + n[0], p[1] + n[1], p[2] + n[2]),
            attitude_wxyz=quat_multiply(self.truth.attitude_wxyz, quat_from_euler_zyx(roll, pitch, yaw)),
            valid=True,
        )
        self._mocap_queue.append((self.t_s + self._config.mocap_latency_s, frame))

    def take_mocap(self) -> list[MocapFrame]:
        """Frames that leave the motion-capture machine now."""
        frames = []
        while self._mocap_queue and self._mocap_queue[0][0] <= self.t_s + 1e-9:
            frames.append(self._mocap_queue.popleft()[1])
        return [] if self.fault("mocap_loss") else frames

    def battery(self) -> Battery:
        """What the power module measures: emptied by time in the air."""
        flown_s = self.mission_t_s() or 0.0
        remaining = max(0.0, self._config.battery_start - flown_s / BATTERY_LIFE_S)
        voltage = BATTERY_EMPTY_V + (BATTERY_FULL_V - BATTERY_EMPTY_V) * remaining
        return Battery(voltage_v=voltage, remaining=remaining)

    def force_torque(self) -> tuple[Vec3, Vec3]:
        """What the force-torque sensor reads: noise and bias on, sensor frame."""
        f, tq, b = self.truth.force_sensor_n, self.truth.torque_sensor_nm, self._config.force_bias_n
        n = self._noise.take3(self._config.force_noise_n)
        m = self._noise.take3(self._config.force_noise_n * 0.02)
        return (
            (f[0] + b[0] + n[0], f[1] + b[1] + n[1], f[2] + b[2] + n[2]),
            (tq[0] + m[0], tq[1] + m[1], tq[2] + m[2]),
        )
