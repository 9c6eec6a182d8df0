"""A flight depends on the Protocols of `companion.io.protocols` only: here its devices are written in the test."""

from __future__ import annotations

import asyncio
import math
import socket
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from companion.config.loader import FlightConfig, load_flight
from companion.flight.command_queue import Operator
from companion.flight.control_loop import Flight
from companion.flight.fallback_landing import unflown
from companion.io.devices import Devices, PoseForwarder
from companion.model.estimator import EstimatorReport
from companion.model.launcher_messages import Land
from companion.model.markers import MarkerFrame
from companion.model.observations import (
    ArmStatement,
    ForceCounts,
    LinkCounts,
    MocapCounts,
    MocapServer,
    ServoReport,
    StateCounts,
)
from companion.model.team import BarPose, ClampCommand, ClampState, Grip, PartnerState, TeamState
from companion.model.types import (
    IDENTITY_QUAT,
    ArmState,
    AttitudeSetpoint,
    AutopilotRequest,
    AutopilotStatus,
    FlightMode,
    ForceSample,
    Joints,
    LandedState,
    LinkIdentity,
    MocapPose,
    Outcome,
    Vec3,
    VehicleState,
)
from companion.recorder.client import RecorderProcess
from companion.runtime import ipc
from companion.runtime.clock import Clock
from tests.flight.simulated import SimulatedTime, simulated
from tests.support import HOVER, ROOT, level_pose

ZERO = (0.0, 0.0, 0.0)
RECORDED = MocapCounts(
    frames=0, superseded=0, out_of_order=0, malformed=0, foreign=0, problem=None, callback_error=None
)


class Standing:
    """What all devices here know: the machine stands at the mission's start."""

    def __init__(self, config: FlightConfig, clock: Clock) -> None:
        start = config.mission.start
        self.clock = clock
        self.position_m: Vec3 = (*start.position_m, config.vehicle.airframe.ground_clearance_m)
        self.arm_rad: Joints = (math.radians(start.arm_deg[0]), math.radians(start.arm_deg[1]))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass


class ObedientAutopilot(Standing):
    on_armed: Callable[[], object]
    armed = False
    mode = FlightMode.OTHER
    setpoints = 0

    def vehicle(self) -> VehicleState | None:
        now_s = self.clock()
        return VehicleState(
            position_stamp_s=now_s,
            attitude_stamp_s=now_s,
            imu_stamp_s=now_s,
            position_world_m=self.position_m,
            velocity_world_m_s=ZERO,
            attitude_wxyz=IDENTITY_QUAT,
            angular_rate_body_rad_s=ZERO,
            specific_force_body_m_s2=(0.0, 0.0, 9.81),
        )

    def status(self) -> AutopilotStatus | None:
        return AutopilotStatus(
            heartbeat_stamp_s=self.clock(),
            armed=self.armed,
            mode=self.mode,
            landed=LandedState.ON_GROUND,
            battery_voltage_v=16.0,
            battery_remaining=0.9,
        )

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        self.setpoints += setpoint is not None
        return setpoint is not None

    def request(self, request: AutopilotRequest) -> None:
        if request is AutopilotRequest.OFFBOARD:
            self.mode = FlightMode.OFFBOARD
        elif request is AutopilotRequest.ARM:
            self.armed = True
            self.on_armed()
        else:
            self.armed = False

    def start_sums(self) -> None:
        """Has none."""

    def take_messages(self) -> list[str]:
        return []

    def send_vision(self, pose: MocapPose) -> bool:
        raise NotImplementedError

    def estimator(self) -> EstimatorReport | None:
        raise NotImplementedError

    def counts(self) -> StateCounts:
        raise NotImplementedError

    def identity(self) -> LinkIdentity:
        raise NotImplementedError

    async def firmware(self) -> str:
        raise NotImplementedError

    async def read_params(self, names: Iterable[str]) -> dict[str, float | int]:
        raise NotImplementedError

    async def read_param(self, name: str) -> float | int:
        raise NotImplementedError


class OtherMocap(Standing):
    server = MocapServer(name="another system", protocol_version="1")
    frame = 0

    @property
    def bodies(self) -> dict[int, str]:
        return {}

    def counts(self) -> MocapCounts:
        return RECORDED

    def markers(self) -> MarkerFrame | None:
        return None

    def bar(self) -> BarPose | None:
        return None

    def latest(self) -> MocapPose | None:
        self.frame += 1
        # No measurement is the same twice: the core would take it for a frozen stream.
        x, y, z = self.position_m
        return level_pose(self.clock(), frame_number=self.frame, position_world_m=(x + 1e-5 * (self.frame % 7), y, z))


class OtherArm(Standing):
    servos: tuple[ServoReport, ...] = ()
    statement: ArmStatement | None = None
    read_takes_s = 0.001

    commanded = 0

    def clamp(self) -> ClampState | None:
        return ClampState(self.clock(), math.radians(90.0))

    def command_clamp(self, command: ClampCommand | None) -> None:
        self.commanded += 1

    def latest(self) -> ArmState | None:
        return ArmState(
            stamp_s=self.clock(),
            angle_rad=self.arm_rad,
            velocity_rad_s=(0.0, 0.0),
            torque_nm=(0.0, 0.0),
            hardware_error=(0, 0),
            temperature_c=(30.0, 30.0),
            read_failures=0,
        )

    def begin_read(self, at_s: float = 0.0) -> None:
        pass

    async def read(self, timeout_s: float) -> ArmState | None:
        return self.latest()

    def write_torque(self, torque_nm: Joints) -> Joints:
        return torque_nm


class OtherForceTorque(Standing):
    product_name, firmware, sample = "another sensor", "", 0

    def read_in_ticks(self) -> None:
        pass

    def counts(self) -> ForceCounts:
        return ForceCounts(samples=self.sample, skipped_bytes=0, bad_sums=0, lost=None)

    def latest(self) -> ForceSample | None:
        self.sample += 1
        return ForceSample(
            stamp_s=self.clock(),
            force_sensor_n=(0.01 * (self.sample % 5), 0.0, 0.0),
            torque_sensor_nm=ZERO,
            overload=False,
        )


class OtherTeam(Standing):
    partner_session = 1

    def __init__(self, config: FlightConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self.announced: list[TeamState] = []

    def announce(self, said: TeamState) -> None:
        self.announced.append(said)

    def newest(self) -> PartnerState | None:
        said = TeamState(grip=Grip.FREE, holds=False, lands=False, px4_lands=False, position_world_m=(9.0, 0.0, 1.0))
        return PartnerState(stamp_s=self.clock(), said=said)

    def counts(self) -> LinkCounts:
        return LinkCounts()


@pytest.mark.parametrize("in_a_team", [False, True])
def test_a_flight_with_devices_of_another_make_arms_and_lands(tmp_path: Path, in_a_team: bool) -> None:
    clamp = ROOT / "configs/vehicles/tarot650_2r_clamp.yaml" if in_a_team else None
    overrides = ["vehicle.devices.team={}", "vehicle.tether=null"] if in_a_team else []
    config = unflown(load_flight(HOVER, clamp, overrides=overrides))
    launcher, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    channel.setblocking(False)

    time = SimulatedTime()

    def clock() -> float:
        return time.now_s

    autopilot, arm = ObedientAutopilot(config, clock), OtherArm(config, clock)
    team = OtherTeam(config, clock) if in_a_team else None
    autopilot.on_armed = lambda: ipc.send(launcher, Land())
    devices = Devices(
        forwarder=PoseForwarder(),
        autopilot=autopilot,
        mocap=OtherMocap(config, clock),
        arm=arm,
        force=OtherForceTorque(config, clock),
        team=team,
    )

    async def flown(loop: asyncio.AbstractEventLoop, time: SimulatedTime) -> Outcome:
        operator = Operator(channel)
        with operator.attention():
            return await Flight(config, devices, recorder, channel, operator, clock, None).run()

    with launcher, channel:
        recorder = RecorderProcess.start(tmp_path / "a.mcap", config_json=config.model_dump_json(), epoch_offset_ns=0)
        try:
            assert simulated(flown, time) is Outcome.ABORTED
        finally:
            recorder.finish()
    assert autopilot.mode is FlightMode.OFFBOARD and autopilot.setpoints > 0 and not autopilot.armed
    assert arm.commanded > 0
    assert team is None or team.announced[-1].position_world_m == autopilot.position_m
