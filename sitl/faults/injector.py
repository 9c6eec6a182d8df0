"""Faults in the simulated world: which of them act now, and what they do to physics, sensors and PX4.

The plant calls `Faults.step` in every step; the wires and the fast closed loop ask `active` for what is theirs: link, bus, processes.
Without faults there is no `Faults`, and nothing is called.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from companion.model.frames import quat_from_euler_zyx, tilt_rad
from companion.model.types import Quat, Vec3, Vec4
from companion.sitl_config.faults import Fault, FaultKind
from companion.sitl_config.world import World as WorldConfig
from sitl.autopilot.modes import NavState
from sitl.servo.drive import COUNTS_PER_TURN, ServoDrive
from sitl.world.model import SECOND, SECOND_CATCH
from sitl.world.world import Ball, World

FULL_V = 16.6
OVERHEATED_C = 80.0
OVERLOAD, OVERHEATING = 0x20, 0x04
"""Bits of register 70."""
COOL_C = 35.0
_FOREVER_M = 1000.0
_OTHER_BODY_Z_M = 0.05
_OTHER_BODY_YAW_RAD = math.radians(120.0)
_BESIDE = (0.6, 0.8)


class Servo(Protocol):
    """A servo behind its control table (`sitl.servo.model.ServoModel`)."""

    def trip_overload(self) -> None:
        """Overload error."""

    def set_temperature_c(self, temperature_c: float) -> None:
        """Motor temperature."""


class Autopilot(Protocol):
    """What faults do to an autopilot (`sitl.autopilot.autopilot.Px4Stub`)."""

    refuses_offboard: bool
    refuses_arming: bool

    def reboot(self, for_s: float) -> None:
        """Restart; `for_s` from now it runs again."""

    def pilot_chooses(self, state: NavState) -> None:
        """A mode by somebody else."""


class Faults:
    """The faults of one world.

    Args:
        config: of the world; every fault has a time.
        world: physics.
        px4: the autopilot.
        drives: motors of both servos.
        anchor_world_m: of the tether.
        servos: control tables of both servos, where there are any.
    """

    def __init__(
        self,
        config: WorldConfig,
        world: World,
        px4: Autopilot,
        drives: Sequence[ServoDrive],
        anchor_world_m: Vec3,
        servos: Sequence[Servo] = (),
    ) -> None:
        self._faults = config.faults
        self._on = [False] * len(config.faults)
        self._world, self._px4, self._drives, self._servos = world, px4, drives, servos
        self._anchor_m = anchor_world_m
        self._wind_m_s = world.wind_m_s
        self._tether_m = world.tether_length_m
        self._chance = np.random.default_rng([config.seed, len(config.faults)])
        self.active: dict[FaultKind, Fault] = {}
        """Those that act now."""
        self.begun_s: float | None = None
        """World time at which the first one began."""
        self.sag_v = 0.0
        """Voltage that the battery has lost."""
        self.errors = [0, 0]
        """Register 70 of each servo, where there is no control table."""
        self.temperatures_c = [COOL_C, COOL_C]
        self._frozen: tuple[Vec3, Quat] | None = None
        self._other: tuple[Vec3, Quat] | None = None
        self._stuck: tuple[Vec3, Vec3] | None = None
        self._now_s = self._drag_began_s = 0.0
        self._second: Ball | None = None
        self._pilot_lands_s = math.inf
        self._stepped_s = math.inf

    # -- when ------------------------------------------------------------------------------------------------------

    def step(self, t_s: float, armed_t_s: float | None) -> None:
        """Before every step of the physics; `armed_t_s`: world time at which the rotors were armed."""
        self._now_s = t_s
        origins = {"start": 0.0, "arming": armed_t_s, "catch": self._world.caught_t_s}
        for index, fault in enumerate(self._faults):
            origin_s = origins[fault.after]
            assert fault.t_s is not None
            since_s = -1.0 if origin_s is None else t_s - origin_s
            end_s = math.inf if fault.duration_s is None else fault.t_s + fault.duration_s
            on = fault.t_s <= since_s < end_s
            if on is not self._on[index]:
                self._on[index] = on
                self._switch(fault, on, t_s)
        if self._second is not None and self._world.catch(self._second):
            self._second = None
        if t_s >= self._pilot_lands_s:
            self._pilot_lands_s = math.inf
            self._px4.pilot_chooses(NavState.LAND)

    def _switch(self, fault: Fault, on: bool, t_s: float) -> None:
        if on:
            self.active[fault.kind] = fault
            if self.begun_s is None:
                self.begun_s = t_s
        else:
            others = [other for other, acts in zip(self._faults, self._on, strict=True) if acts]
            same = next((other for other in others if other.kind == fault.kind), None)
            if same is not None:  # of two of a kind the other one goes on
                self.active[fault.kind] = same
                return
            del self.active[fault.kind]
        self._act(fault, on, t_s)

    # -- what ------------------------------------------------------------------------------------------------------

    def _act(self, fault: Fault, on: bool, t_s: float) -> None:
        """The beginning or the end of a fault of the physics, of the servos or of PX4."""
        world, px4, size = self._world, self._px4, fault.magnitude
        match fault.kind:
            case "motor_weak" | "battery_sag":
                self._weaken()
            case "gust":
                self._blow(size if on else 0.0)
            case "tether_taut":
                away_m = math.dist(world.attachment_world_m, self._anchor_m)
                world.tether_length_m = min(self._tether_m, away_m + size) if on else self._tether_m
            case "tether_cut":
                world.tether_length_m = _FOREVER_M if on else self._tether_m
            case "tether_snag":
                x, y, z = world.attachment_world_m
                world.snag = ((x, y, 0.0), z + size) if on else None
            case "payload_missed":
                world.throw_aside_m = size if on else 0.0
            case "payload_double" if on:
                self._second = Ball.of(world.model, SECOND, SECOND_CATCH)
                world.throw(self._second)
            case "payload_dropped" if on:
                world.drop()
            case "servo_overload" if on:
                self._let_go(fault.servo - 1, OVERLOAD)
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
            case "pilot_takeover" if on:
                px4.pilot_chooses(NavState.LOITER)
                self._pilot_lands_s = t_s + size
            case "mocap_swap":
                x, y, _ = world.q[0:3]
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

    def _weaken(self) -> None:
        weak, sag = self.active.get("motor_weak"), self.active.get("battery_sag")
        self.sag_v = sag.magnitude if sag is not None else 0.0
        every = (1.0 - self.sag_v / FULL_V) ** 2
        first = every * (1.0 - weak.magnitude) if weak is not None else every
        share: Vec4 = (first, every, every, every)
        self._world.rotor_share = None if min(share) == 1.0 else share

    def _blow(self, speed_m_s: float) -> None:
        x, y = (p - a for p, a in zip(self._world.q[0:2], self._anchor_m[0:2], strict=True))
        away_m = math.hypot(x, y) or 1.0
        wx, wy, wz = self._wind_m_s
        self._world.wind_m_s = (wx + speed_m_s * x / away_m, wy + speed_m_s * y / away_m, wz)

    def _let_go(self, index: int, error: int) -> None:
        """A servo shuts down by itself."""
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
            self._let_go(index, OVERHEATING)

    # -- sensors ---------------------------------------------------------------------------------------------------

    def pose(self, position_world_m: Vec3, attitude_wxyz: Quat) -> tuple[Vec3, Quat, bool]:
        """What motion capture makes of the vehicle's pose at an exposure; the third: the body is seen."""
        active = self.active
        pose = (position_world_m, attitude_wxyz)
        if "mocap_freeze" in active:
            if self._frozen is None:
                self._frozen = pose
            pose = self._frozen
        if self._other is not None:
            pose = self._other
        shift_m = self.size("mocap_jump") + self.size("mocap_drag") * (self._now_s - self._drag_began_s)
        if shift_m:
            (x, y, z), attitude = pose
            pose = ((x + _BESIDE[0] * shift_m, y + _BESIDE[1] * shift_m, z), attitude)
        return (*pose, "mocap_occluded" not in active)

    def mocap_period_s(self, usual_s: float) -> float:
        """From one exposure to the next."""
        slow = self.active.get("mocap_rate")
        return usual_s if slow is None else max(usual_s, 1.0 / slow.magnitude)

    def size(self, kind: FaultKind) -> float:
        """Of the fault of that kind that acts now; 0: none does."""
        fault = self.active.get(kind)
        return 0.0 if fault is None else fault.magnitude

    def server_clock_s(self, t_s: float) -> float:
        """What the motion-capture machine's clock showed at a world time."""
        return t_s + self.size("clock_step") if t_s >= self._stepped_s else t_s

    def wrench(self, force_n: Vec3, torque_nm: Vec3) -> tuple[Vec3, Vec3]:
        """What the force sensor reads instead."""
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
        """One more transaction on the servo bus, and this is its fate."""
        share = self.size("bus_noise")
        return share > 0.0 and float(self._chance.random()) < share


@dataclasses.dataclass(frozen=True, slots=True)
class Sample:
    """Where the machine truly was, for a campaign's table."""

    t_s: float
    position_world_m: Vec3
    tilt_rad: float
    slack_m: float
    """Of the tether as long as it is now."""
    tension_n: float


def sample(world: World, anchor_world_m: Vec3) -> Sample:
    """The world as it is now."""
    x, y, z, *attitude = world.q[0:7]
    slack_m = world.tether_length_m - math.dist(world.attachment_world_m, anchor_world_m)
    tension_n = world.sensors()[world.layout.tether]
    return Sample(
        world.t_s, (x, y, z), tilt_rad((attitude[0], attitude[1], attitude[2], attitude[3])), slack_m, tension_n
    )
