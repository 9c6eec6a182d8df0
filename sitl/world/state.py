"""What the simulated world reveals of itself: the true state of a machine, and the events of the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from companion.model.frames import quat_rotate
from companion.model.types import Joints, Quat, Vec3

PHYSICS_DT_S: Final = 0.002


@dataclass(frozen=True, slots=True)
class Truth:
    """True state of a machine; the world frame is ENU, the body frame FLU."""

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
    """A machine's part of MuJoCo's qpos, qvel and sensordata after one step; `Layout.truth` decodes them."""

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

    @property
    def sensor_count(self) -> int:
        """Number of sensor values of the machine."""
        return 12 + (self.tether is not None) + (0 if self.tip is None else 10)

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
    (a surface), rotor_hit (by a ball) or crashed."""


class Events:
    """The events of the world that have not been taken yet."""

    def __init__(self) -> None:
        self._events: list[WorldEvent] = []

    def report(self, t_s: float, kind: str) -> None:
        """Record an event at this world time."""
        self._events.append(WorldEvent(t_s, kind))

    def take(self) -> list[WorldEvent]:
        """Return and clear the events since the last call."""
        events, self._events = self._events, []
        return events
