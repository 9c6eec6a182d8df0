"""Inputs that a test makes up tick by tick behind a recorded flight, and an account of what must hold for every stop of the rotors.

The account knows nothing of `companion.safety.rotor_stop`: its numbers are those of docs/internals/safety.md.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections import Counter, deque
from functools import cache

import msgspec

from companion.core.flight_core import FlightCore
from companion.model.frames import quat_from_euler_zyx
from companion.model.outputs import Outputs
from companion.model.types import (
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    Inputs,
    LandedState,
    MocapPose,
    Quat,
    VehicleState,
)
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.support import HOVER

STEP_S = 0.02
LOW_M, STILL_M = 0.25, 0.05
DISARM_S, FORCE_S, FLIPPED_S, TIPPED_S = 0.35, 4.0, 0.3, 0.5
UPRIGHT: Quat = (1.0, 0.0, 0.0, 0.0)
ON_ITS_BACK = quat_from_euler_zyx(math.radians(178.0), 0.0, 0.0)
ON_ITS_ROTORS = quat_from_euler_zyx(math.radians(-55.0), 0.0, 0.0)
"""Tipped over: it rests on two feet and a rotor."""
STOPS = (AutopilotRequest.DISARM, AutopilotRequest.FORCE_DISARM)
TICKS = (0, 1, 20, 100)
"""Numbers of ticks in a phase after which `begun` has the flight."""
LOW_HOVER = ("mission.phases[0].height_m=0.5", "mission.phases[0].duration_s=2.0", "mission.phases[1].duration_s=1.0")
replace = msgspec.structs.replace


class Deaf:
    """A land detector that never notices that an armed vehicle stands."""

    landed = maybe_landed = ground_contact = False

    def update(self, *arguments: object, **_: object) -> None:
        self.landed = self.maybe_landed = self.ground_contact = not arguments[1]  # [1]: armed


@dataclasses.dataclass(frozen=True)
class Begun:
    """Inputs of a flight in some phase, and a core that has just stepped with them."""

    core: FlightCore
    inputs: Inputs
    standing_m: float

    def fork(self) -> tuple[FlightCore, Inputs]:
        return copy.deepcopy(self.core), self.inputs


@cache
def _begun() -> dict[tuple[str, int], Begun]:
    """Return a low hover flight, PX4's land detector deaf, some ticks into each of its phases."""
    flight, found, ticks = FastFlight(load_sitl(HOVER, overrides=LOW_HOVER)), {}, Counter[str]()
    flight.px4.land = Deaf()  # type: ignore[assignment]
    result = FastResult()
    for o in flight.ticks(result):
        if ticks[o.phase] in TICKS:
            standing_m = flight.config.vehicle.airframe.ground_clearance_m
            found[o.phase, ticks[o.phase]] = Begun(copy.deepcopy(flight.core), result.inputs[-1], standing_m)
        ticks[o.phase] += 1
    return found


def begun(phase: str, ticks: int) -> Begun:
    """Return a low hover flight, PX4's land detector deaf, after so many ticks in a phase."""
    return _begun()[phase, ticks]


@dataclasses.dataclass
class Machine:
    """What the inputs say of the vehicle from now on."""

    i: Inputs
    floor_m: float
    position: tuple[float, float, float] = ()  # type: ignore[assignment]
    """In the world; where motion capture saw it last, if it is not given."""
    mode: FlightMode = FlightMode.OFFBOARD
    landed: LandedState = LandedState.IN_AIR
    armed: bool = True
    up_m_s: float = 0.0
    aside_m_s: float = 0.0
    attitude: Quat = UPRIGHT
    mocap_attitude: Quat | None = None
    """None: as PX4's."""
    seen: bool = True
    """By motion capture."""
    feels_m_s2: float = 9.81
    """Along body z."""
    system_status: int = 4

    def __post_init__(self) -> None:
        if not self.position:
            assert self.i.mocap is not None
            self.position = self.i.mocap.position_world_m

    def tick(self, dt_s: float = STEP_S) -> Inputs:
        """The next inputs."""
        before, t_s = self.i, self.i.t_s + dt_s
        x, y, z = self.position
        self.position = (x + self.aside_m_s * dt_s, y, max(self.floor_m, z + self.up_m_s * dt_s))
        velocity = (self.aside_m_s, 0.0, (self.position[2] - z) / dt_s)
        pose = before.mocap
        if self.seen:
            number = 0 if pose is None else pose.frame_number + 1
            pose = MocapPose(
                stamp_s=t_s,
                latency_s=0.005,
                frame_number=number,
                position_world_m=self.position,
                attitude_wxyz=self.mocap_attitude or self.attitude,
                tracking_valid=True,
                marker_error_m=0.0002,
            )
        old = before.vehicle
        assert old is not None and before.arm is not None and before.force is not None
        # Nothing repeats itself to the last bit: that is a fault of its own.
        jitter = 1e-5 * ((before.tick * 7) % 11 - 5)
        vehicle = VehicleState(
            position_stamp_s=t_s,
            attitude_stamp_s=t_s,
            imu_stamp_s=t_s,
            position_world_m=(self.position[0] + jitter, *self.position[1:]),
            velocity_world_m_s=velocity,
            attitude_wxyz=self.attitude,
            angular_rate_body_rad_s=(jitter, jitter, jitter),
            specific_force_body_m_s2=(jitter, jitter, self.feels_m_s2),
        )
        status = AutopilotStatus(
            heartbeat_stamp_s=t_s,
            armed=self.armed,
            mode=self.mode,
            landed=self.landed,
            battery_voltage_v=15.8,
            battery_remaining=0.9,
            system_status=self.system_status,
        )
        self.i = replace(
            before,
            tick=before.tick + 1,
            t_s=t_s,
            vehicle=vehicle,
            status=status,
            mocap=pose,
            arm=replace(before.arm, stamp_s=t_s),
            force=replace(before.force, stamp_s=t_s, force_sensor_n=(jitter, jitter, jitter)),
        )
        return self.i


class Account:
    """What was true in every tick so far, and whether that allows a request."""

    def __init__(self, standing_m: float) -> None:
        self._low_m = standing_m + LOW_M
        self._seen: deque[tuple[float, Inputs]] = deque()

    def take(self, i: Inputs) -> None:
        self._seen.append((i.t_s, i))
        while self._seen and self._seen[0][0] < i.t_s - FORCE_S - 1.0:
            self._seen.popleft()

    def objection(self, request: AutopilotRequest) -> str | None:
        """Why this request must not leave now; None: it may."""
        if request not in STOPS:
            return None
        force = request is AutopilotRequest.FORCE_DISARM
        if force and (self._flipped() or self._tipped()):
            return None
        window_s = FORCE_S if force else DISARM_S
        now_s = self._seen[-1][0]
        past = [i for t_s, i in self._seen if t_s >= now_s - window_s - 1e-6]
        if past[0].t_s > now_s - window_s + 1.5 * STEP_S:
            return "it has not been watched for long enough"
        for i in past:
            status = i.status
            assert status is not None
            if not status.armed or status.mode not in (FlightMode.OFFBOARD, FlightMode.LAND):
                return f"{status.mode} at {i.t_s:.2f} s, {now_s - i.t_s:.2f} s ago"
            pose = i.mocap if i.mocap is not None and i.t_s - i.mocap.stamp_s < 0.3 else None
            heights = [record.position_world_m[2] for record in (pose, i.vehicle) if record is not None]
            if not heights or max(heights) >= self._low_m:
                return f"at {heights} m {now_s - i.t_s:.2f} s ago"
        # Where it was by PX4: motion capture may have been away.
        places = [i.vehicle.position_world_m for i in past if i.vehicle is not None]
        moved_m = max(math.dist(places[0], place) for place in places)
        if moved_m > 2.0 * STILL_M:
            return f"it has moved by {moved_m:.2f} m"
        return None

    def _flipped(self) -> bool:
        now_s = self._seen[-1][0]
        past = [i for t_s, i in self._seen if t_s >= now_s - FLIPPED_S + 1.5 * STEP_S]
        return all(_upside_down(i) for i in past) and self._seen[0][0] <= now_s - FLIPPED_S + 1.5 * STEP_S

    def _tipped(self) -> bool:
        now_s = self._seen[-1][0]
        past = [i for t_s, i in self._seen if t_s >= now_s - TIPPED_S + 1.5 * STEP_S]
        tipped = all(_lies_tilted(i, self._low_m) for i in past)
        return tipped and self._seen[0][0] <= now_s - TIPPED_S + 1.5 * STEP_S


def _lies_tilted(i: Inputs, low_m: float) -> bool:
    """Rolled by more than 40 deg by both, and low: the numbers of `safety.tilt_abort_deg` and docs/internals/safety.md."""
    assert i.vehicle is not None and i.status is not None
    ours = i.status.armed and i.status.mode in (FlightMode.OFFBOARD, FlightMode.LAND)
    pose = i.mocap if i.mocap is not None and i.t_s - i.mocap.stamp_s < 0.3 else None
    if pose is None or pose.position_world_m[2] >= low_m or not ours:
        return False
    return min(abs(pose.attitude_wxyz[1]), abs(i.vehicle.attitude_wxyz[1])) > math.sin(math.radians(20.0))


def _upside_down(i: Inputs) -> bool:
    assert i.vehicle is not None and i.status is not None
    pilot = i.status.mode is FlightMode.MANUAL
    seen_so = i.mocap is not None and abs(i.mocap.attitude_wxyz[1]) > 0.6
    confirmed = seen_so or i.vehicle.specific_force_body_m_s2[2] < 3.0  # a pose that contradicts PX4 is not believed
    return not pilot and abs(i.vehicle.attitude_wxyz[1]) > 0.6 and confirmed


def walked(core: FlightCore, machine: Machine, ticks: int, account: Account | None = None) -> list[Outputs]:
    """Ticks with the machine as it is; an objection fails."""
    outputs = []
    for _ in range(ticks):
        i = machine.tick()
        o = core.step(i)
        outputs.append(o)
        if account is not None:
            account.take(i)
            objection = account.objection(o.request)
            assert objection is None, (o.request, o.phase, objection)
    return outputs
