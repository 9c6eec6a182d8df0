"""Injects the faults of the simulated world: their schedule, and their effect on physics, sensors and PX4.

The plant calls `Faults.step` in every step. `sitl.server` and the fast closed loop read faults of the link, the servo bus and the
processes from `active`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from companion.config.tether import Tether
from companion.model.frames import quat_from_euler_zyx, quat_multiply, tilt_rad
from companion.model.types import Quat, Vec3
from companion.sitl_config.faults import Fault, FaultKind
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.modes import NavState
from sitl.autopilot.types import FaultTarget
from sitl.servo.drive import COUNTS_PER_TURN, ServoDrive
from sitl.world.machine import Machine
from sitl.world.model import SECOND, SECOND_CATCH
from sitl.world.payload import Ball
from sitl.world.scene import Scene
from sitl.world.tool_contact import ToolContact

CELL_FULL_V: Final = 4.15
OVERHEATED_C = 80.0
OVERLOAD, OVERHEATING = 0x20, 0x04
"""Bits of register 70 (hardware error status)."""
COOL_C = 35.0
_FOREVER_M = 1000.0
LATE_S = 0.01
"""If a fault has already been due for longer than this when its time origin becomes known, it begins at that moment."""
_OTHER_BODY_Z_M = 0.05
_OTHER_BODY_YAW_RAD = math.radians(120.0)
_BESIDE = (0.6, 0.8)


class ClampServo(Protocol):
    """The clamp's servo, with or without its control table."""

    def trip_overload(self) -> None:
        """Raise the overload error."""


class Servo(ClampServo, Protocol):
    """A servo behind its control table (`sitl.servo.model.ServoModel`)."""

    def set_temperature_c(self, temperature_c: float) -> None:
        """Set the motor temperature."""


class Faults:
    """The faults of one world.

    Args:
        config: configuration of the world; every fault has a time (`with_fault_times`).
        servos: control tables of the servos; empty in the fast closed loop.
        clamp: the clamp's servo; None without a clamp.
    """

    def __init__(
        self,
        config: WorldConfig,
        scene: Scene,
        machine: Machine,
        px4: FaultTarget,
        drives: Sequence[ServoDrive],
        tether: Tether | None,
        servos: Sequence[Servo] = (),
        clamp: ClampServo | None = None,
    ) -> None:
        self._faults = config.faults
        self._on = [False] * len(config.faults)
        self._begins_s: list[float | None] = [None] * len(config.faults)
        self._scene, self._machine = scene, machine
        self._px4, self._drives, self._servos, self._clamp = px4, drives, servos, clamp
        self._tether = tether
        self._wind_m_s = machine.wind_m_s
        self._tether_m = machine.tether.length_m
        self._chance = np.random.default_rng([config.seed, len(config.faults)])
        self.active: dict[FaultKind, Fault] = {}
        self.begun_s: float | None = None
        """World time at which the first fault began, or None."""
        self.sag_v = 0.0
        """Voltage drop of the battery caused by a fault."""
        self.errors = [0] * len(drives)
        """Register 70 (hardware error status) of each servo, if the servos have no control tables."""
        self.temperatures_c = [COOL_C] * len(drives)
        self._frozen: tuple[Vec3, Quat] | None = None
        self._every_second = False
        self._other: tuple[Vec3, Quat] | None = None
        self._stuck: tuple[Vec3, Vec3] | None = None
        self._now_s = self._drag_began_s = 0.0
        self._second: Ball | None = None
        self._pilot_lands_s = math.inf
        self._stepped_s = math.inf

    # -- when ------------------------------------------------------------------------------------------------------

    def step(self, t_s: float, armed_t_s: float | None) -> None:
        """Start and end faults that are due; call it before every step of the physics."""
        self._now_s = t_s
        contact, payload, bar = self._machine.contact, self._scene.payload, self._scene.bar
        origins = {
            "start": 0.0,
            "arming": armed_t_s,
            "throw": payload.thrown_t_s,
            "catch": payload.caught_t_s,
            "touch": contact.touched_s if contact is not None else None,
            "press": contact.pressed_s if contact is not None else None,
            "lift": bar.lifted_s if bar is not None else None,
        }
        for index, fault in enumerate(self._faults):
            origin_s = origins[fault.after]
            assert fault.t_s is not None
            if origin_s is not None and self._begins_s[index] is None and t_s - origin_s >= fault.t_s:
                # A catch is known only when the payload has come to rest: the fault then begins late but lasts for its
                # full duration.
                due_s = origin_s + fault.t_s
                self._begins_s[index] = due_s if t_s - due_s < LATE_S else t_s
            begins_s = self._begins_s[index]
            on = begins_s is not None and (fault.duration_s is None or t_s - begins_s < fault.duration_s)
            if on is not self._on[index]:
                self._on[index] = on
                self._switch(fault, on, t_s)
        if self._second is not None and payload.catch(self._second, t_s):
            self._second = None
        if t_s >= self._pilot_lands_s:
            self._pilot_lands_s = math.inf
            self._px4.pilot_sets_mode(NavState.LAND)

    def _switch(self, fault: Fault, on: bool, t_s: float) -> None:
        if on:
            self.active[fault.kind] = fault
            if self.begun_s is None:
                self.begun_s = t_s
        else:
            others = [other for other, acts in zip(self._faults, self._on, strict=True) if acts]
            same = next((other for other in others if other.kind == fault.kind), None)
            if same is not None:  # another fault of this kind is still active
                self.active[fault.kind] = same
                return
            del self.active[fault.kind]
        self._act(fault, on, t_s)

    # -- what ------------------------------------------------------------------------------------------------------

    def _act(self, fault: Fault, on: bool, t_s: float) -> None:
        """Apply the start (`on`) or the end of a fault that acts on the physics, the servos or PX4."""
        machine, payload, px4, size = self._machine, self._scene.payload, self._px4, fault.magnitude
        match fault.kind:
            case "motor_weak" | "battery_sag":
                self._set_rotor_share()
            case "gust":
                self._set_gust(size if on else 0.0)
            case "tether_taut":
                assert self._tether is not None, "refused when the configuration is loaded"
                away_m = math.dist(machine.tether.attachment_world_m, self._tether.anchor_world_m)
                machine.tether.length_m = min(self._tether_m, away_m + size) if on else self._tether_m
            case "tether_cut":
                machine.tether.length_m = _FOREVER_M if on else self._tether_m
            case "tether_snag":
                x, y, z = machine.tether.attachment_world_m
                machine.tether.snag = ((x, y, 0.0), z + size) if on else None
            case "payload_missed":
                payload.aside_m = size if on else 0.0
            case "payload_double" if on:
                self._second = Ball.of(self._scene.model, SECOND, SECOND_CATCH)
                payload.throw(self._second)
            case "payload_dropped" if on:
                payload.drop()
            case "surface_gone" if on:
                for number in range(len(self._contact.surfaces.placed)):
                    self._contact.surfaces.give_way(number)
            case "surface_slippery":
                for number, placed in enumerate(self._contact.surfaces.placed):
                    self._contact.surfaces.set_friction(number, size if on else placed.config.friction)
            case "tool_broken" if on:
                self._contact.break_tool()
            case "servo_overload" if on:
                self._shut_down_servo(fault.servo - 1, OVERLOAD)
            case "clamp_overload" if on:
                assert self._clamp is not None, "refused when the configuration is loaded"
                self._clamp.trip_overload()
            case "servo_hot":
                self._heat(fault.servo - 1, size if on else COOL_C)
            case "servo_angle":
                self._drives[fault.servo - 1].slip_counts = round(size / 360.0 * COUNTS_PER_TURN) if on else 0
            case "autopilot_reboot" if on:
                px4.reboot(size)
            case "offboard_refused":
                px4.refuses_offboard = on
            case "arming_refused":
                px4.refuses_arming = on
            case "kill_switch":
                px4.kill_switch = on
            case "pilot_takeover" if on:
                px4.pilot_sets_mode(NavState.LOITER)
                self._pilot_lands_s = t_s + size
            case "mocap_swap":
                x, y, _ = machine.q[0:3]
                there = (x, y + size, _OTHER_BODY_Z_M)
                self._other = (there, quat_from_euler_zyx(0.0, 0.0, _OTHER_BODY_YAW_RAD)) if on else None
            case "mocap_drag":
                self._drag_began_s = t_s
            case "clock_step":
                self._stepped_s = t_s if on else math.inf
            case "mocap_freeze":
                self._frozen = None
            case "force_stuck":
                self._stuck = None
            case _:
                pass

    @property
    def _contact(self) -> ToolContact:
        contact = self._machine.contact
        assert contact is not None, "refused when the configuration is loaded"
        return contact

    def _set_rotor_share(self) -> None:
        weak, sag = self.active.get("motor_weak"), self.active.get("battery_sag")
        self.sag_v = sag.magnitude if sag is not None else 0.0
        every = (1.0 - self.sag_v / (CELL_FULL_V * self._machine.battery_cells)) ** 2
        first = every * (1.0 - weak.magnitude) if weak is not None else every
        share = (first, *[every] * (self._machine.rotor_count - 1))
        self._machine.rotor_share = None if min(share) == 1.0 else share

    def _set_gust(self, speed_m_s: float) -> None:
        """Add wind into the first surface; without one away from the tether's anchor, or without a tether from the world's origin."""
        if self._scene.surfaces is not None:
            (nx, ny, nz), (wx, wy, wz) = self._scene.surfaces.placed[0].normal, self._wind_m_s
            self._machine.wind_m_s = (wx - speed_m_s * nx, wy - speed_m_s * ny, wz - speed_m_s * nz)
            return
        ax, ay = self._tether.anchor_world_m[0:2] if self._tether is not None else (0.0, 0.0)
        x, y = self._machine.q[0] - ax, self._machine.q[1] - ay
        away_m = math.hypot(x, y) or 1.0
        wx, wy, wz = self._wind_m_s
        self._machine.wind_m_s = (wx + speed_m_s * x / away_m, wy + speed_m_s * y / away_m, wz)

    def _shut_down_servo(self, index: int, error: int) -> None:
        if self._servos and error == OVERLOAD:
            self._servos[index].trip_overload()
        elif not self._servos:
            self.errors[index] |= error
            self._drives[index].torque_on = False

    def _heat(self, index: int, temperature_c: float) -> None:
        self.temperatures_c[index] = temperature_c
        if self._servos:
            self._servos[index].set_temperature_c(temperature_c)
        elif temperature_c > OVERHEATED_C:
            self._shut_down_servo(index, OVERHEATING)

    # -- sensors ---------------------------------------------------------------------------------------------------

    def pose(self, position_world_m: Vec3, attitude_wxyz: Quat) -> tuple[Vec3, Quat, bool]:
        """Return the pose that motion capture measures in place of the true pose, and whether it tracks the body."""
        active = self.active
        pose = (position_world_m, attitude_wxyz)
        if "mocap_freeze" in active:
            if self._frozen is None:
                self._frozen = pose
            pose = self._frozen
        if self._other is not None:
            pose = self._other
        self._every_second = not self._every_second
        if self._every_second:
            turned_rad, flicker_m = math.radians(self.size("mocap_flip")), self.size("mocap_flicker")
            if turned_rad:
                pose = (pose[0], quat_multiply(quat_from_euler_zyx(0.0, 0.0, turned_rad), pose[1]))
        else:
            flicker_m = 0.0
        shift_m = flicker_m + self.size("mocap_jump") + self.size("mocap_drag") * (self._now_s - self._drag_began_s)
        if shift_m:
            (x, y, z), attitude = pose
            pose = ((x + _BESIDE[0] * shift_m, y + _BESIDE[1] * shift_m, z), attitude)
        return (*pose, "mocap_occluded" not in active)

    def mocap_period_s(self, usual_s: float) -> float:
        """Return the time from one exposure to the next."""
        slow = self.active.get("mocap_rate")
        return usual_s if slow is None else max(usual_s, 1.0 / slow.magnitude)

    def size(self, kind: FaultKind) -> float:
        """Return the size of the active fault of this kind, in the kind's unit; 0 if none is active."""
        fault = self.active.get(kind)
        return 0.0 if fault is None else fault.magnitude

    def server_clock_s(self, t_s: float) -> float:
        """Return the time on the motion-capture server's clock at world time `t_s`."""
        return t_s + self.size("clock_step") if t_s >= self._stepped_s else t_s

    def wrench(self, force_n: Vec3, torque_nm: Vec3) -> tuple[Vec3, Vec3]:
        """Return the force sensor's measurement in place of the true wrench."""
        bias_n = self.size("force_bias")
        if bias_n:
            x, y, z = force_n
            force_n = (x + bias_n, y + bias_n, z + bias_n)
        if "force_stuck" in self.active:
            if self._stuck is None:
                self._stuck = (force_n, torque_nm)
            return self._stuck
        return force_n, torque_nm

    def packet_lost(self) -> bool:
        """Return whether noise corrupts this transaction on the servo bus, decided at random."""
        share = self.size("bus_noise")
        return share > 0.0 and float(self._chance.random()) < share


@dataclasses.dataclass(frozen=True, slots=True)
class Sample:
    """True state of the vehicle at one moment, for the table of a campaign."""

    t_s: float
    position_world_m: Vec3
    tilt_rad: float
    slack_m: float | None
    """Slack of the tether, computed with its present length; None without a tether."""
    tension_n: float
    contact_n: float
    """Force of a surface on the tip."""


def sample(machine: Machine, tether: Tether | None) -> Sample:
    """Return the present true state of the vehicle and its tether."""
    x, y, z, *attitude = machine.q[0:7]
    state, slack_m = machine.snapshot(), None
    if tether is not None:
        slack_m = machine.tether.length_m - math.dist(machine.tether.attachment_world_m, tether.anchor_world_m)
    return Sample(
        t_s=state.t_s,
        position_world_m=(x, y, z),
        tilt_rad=tilt_rad((attitude[0], attitude[1], attitude[2], attitude[3])),
        slack_m=slack_m,
        tension_n=machine.layout.tension_n(state.sensors),
        contact_n=math.hypot(*machine.layout.contact(state.sensors)[1]) if machine.contact is not None else 0.0,
    )
