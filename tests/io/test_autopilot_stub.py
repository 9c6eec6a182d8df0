"""The MAVSDK edge against the PX4 stub: the stub's rules decide, the edge only asks."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from companion.clock import Clock, flight_clock
from companion.config.vehicle import AutopilotDevice
from companion.frames import quat_from_euler_zyx
from companion.io.autopilot import MavsdkAutopilot
from companion.types import AttitudeSetpoint, AutopilotRequest, AutopilotStatus, FlightMode, LandedState, MocapPose
from sitl.autopilot.autopilot import Px4Stub, gains_from_params
from sitl.autopilot.cascade import Cascade
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.mavlink import MavlinkServer, Ports
from sitl.autopilot.params import Params
from sitl.autopilot.types import ImuSample
from tests.io.autopilot_peer import free_udp_port

POSITION_WORLD_M = (-1.0, 0.5, 0.25)
YAW_RAD = 0.4
STEP_S = 0.004


@asynccontextmanager
async def standing_stub(port: int) -> AsyncIterator[Px4Stub]:
    """PX4 on the floor, in real time: an IMU at rest at 250 Hz. What it does with its rotors moves nothing."""
    params = Params()
    stub = Px4Stub(params, Estimator(), Cascade(gains_from_params(params)))
    loop = asyncio.get_running_loop()
    start_s = loop.time()

    async def run() -> None:
        steps = 0
        while True:
            # Catches up after a stall: world time follows the wall, sample by sample.
            while steps * STEP_S <= loop.time() - start_s:
                stub.step(ImuSample(steps * STEP_S, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)))
                steps += 1
            server.pump(stub.t_s)
            await asyncio.sleep(STEP_S)

    async with MavlinkServer(stub, Ports(0, port)) as server, asyncio.TaskGroup() as group:
        running = group.create_task(run())
        try:
            yield stub
        finally:
            running.cancel()


class Companion:
    """The sending half of a flight: mocap and a setpoint with little thrust at 100 Hz, and one standing request."""

    def __init__(self, autopilot: MavsdkAutopilot, clock: Clock) -> None:
        self.autopilot = autopilot
        self.request = AutopilotRequest.NONE
        self.said: list[str] = []
        self._clock = clock

    async def run(self) -> None:
        number = 0
        attitude = quat_from_euler_zyx(0.0, 0.0, YAW_RAD)
        while True:
            pose = MocapPose(self._clock(), 0.003, number, POSITION_WORLD_M, attitude, True, 0.0)
            assert self.autopilot.send_vision(pose)
            assert self.autopilot.send_attitude(AttitudeSetpoint(attitude, 0.1))
            self.autopilot.request(self.request)
            self.said += self.autopilot.take_messages()
            number += 1
            await asyncio.sleep(0.01)

    async def until(self, done: Callable[[AutopilotStatus], bool], what: str, deadline_s: float = 30.0) -> None:
        try:
            async with asyncio.timeout(deadline_s):
                while (status := self.autopilot.status()) is None or not done(status):  # noqa: ASYNC110 - MAVSDK's threads
                    await asyncio.sleep(0.01)
        except TimeoutError:
            pytest.fail(f"not within {deadline_s} s: {what}; said: {self.said}; status: {self.autopilot.status()}")


@asynccontextmanager
async def companion(port: int) -> AsyncIterator[Companion]:
    clock = flight_clock()
    device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=20.0)
    async with MavsdkAutopilot(device, clock) as autopilot, asyncio.TaskGroup() as group:
        half = Companion(autopilot, clock)
        running = group.create_task(half.run())
        try:
            yield half
        finally:
            running.cancel()


def test_a_flight_on_the_floor_offboard_arm_land_disarm() -> None:
    async def fly() -> None:
        port = free_udp_port()
        async with standing_stub(port), companion(port) as half:
            vehicle = half.autopilot.vehicle
            await half.until(
                lambda _: (
                    (state := vehicle()) is not None
                    and state.position_world_m == pytest.approx(POSITION_WORLD_M, abs=0.02)
                    and state.attitude_wxyz == pytest.approx(quat_from_euler_zyx(0.0, 0.0, YAW_RAD), abs=0.02)
                ),
                "vision fused: PX4's pose is the one that mocap told, in the companion's frames",
            )
            state = vehicle()
            assert state is not None
            assert state.specific_force_body_m_s2 == pytest.approx((0.0, 0.0, 9.81), abs=1e-3)
            for request, done in (
                (AutopilotRequest.OFFBOARD, lambda status: status.mode is FlightMode.OFFBOARD),
                (AutopilotRequest.ARM, lambda status: status.armed),
                (AutopilotRequest.LAND, lambda status: status.mode is FlightMode.LAND),
                (AutopilotRequest.DISARM, lambda status: not status.armed),
            ):
                half.request = request
                await half.until(done, request.name)
            half.request = AutopilotRequest.NONE
            await half.until(lambda status: status.landed is LandedState.ON_GROUND, "on the ground")
            # The stub disarms only once its land detector is sure; until then it says so, and is asked again.
            assert set(half.said) <= {"DISARM refused: temporarily rejected (MAV_RESULT 1)"}

    asyncio.run(fly())


def test_arming_without_a_setpoint_stream_is_refused_and_said() -> None:
    async def fly() -> None:
        port = free_udp_port()
        device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=20.0)
        async with standing_stub(port) as stub, MavsdkAutopilot(device, flight_clock()) as autopilot:
            said: list[str] = []
            async with asyncio.timeout(30.0):
                while not said:
                    autopilot.request(AutopilotRequest.ARM)
                    said += autopilot.take_messages()
                    await asyncio.sleep(0.01)
            assert said[0].startswith("ARM refused: ")
            assert not stub.armed

    asyncio.run(fly())


def test_parameters_and_firmware_of_the_stub() -> None:
    async def fly() -> None:
        port = free_udp_port()
        device = AutopilotDevice(address=f"udpin://127.0.0.1:{port}", discovery_timeout_s=20.0)
        async with standing_stub(port) as stub, MavsdkAutopilot(device, flight_clock()) as autopilot:
            for name in ("COM_OF_LOSS_T", "EKF2_EV_CTRL"):
                value = await autopilot.read_param(name)
                assert value == pytest.approx(stub.params[name])
                assert type(value) is type(stub.params[name])
            assert (await autopilot.firmware()).startswith("PX4 1.16.1 release")

    asyncio.run(fly())


def test_the_streams_come_as_fast_as_they_were_asked() -> None:
    async def fly() -> None:
        port = free_udp_port()
        async with standing_stub(port), companion(port) as half:
            await half.until(lambda _: half.autopilot.vehicle() is not None, "a complete vehicle state")
            first = half.autopilot.vehicle()
            assert first is not None
            stamps = {first.imu_stamp_s}
            async with asyncio.timeout(60.0):
                while len(stamps) < 200:
                    state = half.autopilot.vehicle()
                    assert state is not None
                    stamps.add(state.imu_stamp_s)
                    await asyncio.sleep(0.001)
            # PX4's default for HIGHRES_IMU is 50 Hz; loose, as the machine may be loaded.
            assert min(b - a for a, b in zip(sorted(stamps), sorted(stamps)[1:], strict=False)) < 0.015

    asyncio.run(fly())
