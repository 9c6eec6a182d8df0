"""A small rigid-body quadrotor around the PX4 stub: thrust and torques, floor, vision. Independent of the SITL world."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Mapping

from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import euler_zyx_from_quat, quat_conjugate, quat_multiply, quat_normalize, quat_rotate
from companion.model.types import Quat, Vec3
from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.cascade import Cascade, gains_from_params
from sitl.autopilot.commander import Command, Result
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.mavlink import MavlinkServer
from sitl.autopilot.params import Params, Value
from sitl.autopilot.types import ImuSample, RotorCommands

PERIOD_S = 0.004
VISION_PERIOD_S = 0.012
MIXER = Cascade().mixer


class Plant:
    """3 kg, hovers at half thrust, lands on a flat floor at z = 0. Local NED, body FRD."""

    mass_kg = 3.0
    inertia_kg_m2 = (0.03, 0.03, 0.05)
    rotor_max_n = 3.0 * GRAVITY_M_S2 / 2.0
    lever_m = 0.16
    yaw_m = 0.02
    rotor_lag_s = 0.04

    def __init__(self) -> None:
        self.position_ned_m: Vec3 = (0.0, 0.0, 0.0)
        self.velocity_ned_m_s: Vec3 = (0.0, 0.0, 0.0)
        self.attitude: Quat = (1.0, 0.0, 0.0, 0.0)
        self.rates: Vec3 = (0.0, 0.0, 0.0)
        self._rotor_n = [0.0, 0.0, 0.0, 0.0]

    def step(self, t_s: float, dt_s: float, commands: RotorCommands) -> ImuSample:
        blend = 1.0 - math.exp(-dt_s / self.rotor_lag_s)
        for i, command in enumerate(commands):
            self._rotor_n[i] += blend * (command * self.rotor_max_n - self._rotor_n[i])
        force_z = -sum(self._rotor_n)
        torque = (
            self.lever_m * sum(k * f for k, f in zip(MIXER.roll, self._rotor_n, strict=True)),
            self.lever_m * sum(k * f for k, f in zip(MIXER.pitch, self._rotor_n, strict=True)),
            self.yaw_m * sum(k * f for k, f in zip(MIXER.yaw, self._rotor_n, strict=True)),
        )
        push = quat_rotate(self.attitude, (0.0, 0.0, force_z / self.mass_kg))
        drag = 0.1
        v = self.velocity_ned_m_s
        accel = [push[i] - drag * v[i] + (GRAVITY_M_S2 if i == 2 else 0.0) for i in range(3)]
        grounded = self.position_ned_m[2] >= 0.0 and v[2] + accel[2] * dt_s >= 0.0
        if grounded:
            _, _, yaw = euler_zyx_from_quat(self.attitude)
            self.attitude = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
            self.rates = self.velocity_ned_m_s = (0.0, 0.0, 0.0)
            self.position_ned_m = (self.position_ned_m[0], self.position_ned_m[1], 0.0)
            # The blow of the touchdown is in the accelerometer, as on any floor.
            felt = (-v[0] / dt_s, -v[1] / dt_s, -v[2] / dt_s - GRAVITY_M_S2)
            return ImuSample(t_s, self.rates, quat_rotate(quat_conjugate(self.attitude), felt))
        x, y, z = (v[i] + accel[i] * dt_s for i in range(3))
        self.velocity_ned_m_s = (x, y, z)
        p = self.position_ned_m
        self.position_ned_m = (p[0] + x * dt_s, p[1] + y * dt_s, min(0.0, p[2] + z * dt_s))
        ix, iy, iz = self.inertia_kg_m2
        a, b, c = self.rates
        self.rates = (
            a + dt_s * (torque[0] - (iz - iy) * b * c) / ix,
            b + dt_s * (torque[1] - (ix - iz) * c * a) / iy,
            c + dt_s * (torque[2] - (iy - ix) * a * b) / iz,
        )
        half = [rate * dt_s / 2 for rate in self.rates]
        self.attitude = quat_normalize(quat_multiply(self.attitude, (1.0, half[0], half[1], half[2])))
        specific = (accel[0], accel[1], accel[2] - GRAVITY_M_S2)
        return ImuSample(t_s, self.rates, quat_rotate(quat_conjugate(self.attitude), specific))


class Rig:
    """Stub and plant on one world clock."""

    def __init__(self, overrides: Mapping[str, Value] | None = None, *, setpoint_delay_s: float = 0.0) -> None:
        self.params = Params(overrides)
        cascade = Cascade(gains_from_params(self.params))
        self.stub = Px4Stub(self.params, Estimator(), cascade, setpoint_delay_s=setpoint_delay_s)
        self.plant = Plant()
        self.t_s = 0.0
        self.vision = True
        self.baro_error_m = 0.0
        self._samples = 0
        self._vision_at_s = 0.0

    @property
    def height_m(self) -> float:
        return -self.plant.position_ned_m[2]

    def step(self) -> None:
        self.t_s += PERIOD_S
        sample = self.plant.step(self.t_s, PERIOD_S, self.stub.rotors)
        self._samples += 1
        baro_m = self.height_m + self.baro_error_m if self._samples % 5 == 0 else None
        self.stub.step(sample._replace(baro_m=baro_m))
        if self.vision and self.t_s >= self._vision_at_s:
            self._vision_at_s = self.t_s + VISION_PERIOD_S
            self.stub.on_vision(self.t_s, self.plant.position_ned_m, self.plant.attitude)

    def run(self, duration_s: float) -> None:
        until_s = self.t_s + duration_s
        while self.t_s < until_s:
            self.step()

    def command(self, command: int, *params: float) -> Result:
        p = (*params, *(0.0,) * (7 - len(params)))
        return self.stub.on_command(self.t_s, command, (p[0], p[1], p[2], p[3], p[4], p[5], p[6]))

    def arm(self) -> Result:
        return self.command(Command.COMPONENT_ARM_DISARM, 1.0)

    def mode(self, main: int, sub: int = 0) -> Result:
        return self.command(Command.DO_SET_MODE, 1.0, float(main), float(sub))

    def texts(self) -> list[str]:
        texts = [notice.text for notice in self.stub.notices]
        self.stub.notices.clear()
        return texts

    async def fly(self, server: MavlinkServer, stop: asyncio.Event) -> None:
        """Let world time follow wall time until `stop`; a late loop catches up step by step."""
        origin_s = time.monotonic() - self.t_s
        while not stop.is_set():
            steps = 0
            while self.t_s < time.monotonic() - origin_s and steps < 25:
                self.step()
                steps += 1
            if steps == 25:
                origin_s = time.monotonic() - self.t_s  # too loaded for real time: let the world run slower
            server.pump(self.t_s)
            await asyncio.sleep(PERIOD_S / 2)
