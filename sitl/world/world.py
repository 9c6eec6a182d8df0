"""MuJoCo physics of the quadrotor, its arm and net, the tether, the floor and the thrown payload. `plant` adds the sensor noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import mujoco

from companion.config.vehicle import Vehicle
from companion.model.algebra import cross
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_rotate
from companion.model.types import Joints, Quat, Vec2, Vec3
from companion.sitl_config.effects.rotors import BODY_DRAG_N_PER_M_S
from companion.sitl_config.world import World as WorldConfig
from sitl.world.effects.air import Air
from sitl.world.effects.battery import BatteryPack
from sitl.world.effects.downwash import Downwash
from sitl.world.effects.rotors import LinearRotors, Rotors, Thrusts
from sitl.world.effects.tether_line import TetherLine
from sitl.world.effects.transmission import Transmission, added_inertia_kg_m2
from sitl.world.handling import Wrench
from sitl.world.loads import EFFECT_PERIOD_S, ZERO, Loads
from sitl.world.model import has_tip, mjcf
from sitl.world.payload import Payload
from sitl.world.surfaces import Surfaces
from sitl.world.views import Writer, vec3_of

PHYSICS_DT_S: Final = 0.002
FALL_M_S: Final = 2.5
"""Speed of impact on the floor at which the legs break: the speed after a fall from 0.3 m. PX4 descends at 0.7 m/s at most."""
_EFFECT_STEPS: Final = round(EFFECT_PERIOD_S / PHYSICS_DT_S)
SNAG_STIFFNESS_N_M, SNAG_DAMPING_NS_M = 400.0, 30.0


@dataclass(frozen=True, slots=True)
class Truth:
    """True state of the vehicle; the world frame is ENU, the body frame FLU."""

    t_s: float
    position_world_m: Vec3
    velocity_world_m_s: Vec3
    attitude_wxyz: Quat
    angular_rate_body_rad_s: Vec3
    specific_force_body_m_s2: Vec3
    joint_angle_rad: Joints
    joint_velocity_rad_s: Joints
    force_sensor_n: Vec3
    """Force on the tool side of the sensor, including the weight and inertia of the net, sensor frame."""
    torque_sensor_nm: Vec3
    tether_tension_n: float


class Snapshot(NamedTuple):
    """MuJoCo's qpos, qvel and sensordata after one step; `Layout.truth` decodes them."""

    t_s: float
    q: list[float]
    v: list[float]
    sensors: list[float]


@dataclass(frozen=True, slots=True)
class Layout:
    """Indices into a `Snapshot`. The base comes first in q and v; each sensor has three values, except the tether, which has one."""

    joint_q: tuple[int, ...]
    joint_v: tuple[int, ...]
    accel: int
    gyro: int
    force: int
    torque: int
    tether: int | None
    """Index of the tether's tension; None without a tether."""
    tip: int | None = None
    """Index of the contact force on the tip, which is followed by the tip's position and attitude; None in a world without surfaces
    for a vehicle with a net."""

    def truth(self, snapshot: Snapshot) -> Truth:
        """Return the true state that a snapshot contains."""
        t_s, q, v, s = snapshot
        a, g, f, tq = self.accel, self.gyro, self.force, self.torque
        return Truth(
            t_s=t_s,
            position_world_m=(q[0], q[1], q[2]),
            velocity_world_m_s=(v[0], v[1], v[2]),
            attitude_wxyz=(q[3], q[4], q[5], q[6]),
            angular_rate_body_rad_s=(s[g], s[g + 1], s[g + 2]),
            specific_force_body_m_s2=(s[a], s[a + 1], s[a + 2]),
            joint_angle_rad=tuple([q[index] for index in self.joint_q]),
            joint_velocity_rad_s=tuple([v[index] for index in self.joint_v]),
            force_sensor_n=(-s[f], -s[f + 1], -s[f + 2]),
            torque_sensor_nm=(-s[tq], -s[tq + 1], -s[tq + 2]),
            tether_tension_n=self.tension_n(s),
        )

    def contact(self, sensors: Sequence[float]) -> tuple[Vec3, Vec3]:
        """Return the tip's position (m) and the force of a surface on it (N), world frame; the world has surfaces."""
        assert self.tip is not None
        fx, fy, fz, x, y, z, qw, qx, qy, qz = sensors[self.tip : self.tip + 10]
        return (x, y, z), quat_rotate((qw, qx, qy, qz), (-fx, -fy, -fz))

    def tension_n(self, sensors: Sequence[float]) -> float:
        """Return the tension of the tether, N; 0 without a tether."""
        return 0.0 if self.tether is None else sensors[self.tether]


@dataclass(frozen=True, slots=True)
class WorldEvent:
    """An event of the world."""

    t_s: float
    kind: str
    """Kind: thrown, caught, taken (out of the net), missed, bounced_out (of the bag), touched or gave_way (a surface), rotor_touched
    (a surface) or crashed."""


class Effect(Protocol):
    """An effect that loads bodies of the world."""

    def apply(self, world: World) -> None:
        """Set this effect's loads for the next `EFFECT_PERIOD_S`."""

    def restart_noise(self) -> None:
        """Restart the effect's noise sequence."""


class World:
    """The physics; `step` advances it by `PHYSICS_DT_S`."""

    def __init__(
        self, vehicle: Vehicle, config: WorldConfig, start_position_m: Vec2, start_yaw_rad: float, arm_rad: Joints
    ):
        self._vehicle = vehicle
        self._config = config
        self.model = mujoco.MjModel.from_xml_string(mjcf(vehicle, config, PHYSICS_DT_S))
        self.data = mujoco.MjData(self.model)
        m = self.model
        joints = [m.joint(f"alpha{number + 1}").id for number in range(len(arm_rad))]
        self.layout = Layout(
            tuple(int(m.jnt_qposadr[joint]) for joint in joints),
            tuple(int(m.jnt_dofadr[joint]) for joint in joints),
            accel=int(m.sensor("accel").adr[0]),
            gyro=int(m.sensor("gyro").adr[0]),
            force=int(m.sensor("force").adr[0]),
            torque=int(m.sensor("torque").adr[0]),
            tether=int(m.sensor("tether").adr[0]) if vehicle.tether is not None else None,
            tip=int(m.sensor("contact").adr[0]) if has_tip(vehicle, config) else None,
        )
        self._base = m.body("base").id
        self._net = m.body("net").id
        self._tip = m.body("tip" if has_tip(vehicle, config) else "net").id
        self.surfaces = Surfaces.of(vehicle, config, m)
        """Surfaces; None if there are none."""
        self._park = [m.equality(name).id for name in (f"park{number + 1}" for number in range(len(arm_rad)))]
        self.parked = True
        """Whether a support holds the arm."""
        layout = vehicle.airframe.rotor_layout
        self.rotor_count, self.battery_cells = layout.count, vehicle.airframe.battery_cells
        self._rotor_max_n, self._rotor_height_m = vehicle.airframe.thrust_max_n / layout.count, layout.height_m
        self._rotors: Rotors | LinearRotors = Rotors.of(config.rotors, layout, PHYSICS_DT_S) or LinearRotors(
            layout.count, config.rotor_lag_s, PHYSICS_DT_S
        )
        self.battery = BatteryPack.of(
            config.battery, config.battery_start, config.battery_life_s, self.weight_n, vehicle.airframe
        )
        """The battery, or None if its effect is off."""
        self._standing_m = vehicle.airframe.ground_clearance_m
        self.wind_m_s = config.wind_m_s
        self.rotor_share: Thrusts | None = None
        """Fraction of each rotor's thrust that remains during a fault; None without a fault."""
        self.snag: tuple[Vec3, float] | None = None
        """Point where the tether is snagged and its free length from there to the vehicle; None if it is not snagged."""
        self._tether = m.tendon("tether").id if vehicle.tether is not None else None
        self._attached = self.data.site_xpos[m.site("tether").id]
        self._thrust: Thrusts = (0.0,) * layout.count
        self.crashed = False
        self._events: list[WorldEvent] = []
        d = self.data
        # Views: looking up MuJoCo's arrays in every step costs more than reading them.
        self._ctrl, self._qpos, self._qvel, self._sensordata = d.ctrl, d.qpos, d.qvel, d.sensordata
        self._controls = Writer(d.ctrl)
        self.loads = Loads(d)
        self.payload = Payload(self, vehicle, config)
        self.effects = self._effects_on()
        self._step = 0
        """Number of steps since the noise of the effects was last restarted."""
        self.t_s = 0.0
        self.q: list[float] = []
        self.v: list[float] = []
        """qpos and qvel after the last step; see `layout`."""
        self._sensors: list[float] | None = None
        """Sensor values of the last step, read from MuJoCo on first access; None until then."""
        self._place(start_position_m, start_yaw_rad, arm_rad)

    def _effects_on(self) -> tuple[Effect, ...]:
        """Return the active effects."""
        config, vehicle = self._config, self._vehicle
        effects: tuple[Effect | None, ...] = (
            Air.of(config.air, config.seed, self._base, self.weight_n),
            Downwash.of(config.downwash, config.rotors.radius_m, vehicle, self, config.seed),
            TetherLine.of(config.tether_line, vehicle.tether, self._base),
        )
        return tuple(effect for effect in effects if effect is not None)

    def _place(self, position_m: Vec2, yaw_rad: float, arm_rad: Joints) -> None:
        q = self.data.qpos
        q[0:3] = (*position_m, self._vehicle.airframe.ground_clearance_m)
        q[3:7] = (math.cos(yaw_rad / 2), 0, 0, math.sin(yaw_rad / 2))
        q[list(self.layout.joint_q)] = arm_rad
        for park, angle in zip(self._park, arm_rad, strict=True):
            self.model.eq_data[park, 0] = angle
        mujoco.mj_forward(self.model, self.data)
        self.q, self.v = self._qpos.tolist(), self._qvel.tolist()
        self.payload.await_pass()

    def sensors(self) -> list[float]:
        """Return sensordata after the last step; see `layout`."""
        if self._sensors is None:
            self._sensors = self._sensordata.tolist()
        return self._sensors

    def push(self, force_world_n: Vec3) -> None:
        """Set the external force on the tip, which is the centre of the net or the end of the rod, in N, world frame."""
        torque_nm = ZERO
        if self._tip != self._net:
            tx, ty, tz = (self.data.xpos[self._tip] - self.data.xipos[self._net]).tolist()
            torque_nm = cross((tx, ty, tz), force_world_n)
        self.loads.set(self._net, "push", force_world_n, torque_nm)

    def hold(self, wrench: Wrench | None) -> None:
        """Set the force and torque of handling on the base; None releases the base."""
        self.loads.set(self._base, "hold", *(wrench or (ZERO, ZERO)))

    def restart_noise(self) -> None:
        """Restart the noise of all effects."""
        self._step = 0
        for effect in self.effects:
            effect.restart_noise()

    @property
    def rotor_thrust_n(self) -> Thrusts:
        """Thrust of each rotor in N, in PX4's order."""
        return tuple(self._ctrl[0 : self.rotor_count].tolist())

    @property
    def weight_n(self) -> float:
        """Weight of the vehicle without payload, N."""
        return GRAVITY_M_S2 * float(self.model.body_subtreemass[self._base])

    @property
    def thrust_n(self) -> Thrusts:
        """Thrust of each rotor in N before ground effect and faults, in PX4's order."""
        return self._thrust

    @property
    def hover_command(self) -> float:
        """True normalised hover thrust (0 to 1) without payload, far from the ground, at the battery's initial charge."""
        ratio = 1.0 if self.battery is None else self.battery.thrust_ratio(self.battery.hover_v)
        each_n = self.weight_n / self.rotor_count
        return self._rotors.hover_command(each_n, self._rotor_max_n * ratio, self._config.thr_mdl_fac)

    def step(
        self, rotor_commands: Sequence[float], joint_torque_nm: Joints, airborne: bool = True, *, drag: bool = True
    ) -> None:
        """Advance by one physics step.

        Args:
            rotor_commands: motor signals, 0 to 1, in PX4's order.
            joint_torque_nm: torque on each joint, from the motors or from their gears.
            airborne: whether a payload may be thrown.
            drag: whether aerodynamic drag and wind act.
        """
        most, rotors, battery = self._rotor_max_n, self._rotors, self.battery
        if battery is not None:
            most *= battery.thrust_ratio(battery.voltage_v)
        self._thrust = thrust = rotors.step(rotor_commands, most)
        if battery is not None:
            battery.step(PHYSICS_DT_S, thrust)
        near = rotors.ground_effect(self.q[2] + self._rotor_height_m)
        thrust = tuple([near * force for force in thrust])
        if self.rotor_share is not None:
            thrust = tuple([force * share for force, share in zip(thrust, self.rotor_share, strict=True)])
        self._controls.write(thrust + joint_torque_nm)
        self.loads.set(self._base, "drag and snag", self._drag_and_snag_n(thrust, drag))
        if self.effects:
            if self._step % _EFFECT_STEPS == 0:
                for effect in self.effects:
                    effect.apply(self)
            self._step += 1
        bag = self.payload.bag
        if bag is None:
            self.loads.write()
            mujoco.mj_step(self.model, self.data)
        elif bag.step(self.q, self.v, self.t_s):
            self.report("bounced_out")
        self.t_s = self.data.time
        self.q, self.v = self._qpos.tolist(), self._qvel.tolist()
        self._sensors = None
        if self.surfaces is not None:
            self.surfaces.step(self)
        self.payload.step(airborne)
        self._watch_crash()

    def _drag_and_snag_n(self, thrust_n: Thrusts, drag: bool) -> Vec3:
        """Return the force of the air and of a snagged tether on the base in N, world frame."""
        force_n = ZERO
        if drag:
            wx, wy, wz = self.wind_m_s
            v = self.v
            wx, wy, wz = wx - v[0], wy - v[1], wz - v[2]
            hx, hy, hz = self._rotors.drag_n(sum(thrust_n), (wx, wy, wz), self.q)
            force_n = (BODY_DRAG_N_PER_M_S * wx + hx, BODY_DRAG_N_PER_M_S * wy + hy, BODY_DRAG_N_PER_M_S * wz + hz)
        if self.snag is not None:
            x, y, z = force_n
            px, py, pz = self._snag_pull_n(*self.snag)
            force_n = (x + px, y + py, z + pz)
        return force_n

    def add_joint_inertia(self, transmissions: Sequence[Transmission]) -> None:
        """Add the inertia to the links that their transmissions need (`added_inertia_kg_m2`)."""
        joint_v = list(self.layout.joint_v)
        added_kg_m2 = added_inertia_kg_m2(self.model, list(self.layout.joint_q), joint_v, transmissions)
        if added_kg_m2 > 0.0:
            self.model.dof_armature[joint_v] += added_kg_m2

    def release_arm(self) -> None:
        """Release the arm from its support."""
        self.parked = False
        self.data.eq_active[self._park] = 0

    def hold_arm(self, angle_rad: Joints) -> None:
        """Hold the joints at these angles until `release_arm`."""
        self.parked = True
        self.data.eq_active[self._park] = 1
        for park, angle in zip(self._park, angle_rad, strict=True):
            self.model.eq_data[park, 0] = angle

    @property
    def attachment_world_m(self) -> Vec3:
        """Point where the tether is attached to the vehicle, world frame; the body's origin without a tether."""
        return vec3_of(self._attached)

    @property
    def tether_length_m(self) -> float:
        """Present length of the tether; infinite without a tether."""
        return math.inf if self._tether is None else float(self.model.tendon_range[self._tether, 1])

    @tether_length_m.setter
    def tether_length_m(self, length_m: float) -> None:
        self.model.tendon_range[self._tether, 1] = length_m

    def _snag_pull_n(self, point_m: Vec3, length_m: float) -> Vec3:
        """Return the pull of a stiff, damped line from the snag point on the vehicle in N, world frame."""
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
        """Detect a crash: the vehicle is far below its standing height, tilted by more than 72 deg, or has hit the floor too fast."""
        if self.crashed:
            return
        q = self.q
        z, x, y = q[2], q[4], q[5]
        up = 1.0 - 2.0 * (x * x + y * y)
        fell = z < self._standing_m and self.v[2] < -FALL_M_S
        if fell or z < 0.6 * self._standing_m or up < 0.3 or not math.isfinite(z):
            self.crash()

    def crash(self, cause: str | None = None) -> None:
        """End the flight as a crash.

        Args:
            cause: an event to report before the crash.
        """
        if self.crashed:
            return
        self.crashed = True
        if cause is not None:
            self.report(cause)
        self.report("crashed")

    def report(self, kind: str) -> None:
        """Record an event at the present time."""
        self._events.append(WorldEvent(self.t_s, kind))

    def take_events(self) -> list[WorldEvent]:
        """Return and clear the events since the last call."""
        events, self._events = self._events, []
        return events

    def snapshot(self) -> Snapshot:
        """Return MuJoCo's state after the last step; its lists are never changed afterwards."""
        return Snapshot(self.t_s, self.q, self.v, self.sensors())

    def truth(self) -> Truth:
        """Return the true state after the last step."""
        return self.layout.truth(self.snapshot())
