"""A machine of a scene: an airframe with its rotors, arm, tool and tether, and the effects that load it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

from companion.model.algebra import cross
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_rotate
from companion.model.types import Joints, Vec3
from companion.sitl_config.effects.rotors import BODY_DRAG_N_PER_M_S
from sitl.world.effects.air import Air
from sitl.world.effects.battery import BatteryPack
from sitl.world.effects.downwash import Downwash
from sitl.world.effects.rotors import LinearRotors, Rotors, Thrusts
from sitl.world.effects.tether_line import TetherLine
from sitl.world.effects.transmission import Transmission, added_inertia_kg_m2
from sitl.world.handling import Wrench
from sitl.world.loads import EFFECT_PERIOD_S, ZERO, Bodies
from sitl.world.model import has_tip
from sitl.world.start import MachineSpec, Start
from sitl.world.state import PHYSICS_DT_S, Events, Layout, Snapshot, Truth
from sitl.world.surfaces import Surfaces
from sitl.world.tether import Tether
from sitl.world.tool_contact import ToolContact
from sitl.world.views import Writer

FALL_M_S: Final = 2.5
"""Speed of impact on the floor at which the legs break: the speed after a fall from 0.3 m. PX4 descends at 0.7 m/s at most."""
TURNING_N: Final = 0.1
"""Thrust of all rotors above which they turn."""
ROTORS_APART_M: Final = 0.05
"""Difference of height up to which two rotor disks above each other touch."""
_EFFECT_STEPS: Final = round(EFFECT_PERIOD_S / PHYSICS_DT_S)


class Effect(Protocol):
    """An effect that loads bodies of the world."""

    def apply(self, thrust_n: Thrusts, q: Sequence[float], v: Sequence[float]) -> None:
        """Set this effect's loads for the next `EFFECT_PERIOD_S`.

        Args:
            thrust_n: thrust of each rotor, in PX4's order.
            q: the machine's qpos, which begins with the pose of the base.
            v: the machine's qvel, which begins with the velocity of the base.
        """

    def restart_noise(self) -> None:
        """Restart the effect's noise sequence."""


class Machine:
    """One machine; call `command` before each step of the scene.

    Args:
        spec: vehicle file, configuration and start pose, at which the machine is put.
        events: where contacts and a crash are reported.
    """

    def __init__(self, spec: MachineSpec, bodies: Bodies, events: Events, surfaces: Surfaces | None) -> None:
        vehicle, config, start = spec
        model, data, self._loads, prefix = bodies
        airframe, joints = vehicle.airframe, len(vehicle.arm.joints)
        layout = airframe.rotor_layout
        self._config, self._events = config, events
        self._model, self._data = model, data
        self._base, self._net = bodies.body("base"), bodies.body("net")
        self._tip = bodies.body("tip") if has_tip(vehicle, config) else self._net
        self._park = [model.equality(f"{prefix}park{number + 1}").id for number in range(joints)]
        self.parked = True
        """Whether a support holds the arm."""
        self.tether = Tether(bodies, vehicle.tether is not None)
        self.contact = None if surfaces is None else ToolContact(surfaces, vehicle, bodies, events)
        """Contact with the surfaces; None if there are none."""
        self.rotor_count, self.battery_cells = layout.count, airframe.battery_cells
        self._rotor_max_n, self._rotor_height_m = airframe.thrust_max_n / layout.count, layout.height_m
        self._rotors_at_m = tuple((x, y) for x, y, _ in layout.positions_body_m)
        self._disk_m, self._reach_m = airframe.disk_radius_m, airframe.radius_m + layout.height_m
        self._rotors: Rotors | LinearRotors = LinearRotors(layout.count, config.rotor_lag_s, PHYSICS_DT_S)
        if config.rotors.on:
            self._rotors = Rotors(config.rotors, layout, PHYSICS_DT_S)
        self.battery: BatteryPack | None = None
        """The battery, or None if its effect is off."""
        if config.battery.on:
            full_s, charge = config.battery_life_s, config.battery_start
            self.battery = BatteryPack(config.battery, charge, full_s, self.weight_n, airframe)
        self._standing_m = airframe.ground_clearance_m
        self.wind_m_s = config.wind_m_s
        self.rotor_share: Thrusts | None = None
        """Fraction of each rotor's thrust that remains during a fault; None without a fault."""
        self.thrust_n: Thrusts = (0.0,) * layout.count
        """Thrust of each rotor in N before ground effect and faults, in PX4's order."""
        self.crashed = False
        # Views: looking up MuJoCo's arrays in every step costs more than reading them.
        base = model.joint(f"{prefix}base").id
        self._at_q, self._at_v = int(model.jnt_qposadr[base]), int(model.jnt_dofadr[base])
        self._qpos = data.qpos[self._at_q : self._at_q + 7 + joints]
        self._qvel = data.qvel[self._at_v : self._at_v + 6 + joints]
        rotor = model.actuator(f"{prefix}rotor0").id
        self._ctrl = data.ctrl[rotor : rotor + layout.count + joints]
        self._controls = Writer(self._ctrl)
        self.layout = _layout(joints, has_tether=vehicle.tether is not None, has_tip=has_tip(vehicle, config))
        sensor = int(model.sensor(f"{prefix}accel").adr[0])
        self._sensordata = data.sensordata[sensor : sensor + self.layout.sensor_count]
        self.effects: list[Effect] = []
        """The active effects that load bodies."""
        if config.air.on:
            self.effects.append(Air(config.air, config.seed, bodies, self.weight_n))
        if config.downwash.on:
            self.effects.append(Downwash(config, vehicle, bodies))
        if config.tether_line.on and vehicle.tether is not None:
            self.effects.append(TetherLine(config.tether_line, vehicle.tether, self.tether, bodies))
        self._step = 0
        """Number of steps since the noise of the effects was last restarted."""
        self._place(start)
        self.read()

    def _place(self, start: Start) -> None:
        q, yaw_rad = self._qpos, start.yaw_rad
        q[0:3] = (*start.position_m, self._standing_m)
        q[3:7] = (math.cos(yaw_rad / 2), 0, 0, math.sin(yaw_rad / 2))
        q[7:] = start.arm_rad
        self._model.eq_data[self._park, 0] = start.arm_rad

    def read(self) -> None:
        """Read the state after a step."""
        self.q: list[float] = self._qpos.tolist()
        """The machine's qpos; see `layout`."""
        self.v: list[float] = self._qvel.tolist()
        self._sensors: list[float] | None = None
        """Sensor values, read from MuJoCo on first access; None until then."""

    def sensors(self) -> list[float]:
        """Return the machine's sensor values after the last step; see `layout`."""
        if self._sensors is None:
            self._sensors = self._sensordata.tolist()
        return self._sensors

    def snapshot(self) -> Snapshot:
        """Return the state after the last step; its lists are never changed afterwards."""
        return Snapshot(self._data.time, self.q, self.v, self.sensors())

    def truth(self) -> Truth:
        """Return the true state after the last step."""
        return self.layout.truth(self.snapshot())

    def push(self, force_world_n: Vec3) -> None:
        """Set the external force on the tip, which is the centre of the net or the end of the rod, in N, world frame."""
        torque_nm = ZERO
        if self._tip != self._net:
            tx, ty, tz = (self._data.xpos[self._tip] - self._data.xipos[self._net]).tolist()
            torque_nm = cross((tx, ty, tz), force_world_n)
        self._loads.set(self._net, "push", force_world_n, torque_nm)

    def hold(self, wrench: Wrench | None) -> None:
        """Set the force and torque of handling on the base; None releases the base."""
        self._loads.set(self._base, "hold", *(wrench or (ZERO, ZERO)))

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
        return GRAVITY_M_S2 * float(self._model.body_subtreemass[self._base])

    @property
    def hover_command(self) -> float:
        """True normalised hover thrust (0 to 1) without payload, far from the ground, at the battery's initial charge."""
        ratio = 1.0 if self.battery is None else self.battery.thrust_ratio(self.battery.hover_v)
        each_n = self.weight_n / self.rotor_count
        return self._rotors.hover_command(each_n, self._rotor_max_n * ratio, self._config.thr_mdl_fac)

    def command(self, rotor_commands: Sequence[float], joint_torque_nm: Joints, *, drag: bool = True) -> None:
        """Set what acts on the machine in the next step of the scene.

        Args:
            rotor_commands: motor signals, 0 to 1, in PX4's order.
            joint_torque_nm: torque on each joint, from the motors or from their gears.
            drag: whether aerodynamic drag and wind act.
        """
        most, rotors, battery = self._rotor_max_n, self._rotors, self.battery
        if battery is not None:
            most *= battery.thrust_ratio(battery.voltage_v)
        self.thrust_n = thrust = rotors.step(rotor_commands, most)
        if battery is not None:
            battery.step(PHYSICS_DT_S, thrust)
        near = rotors.ground_effect(self.q[2] + self._rotor_height_m)
        thrust = tuple([near * force for force in thrust])
        if self.rotor_share is not None:
            thrust = tuple([force * share for force, share in zip(thrust, self.rotor_share, strict=True)])
        self._controls.write(thrust + joint_torque_nm)
        self._loads.set(self._base, "drag and snag", self._drag_and_snag_n(thrust, drag))
        if self.effects:
            if self._step % _EFFECT_STEPS == 0:
                for effect in self.effects:
                    effect.apply(thrust, self.q, self.v)
            self._step += 1

    def _drag_and_snag_n(self, thrust_n: Thrusts, drag: bool) -> Vec3:
        """Return the force of the air and of a snagged tether on the base in N, world frame."""
        force_n = ZERO
        if drag:
            wx, wy, wz = self.wind_m_s
            v = self.v
            wx, wy, wz = wx - v[0], wy - v[1], wz - v[2]
            hx, hy, hz = self._rotors.drag_n(sum(thrust_n), (wx, wy, wz), self.q)
            force_n = (BODY_DRAG_N_PER_M_S * wx + hx, BODY_DRAG_N_PER_M_S * wy + hy, BODY_DRAG_N_PER_M_S * wz + hz)
        if self.tether.snag is not None:
            x, y, z = force_n
            px, py, pz = self.tether.snag_pull_n(self.v[0:3])
            force_n = (x + px, y + py, z + pz)
        return force_n

    def add_joint_inertia(self, transmissions: Sequence[Transmission]) -> None:
        """Add the inertia to the links that their transmissions need (`added_inertia_kg_m2`)."""
        added_kg_m2 = added_inertia_kg_m2(self._model, self._at_q, self._at_v, transmissions)
        if added_kg_m2 > 0.0:
            joint = self._at_v + 6
            self._model.dof_armature[joint : joint + len(transmissions)] += added_kg_m2

    def release_arm(self) -> None:
        """Release the arm from its support."""
        self.parked = False
        self._data.eq_active[self._park] = 0

    def hold_arm(self, angle_rad: Joints) -> None:
        """Hold the joints at these angles until `release_arm`."""
        self.parked = True
        self._data.eq_active[self._park] = 1
        self._model.eq_data[self._park, 0] = angle_rad

    def watch_contact(self, t_s: float) -> None:
        """Watch the contact with the surfaces at world time `t_s`."""
        contact = self.contact
        if contact is not None:
            contact.step(t_s, self.q, *self.layout.contact(self.sensors()))
            if contact.rotor_distance_m <= 0.0:
                self._crash(t_s, "rotor_touched")

    def watch_ball(self, t_s: float, at_world_m: Vec3, radius_m: float) -> None:
        """Detect a ball in the disk of a turning rotor, which breaks it: the end of the flight."""
        q, (x, y, z) = self.q, at_world_m
        x, y, z = x - q[0], y - q[1], z - q[2]
        reach_m = self._reach_m + radius_m
        if self.crashed or x * x + y * y + z * z > reach_m * reach_m or sum(self.thrust_n) < TURNING_N:
            return
        x, y, z = quat_rotate((q[3], -q[4], -q[5], -q[6]), (x, y, z))
        if abs(z - self._rotor_height_m) < radius_m and any(
            math.hypot(x - rotor_x, y - rotor_y) < self._disk_m + radius_m for rotor_x, rotor_y in self._rotors_at_m
        ):
            self._crash(t_s, "rotor_hit")

    def watch_rotors_of(self, t_s: float, other: Machine) -> None:
        """Detect rotor disks of two machines that touch, which ends the flight of both."""
        if math.dist(self.q[0:3], other.q[0:3]) > self._reach_m + other._reach_m:
            return
        for x, y, z in other.rotors_world_m():
            for own_x, own_y, own_z in self.rotors_world_m():
                near_m = self._disk_m + other._disk_m
                if math.hypot(x - own_x, y - own_y) < near_m and abs(z - own_z) < ROTORS_APART_M:
                    self._crash(t_s, "rotors_touched")
                    other._crash(t_s, "rotors_touched")
                    return

    def rotors_world_m(self) -> list[Vec3]:
        """Return the centres of the rotors, world frame."""
        x, y, z, *attitude = self.q[0:7]
        found = []
        for rotor_x, rotor_y in self._rotors_at_m:
            dx, dy, dz = quat_rotate(
                (attitude[0], attitude[1], attitude[2], attitude[3]), (rotor_x, rotor_y, self._rotor_height_m)
            )
            found.append((x + dx, y + dy, z + dz))
        return found

    def watch_crash(self, t_s: float) -> None:
        """Detect a crash: the vehicle is far below its standing height, tilted by more than 72 deg, or has hit the floor too fast."""
        if self.crashed:
            return
        q = self.q
        z, x, y = q[2], q[4], q[5]
        up = 1.0 - 2.0 * (x * x + y * y)
        fell = z < self._standing_m and self.v[2] < -FALL_M_S
        if fell or z < 0.6 * self._standing_m or up < 0.3 or not math.isfinite(z):
            self._crash(t_s)

    def _crash(self, t_s: float, cause: str | None = None) -> None:
        if self.crashed:
            return
        self.crashed = True
        if cause is not None:
            self._events.report(t_s, cause)
        self._events.report(t_s, "crashed")


def _layout(joints: int, *, has_tether: bool, has_tip: bool) -> Layout:
    """Return the layout of the sensors in the order in which `sitl.world.model` writes them."""
    return Layout(
        joint_q=tuple(range(7, 7 + joints)),
        joint_v=tuple(range(6, 6 + joints)),
        accel=0,
        gyro=3,
        force=6,
        torque=9,
        tether=12 if has_tether else None,
        tip=12 + has_tether if has_tip else None,
    )
