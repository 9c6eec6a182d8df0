"""The MAVSDK edge against the PX4 stub: the stub's rules decide, the edge only asks."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest

from companion.io.px4.driver import MavsdkAutopilot
from companion.model.frames import quat_from_euler_zyx
from companion.model.types import AttitudeSetpoint, AutopilotRequest, AutopilotStatus
from companion.runtime.clock import Clock, flight_clock
from tests.io.stub_rig import standing_stub
from tests.io.test_px4 import edge
from tests.support import eventually, free_udp_port, level_pose

AIDED = 16 | 32 | 256
"""ESTIMATOR_POS_HORIZ_ABS, POS_VERT_ABS, PRED_POS_HORIZ_REL"""
POSITION_WORLD_M = (-1.0, 0.5, 0.25)
YAW_RAD = 0.4


class Companion:
    """The sending half of a flight: mocap and a setpoint with little thrust at 100 Hz, and one standing request."""

    def __init__(self, autopilot: MavsdkAutopilot, clock: Clock) -> None:
        self.autopilot = autopilot
        self.request = AutopilotRequest.NONE
        self.reports: list[str] = []
        self._clock = clock

    async def run(self) -> None:
        number = 0
        attitude = quat_from_euler_zyx(0.0, 0.0, YAW_RAD)
        while True:
            now_s = self._clock()
            pose = level_pose(now_s, frame_number=number, position_world_m=POSITION_WORLD_M, attitude_wxyz=attitude)
            assert self.autopilot.send_vision(pose)
            assert self.autopilot.send_attitude(AttitudeSetpoint(attitude, 0.1))
            self.autopilot.request(self.request)
            self.reports += self.autopilot.take_messages()
            number += 1
            await asyncio.sleep(0.01)

    async def until(self, done: Callable[[AutopilotStatus], bool], what: str, deadline_s: float = 30.0) -> None:
        try:
            async with asyncio.timeout(deadline_s):
                while (status := self.autopilot.status()) is None or not done(status):  # noqa: ASYNC110 - MAVSDK's threads
                    await asyncio.sleep(0.01)
        except TimeoutError:
            pytest.fail(
                f"not within {deadline_s} s: {what}; reports: {self.reports}; status: {self.autopilot.status()}"
            )


@asynccontextmanager
async def companion(port: int) -> AsyncIterator[Companion]:
    clock = flight_clock()
    async with edge(port, clock) as autopilot, asyncio.TaskGroup() as group:
        half = Companion(autopilot, clock)
        running = group.create_task(half.run())
        try:
            yield half
        finally:
            running.cancel()


async def test_the_stub_without_a_setpoint_stream_or_mocap() -> None:
    port = free_udp_port()
    async with standing_stub(port) as stub, edge(port) as autopilot:
        assert stub.origin is not None
        assert not await autopilot.ensure_origin()  # PX4 tells only with a valid position
        await eventually(lambda: autopilot.estimator() is not None, "ESTIMATOR_STATUS")
        report = autopilot.estimator()
        assert report is not None
        assert report.flags & (1 | 128 | AIDED) == 1 | 128  # attitude, constant position
        assert (report.position_horizontal_ratio, report.position_vertical_ratio) == (0.0, 0.0)

        assert (await autopilot.firmware()).startswith("PX4 1.16.1 release")
        stub.params.set("BAT1_CAPACITY", -1.0)
        read = await autopilot.read_params([*stub.params, "MAV_1_CONFIG"])
        assert read == {name: stub.params[name] for name in stub.params}
        assert all(type(read[name]) is type(stub.params[name]) for name in read)
        assert await autopilot.write_param("COM_OF_LOSS_T", 0.3) == pytest.approx(0.3)
        assert await autopilot.write_param("COM_FLTMODE1", -1) == -1
        assert stub.params.real("COM_OF_LOSS_T") == pytest.approx(0.3)

        reports: list[str] = []

        def refused_in_px4s_words() -> bool:
            autopilot.request(AutopilotRequest.ARM)
            reports.extend(autopilot.take_messages())
            return len(set(reports)) >= 2

        await eventually(refused_in_px4s_words, "arming is refused")
        assert set(reports) == {
            "ARM refused: temporarily rejected (MAV_RESULT 1)",
            "critical: Arming denied: Resolve system health failures first",
        }
        assert not stub.armed

        def climbed_m_s() -> float:
            state = autopilot.vehicle()
            return state.delta_velocity_body_m_s[2] if state and state.delta_velocity_body_m_s else 0.0

        # The first tick read the sum of the seconds before it, the second one the new sum: a kick of -38 m/s, and `mocap_dragged`.
        await eventually(lambda: climbed_m_s() > 10.0, "a second of gravity")
        autopilot.start_sums()
        assert climbed_m_s() < 1.0
