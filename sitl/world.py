"""One MuJoCo world: quadrotor, 2R arm, net, tether, floor and a thrown payload. Truth only; sensors add noise elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.config.world import World as WorldConfig
from companion.types import Quat, Vec2, Vec3, Vec4
from sitl.model import mjcf

PHYSICS_DT_S = 0.002
DRAG_N_PER_M_S = 0.25
_THROW_LEAD_S = 0.45


@dataclass(frozen=True, slots=True)
class Truth:
    """The world's true state; world ENU, body FLU."""

    t_s: float
    position_world_m: Vec3
    velocity_world_m_s: Vec3
    attitude_wxyz: Quat
    angular_rate_body_rad_s: Vec3
    specific_force_body_m_s2: Vec3
    joint_angle_rad: Vec2
    joint_velocity_rad_s: Vec2
    force_sensor_n: Vec3
    """Force of the surroundings on the tool side of the sensor, net's weight and inertia included, sensor frame."""
    torque_sensor_nm: Vec3
    tether_tension_n: float


@dataclass(frozen=True, slots=True)
class WorldEvent:
    """Something that happened in the world."""

    t_s: float
    kind: str
    """thrown, caught, missed, crashed."""


class World:
    """The physics. `step` advances by `PHYSICS_DT_S`."""

    def __init__(
        self, vehicle: Vehicle, config: WorldConfig, start_position_m: Vec2, start_yaw_rad: float, arm_rad: Vec2
    ):
        self._vehicle = vehicle
        self._config = config
        self.model = mujoco.MjModel.from_xml_string(mjcf(vehicle, config, PHYSICS_DT_S))
        self.data = mujoco.MjData(self.model)
        m = self.model
        self._joint_q = [int(m.jnt_qposadr[m.joint(name).id]) for name in ("alpha1", "alpha2")]
        self._joint_v = [int(m.jnt_dofadr[m.joint(name).id]) for name in ("alpha1", "alpha2")]
        self._base = m.body("base").id
        self._net = m.body("net").id
        self._has_payload = config.payload_kg > 0
        if self._has_payload:
            self._payload = m.body("payload").id
            self._payload_q = m.jnt_qposadr[m.joint("payload").id]
            self._payload_v = m.jnt_dofadr[m.joint("payload").id]
            self._catch = m.equality("catch").id
        self._park = [m.equality(name).id for name in ("park1", "park2")]
        self._parked = True
        self._sensor = {name: int(m.sensor(name).adr[0]) for name in ("accel", "gyro", "force", "torque", "tether")}
        self._lag = math.exp(-PHYSICS_DT_S / config.rotor_lag_s)
        self._rotor_max_n = vehicle.airframe.thrust_max_n / 4.0
        self._thrust = [0.0, 0.0, 0.0, 0.0]
        self.thrown_t_s: float | None = None
        self.caught_t_s: float | None = None
        self.missed = False
        self.push_world_n: Vec3 = (0.0, 0.0, 0.0)
        """Force on the net's centre from now on."""
        self.crashed = False
        self._events: list[WorldEvent] = []
        self._last_x = start_position_m[0]
        self._drag_force = self.data.xfrc_applied[self._base, 0:3]  # a view
        self._place(start_position_m, start_yaw_rad, arm_rad)

    def _place(self, position_m: Vec2, yaw_rad: float, arm_rad: Vec2) -> None:
        q = self.data.qpos
        q[0:3] = (*position_m, self._vehicle.airframe.ground_clearance_m)
        q[3:7] = (math.cos(yaw_rad / 2), 0, 0, math.sin(yaw_rad / 2))
        q[self._joint_q] = arm_rad
        for park, angle in zip(self._park, arm_rad, strict=True):
            self.model.eq_data[park, 0] = angle
        mujoco.mj_forward(self.model, self.data)

    @property
    def t_s(self) -> float:
        """World time."""
        return float(self.data.time)

    @property
    def hover_command(self) -> float:
        """True normalised thrust that holds the machine without payload."""
        weight = 9.81 * float(self.model.body_subtreemass[self._base])
        return weight / self._vehicle.airframe.thrust_max_n

    def step(self, rotor_commands: Vec4, joint_torque_nm: Vec2, airborne: bool = True, *, drag: bool = True) -> None:
        """Advance by one physics step; `airborne`: the throw may happen."""
        d = self.data
        k, most = 1.0 - self._lag, self._rotor_max_n
        self._thrust = [now + k * (c * most - now) for now, c in zip(self._thrust, rotor_commands, strict=True)]
        d.ctrl[:] = (*self._thrust, *joint_torque_nm)
        if self._parked and all(joint_torque_nm):
            self.release_arm()
        if drag:
            (wx, wy, wz), (vx, vy, vz) = self._config.wind_m_s, d.qvel[0:3].tolist()
            c = DRAG_N_PER_M_S
            self._drag_force[:] = (c * (wx - vx), c * (wy - vy), c * (wz - vz))
        d.xfrc_applied[self._net, 0:3] = self.push_world_n
        mujoco.mj_step(self.model, d)
        if self._has_payload and self.caught_t_s is None:
            self._throw_and_catch(airborne)
        self._watch_crash()

    def release_arm(self) -> None:
        """The arm leaves the stand that carries it before its servos do: at the first torque of both joints."""
        self._parked = False
        self.data.eq_active[self._park] = 0

    def _throw_and_catch(self, airborne: bool) -> None:
        d, config = self.data, self._config
        x, vx = float(d.qpos[0]), float(d.qvel[0])
        if self.thrown_t_s is None:
            ahead = x + vx * _THROW_LEAD_S
            if airborne and vx > 0.05 and self._last_x < config.catch_at_m[0] <= ahead:
                self._throw()
            self._last_x = ahead
            return
        gap = d.xpos[self._payload] - d.xpos[self._net]
        if float(gap @ gap) <= self._vehicle.tool.net_radius_m**2:
            rotation = d.xmat[self._net].reshape(3, 3)
            self.model.eq_data[self._catch, 0:3] = rotation.T @ gap
            self.model.eq_data[self._catch, 3:6] = 0.0
            d.eq_active[self._catch] = 1
            self.caught_t_s = self.t_s
            self._events.append(WorldEvent(self.t_s, "caught"))
        elif not self.missed and self.t_s - self.thrown_t_s > 2 * _THROW_LEAD_S:
            self.missed = True
            self._events.append(WorldEvent(self.t_s, "missed"))

    def _throw(self) -> None:
        """Launch the payload so that it meets the net where the vehicle will be, at the velocity asked."""
        d = self.data
        self.thrown_t_s = self.t_s
        target = d.xpos[self._net] + d.qvel[0:3] * _THROW_LEAD_S
        arrival = np.array(self._config.throw_velocity_m_s)
        gravity = np.array([0.0, 0.0, -9.81])
        velocity = arrival - gravity * _THROW_LEAD_S
        q, v = self._payload_q, self._payload_v
        d.qpos[q : q + 3] = target - velocity * _THROW_LEAD_S - 0.5 * gravity * _THROW_LEAD_S**2
        d.qpos[q + 3 : q + 7] = (1, 0, 0, 0)
        d.qvel[v : v + 3] = velocity
        d.qvel[v + 3 : v + 6] = 0.0
        self._events.append(WorldEvent(self.t_s, "thrown"))

    def _watch_crash(self) -> None:
        """Rotors or hull in the floor: far below standing height or upside down."""
        if self.crashed:
            return
        z, _, x, y = self.data.qpos[2:6].tolist()
        up = 1.0 - 2.0 * (x * x + y * y)
        if z < 0.6 * self._vehicle.airframe.ground_clearance_m or up < 0.3 or not math.isfinite(z):
            self.crashed = True
            self._events.append(WorldEvent(self.t_s, "crashed"))

    def take_events(self) -> list[WorldEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def joints(self) -> tuple[Vec2, Vec2]:
        """Joint angles (rad) and velocities (rad/s) after the last step."""
        q, v, jq, jv = self.data.qpos, self.data.qvel, self._joint_q, self._joint_v
        return (float(q[jq[0]]), float(q[jq[1]])), (float(v[jv[0]]), float(v[jv[1]]))

    def truth(self) -> Truth:
        """The state after the last step."""
        d, s = self.data, self._sensor
        q, v, sensors = d.qpos.tolist(), d.qvel.tolist(), d.sensordata.tolist()
        a, g, f, tq = (sensors[s[name] : s[name] + 3] for name in ("accel", "gyro", "force", "torque"))
        jq, jv = self._joint_q, self._joint_v
        return Truth(
            t_s=self.t_s,
            position_world_m=(q[0], q[1], q[2]),
            velocity_world_m_s=(v[0], v[1], v[2]),
            attitude_wxyz=(q[3], q[4], q[5], q[6]),
            angular_rate_body_rad_s=(g[0], g[1], g[2]),
            specific_force_body_m_s2=(a[0], a[1], a[2]),
            joint_angle_rad=(q[jq[0]], q[jq[1]]),
            joint_velocity_rad_s=(v[jv[0]], v[jv[1]]),
            force_sensor_n=(-f[0], -f[1], -f[2]),
            torque_sensor_nm=(-tq[0], -tq[1], -tq[2]),
            tether_tension_n=sensors[s["tether"]],
        )
