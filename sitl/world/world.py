"""One MuJoCo world: quadrotor, 2R arm, net, tether, floor and a thrown payload. Truth only; sensors add noise elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from companion.config.vehicle import Vehicle
from companion.model.types import Quat, Vec2, Vec3, Vec4
from companion.sitl_config.world import World as WorldConfig
from sitl.world.handling import Wrench
from sitl.world.model import mjcf

PHYSICS_DT_S = 0.002
DRAG_N_PER_M_S = 0.25
SNAG_STIFFNESS_N_M, SNAG_DAMPING_NS_M = 400.0, 30.0
"""Of a tether that is caught."""
_THROW_LEAD_S = 0.45
_THROW_BESIDE_M = 0.5
"""The vehicle passes `catch_at_m` at most this far to the left or right of it, else nothing is thrown."""


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


class Snapshot(NamedTuple):
    """MuJoCo's own numbers after one step: qpos, qvel, sensordata. `Layout.truth` tells what they mean."""

    t_s: float
    q: list[float]
    v: list[float]
    sensors: list[float]


@dataclass(frozen=True, slots=True)
class Layout:
    """Where things are in a `Snapshot`; the base is first in q and v, the sensors are three numbers each."""

    joint_q: tuple[int, int]
    joint_v: tuple[int, int]
    accel: int
    gyro: int
    force: int
    torque: int
    tether: int

    def truth(self, snapshot: Snapshot) -> Truth:
        """The snapshot as a record."""
        t_s, q, v, s = snapshot
        (q1, q2), (v1, v2) = self.joint_q, self.joint_v
        a, g, f, tq = self.accel, self.gyro, self.force, self.torque
        return Truth(
            t_s=t_s,
            position_world_m=(q[0], q[1], q[2]),
            velocity_world_m_s=(v[0], v[1], v[2]),
            attitude_wxyz=(q[3], q[4], q[5], q[6]),
            angular_rate_body_rad_s=(s[g], s[g + 1], s[g + 2]),
            specific_force_body_m_s2=(s[a], s[a + 1], s[a + 2]),
            joint_angle_rad=(q[q1], q[q2]),
            joint_velocity_rad_s=(v[v1], v[v2]),
            force_sensor_n=(-s[f], -s[f + 1], -s[f + 2]),
            torque_sensor_nm=(-s[tq], -s[tq + 1], -s[tq + 2]),
            tether_tension_n=s[self.tether],
        )


@dataclass(frozen=True, slots=True)
class WorldEvent:
    """Something that happened in the world."""

    t_s: float
    kind: str
    """thrown, caught, taken (out of the net), missed, crashed."""


class Ball(NamedTuple):
    """Something that is thrown: body, places in qpos and qvel, and the constraint that holds it in the net."""

    body: int
    q: int
    v: int
    catch: int

    @classmethod
    def of(cls, model: mujoco.MjModel, name: str, catch: str) -> Ball:
        """By its names in the model."""
        joint = model.joint(name).id
        return cls(
            model.body(name).id, int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), model.equality(catch).id
        )


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
        joints = (m.joint("alpha1").id, m.joint("alpha2").id)
        self.layout = Layout(
            (int(m.jnt_qposadr[joints[0]]), int(m.jnt_qposadr[joints[1]])),
            (int(m.jnt_dofadr[joints[0]]), int(m.jnt_dofadr[joints[1]])),
            *(int(m.sensor(name).adr[0]) for name in ("accel", "gyro", "force", "torque", "tether")),
        )
        self._base = m.body("base").id
        self._net = m.body("net").id
        self._has_payload = config.payload_kg > 0
        if self._has_payload:
            self._payload = Ball.of(m, "payload", "catch")
        self._park = [m.equality(name).id for name in ("park1", "park2")]
        self._parked = True
        self._gain = 1.0 - math.exp(-PHYSICS_DT_S / config.rotor_lag_s)
        self._rotor_max_n = vehicle.airframe.thrust_max_n / 4.0
        self._crash_m = 0.6 * vehicle.airframe.ground_clearance_m
        self.wind_m_s = config.wind_m_s
        self.rotor_share: Vec4 | None = None
        """Of each rotor's thrust that is really there; None: all of it."""
        self.snag: tuple[Vec3, float] | None = None
        """Where the tether is caught, and how much of it is left from there."""
        self.throw_aside_m = 0.0
        """The throw goes so far beside the net."""
        self._held: Wrench | None = None
        self._tether = m.tendon("tether").id
        self._attachment = m.site("tether").id
        self._thrust: Vec4 = (0.0, 0.0, 0.0, 0.0)
        self.thrown_t_s: float | None = None
        self.caught_t_s: float | None = None
        self.missed = False
        """The first throw."""
        self.throws = self.catches = 0
        """Throws so far, and how many of them were caught."""
        self._flies_since_s: float | None = None
        """The throw that has not ended in the net yet; one that missed it still may."""
        self._kept_since_s: float | None = None
        """The catch that has not been taken out of the net yet."""
        self._missed = False
        """What flies since then has missed the net."""
        self.crashed = False
        self._events: list[WorldEvent] = []
        self._last_x = start_position_m[0]
        d = self.data
        # Views: to ask MuJoCo for its arrays anew in every step costs more than to read them.
        self._ctrl, self._qpos, self._qvel, self._sensordata = d.ctrl, d.qpos, d.qvel, d.sensordata
        self._drag_force, self._push_force = d.xfrc_applied[self._base, 0:3], d.xfrc_applied[self._net, 0:3]
        self._hold_torque = d.xfrc_applied[self._base, 3:6]
        self.t_s = 0.0
        """World time."""
        self.q: list[float] = []
        self.v: list[float] = []
        """qpos and qvel after the last step; see `layout`."""
        self._sensors: list[float] | None = None
        """Read when asked for."""
        self._place(start_position_m, start_yaw_rad, arm_rad)

    def _place(self, position_m: Vec2, yaw_rad: float, arm_rad: Vec2) -> None:
        q = self.data.qpos
        q[0:3] = (*position_m, self._vehicle.airframe.ground_clearance_m)
        q[3:7] = (math.cos(yaw_rad / 2), 0, 0, math.sin(yaw_rad / 2))
        q[list(self.layout.joint_q)] = arm_rad
        for park, angle in zip(self._park, arm_rad, strict=True):
            self.model.eq_data[park, 0] = angle
        mujoco.mj_forward(self.model, self.data)
        self.q, self.v = self._qpos.tolist(), self._qvel.tolist()

    def sensors(self) -> list[float]:
        """sensordata after the last step; see `layout`."""
        if self._sensors is None:
            self._sensors = self._sensordata.tolist()
        return self._sensors

    def push(self, force_world_n: Vec3) -> None:
        """Force on the net's centre from now on."""
        self._push_force[:] = force_world_n

    def hold(self, wrench: Wrench | None) -> None:
        """A hand on the base from now on; None: it lets go."""
        self._held = wrench
        self._hold_torque[:] = (0.0, 0.0, 0.0) if wrench is None else wrench.torque_nm

    @property
    def weight_n(self) -> float:
        """Of the machine without payload."""
        return 9.81 * float(self.model.body_subtreemass[self._base])

    @property
    def hover_command(self) -> float:
        """True normalised thrust that holds the machine without payload."""
        return self.weight_n / self._vehicle.airframe.thrust_max_n

    def step(self, rotor_commands: Vec4, joint_torque_nm: Vec2, airborne: bool = True, *, drag: bool = True) -> None:
        """Advance by one physics step; `airborne`: the throw may happen."""
        k, most = self._gain, self._rotor_max_n
        a, b, c, d = self._thrust
        to_a, to_b, to_c, to_d = rotor_commands
        self._thrust = thrust = (
            a + k * (to_a * most - a),
            b + k * (to_b * most - b),
            c + k * (to_c * most - c),
            d + k * (to_d * most - d),
        )
        if self.rotor_share is not None:
            a, b, c, d = (force * share for force, share in zip(thrust, self.rotor_share, strict=True))
            thrust = (a, b, c, d)
        self._ctrl[:] = thrust + joint_torque_nm
        if self._parked and all(joint_torque_nm):
            self.release_arm()
        if drag:
            (wx, wy, wz), v = self.wind_m_s, self.v
            self._drag_force[:] = (
                DRAG_N_PER_M_S * (wx - v[0]),
                DRAG_N_PER_M_S * (wy - v[1]),
                DRAG_N_PER_M_S * (wz - v[2]),
            )
        if self.snag is not None:
            self._drag_force += self._snag_pull_n(*self.snag)
        if self._held is not None:
            self._drag_force += self._held.force_n
        mujoco.mj_step(self.model, self.data)
        self.t_s = self.data.time
        self.q, self.v = self._qpos.tolist(), self._qvel.tolist()
        self._sensors = None
        if self._has_payload and not (self._kept_since_s is not None and self.throws == self._config.throws):
            self._throw_and_catch(airborne)
        self._watch_crash()

    def release_arm(self) -> None:
        """The arm leaves the stand that carries it before its servos do: at the first torque of both joints."""
        self._parked = False
        self.data.eq_active[self._park] = 0

    def hold_arm(self, angle_rad: Vec2) -> None:
        """A hand holds both joints from now on, where the stand did, until `release_arm`."""
        self._parked = True
        self.data.eq_active[self._park] = 1
        for park, angle in zip(self._park, angle_rad, strict=True):
            self.model.eq_data[park, 0] = angle

    def _throw_and_catch(self, airborne: bool) -> None:
        if self._kept_since_s is not None:
            if self.t_s - self._kept_since_s >= self._config.keep_s:
                self._take_out()
            return
        if self._flies_since_s is None:
            vx = self.v[0]
            ahead = self.q[0] + vx * _THROW_LEAD_S
            at_x, at_y = self._config.catch_at_m
            if airborne and vx > 0.05 and self._last_x < at_x <= ahead and abs(self.q[1] - at_y) <= _THROW_BESIDE_M:
                self._throw()
            self._last_x = ahead
            return
        if self.catch(self._payload):
            self.catches += 1
            if self.throws == 1:
                self.caught_t_s = self.t_s
            self._flies_since_s, self._kept_since_s = None, self.t_s
            self._events.append(WorldEvent(self.t_s, "caught"))
        elif not self._missed and self.t_s - self._flies_since_s > 2 * _THROW_LEAD_S:
            self._missed = True
            self.missed = self.missed or self.throws == 1
            self._events.append(WorldEvent(self.t_s, "missed"))
            if self.throws < self._config.throws:
                self._flies_since_s = None
                self._await_pass()

    def _throw(self) -> None:
        """Launch the payload so that it meets the net where the vehicle will be, at the velocity asked."""
        if self.throws == 0:
            self.thrown_t_s = self.t_s
        self.throws += 1
        self._flies_since_s, self._missed = self.t_s, False
        self.throw(self._payload, self.throw_aside_m)
        self._events.append(WorldEvent(self.t_s, "thrown"))

    def _take_out(self) -> None:
        """Somebody takes the payload out of the net, to throw it again."""
        ball, d = self._payload, self.data
        self._kept_since_s = None
        d.eq_active[ball.catch] = 0
        d.qpos[ball.q : ball.q + 7] = self.model.qpos0[ball.q : ball.q + 7]
        d.qvel[ball.v : ball.v + 6] = 0.0
        self._await_pass()
        self._events.append(WorldEvent(self.t_s, "taken"))

    def _await_pass(self) -> None:
        """The next throw is on a pass that is still to come."""
        self._last_x = self.q[0] + self.v[0] * _THROW_LEAD_S

    def throw(self, ball: Ball, aside_m: float = 0.0) -> None:
        """The same with any ball, `aside_m` to the left (world y) of the net."""
        d = self.data
        target = d.xpos[self._net] + d.qvel[0:3] * _THROW_LEAD_S + np.array([0.0, aside_m, 0.0])
        arrival = np.array(self._config.throw_velocity_m_s)
        gravity = np.array([0.0, 0.0, -9.81])
        velocity = arrival - gravity * _THROW_LEAD_S
        q, v = ball.q, ball.v
        d.qpos[q : q + 3] = target - velocity * _THROW_LEAD_S - 0.5 * gravity * _THROW_LEAD_S**2
        d.qpos[q + 3 : q + 7] = (1, 0, 0, 0)
        d.qvel[v : v + 3] = velocity
        d.qvel[v + 3 : v + 6] = 0.0

    def catch(self, ball: Ball) -> bool:
        """Whether the ball is in the net, where it stays from then on."""
        d = self.data
        gap = d.xpos[ball.body] - d.xpos[self._net]
        if float(gap @ gap) > self._vehicle.tool.net_radius_m**2:
            return False
        rotation = d.xmat[self._net].reshape(3, 3)
        self.model.eq_data[ball.catch, 0:3] = rotation.T @ gap
        self.model.eq_data[ball.catch, 3:6] = 0.0
        d.eq_active[ball.catch] = 1
        return True

    def drop(self) -> None:
        """The payload falls out of the net, if it is in there."""
        if self._kept_since_s is not None:
            self.data.eq_active[self._payload.catch] = 0

    @property
    def attachment_world_m(self) -> Vec3:
        """Where the tether is tied to the vehicle."""
        x, y, z = self.data.site_xpos[self._attachment].tolist()
        return (x, y, z)

    @property
    def tether_length_m(self) -> float:
        """Of the tether as it is now."""
        return float(self.model.tendon_range[self._tether, 1])

    @tether_length_m.setter
    def tether_length_m(self, length_m: float) -> None:
        self.model.tendon_range[self._tether, 1] = length_m

    def _snag_pull_n(self, point_m: Vec3, length_m: float) -> Vec3:
        """A stiff line from the point to the vehicle."""
        x, y, z = (p - a for p, a in zip(point_m, self.attachment_world_m, strict=True))
        distance_m = math.sqrt(x * x + y * y + z * z)
        if distance_m <= length_m or distance_m == 0.0:
            return (0.0, 0.0, 0.0)
        x, y, z = x / distance_m, y / distance_m, z / distance_m
        vx, vy, vz = self.v[0:3]
        away_m_s = -(vx * x + vy * y + vz * z)
        pull_n = max(0.0, SNAG_STIFFNESS_N_M * (distance_m - length_m) + SNAG_DAMPING_NS_M * away_m_s)
        return (pull_n * x, pull_n * y, pull_n * z)

    def _watch_crash(self) -> None:
        """Rotors or hull in the floor: far below standing height or upside down."""
        if self.crashed:
            return
        q = self.q
        z, x, y = q[2], q[4], q[5]
        up = 1.0 - 2.0 * (x * x + y * y)
        if z < self._crash_m or up < 0.3 or not math.isfinite(z):
            self.crashed = True
            self._events.append(WorldEvent(self.t_s, "crashed"))

    def take_events(self) -> list[WorldEvent]:
        """Events since the last call."""
        events, self._events = self._events, []
        return events

    def snapshot(self) -> Snapshot:
        """The state after the last step, as it is; nobody changes the lists afterwards."""
        return Snapshot(self.t_s, self.q, self.v, self.sensors())

    def truth(self) -> Truth:
        """The state after the last step."""
        return self.layout.truth(self.snapshot())
