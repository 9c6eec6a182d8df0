"""The PX4 stub on the floor, alone behind its MAVLink port."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager

from sitl.autopilot.autopilot import Px4Stub
from sitl.autopilot.cascade import Cascade, gains_from_params
from sitl.autopilot.estimator import Estimator
from sitl.autopilot.mavlink import MavlinkServer, Ports
from sitl.autopilot.params import Params
from sitl.autopilot.types import ImuSample

STEP_S = 0.004


@asynccontextmanager
async def standing_stub(port: int, overrides: Mapping[str, float | int] | None = None) -> AsyncIterator[Px4Stub]:
    """PX4 on the floor, in real time: an IMU at rest at 250 Hz. What it does with its rotors moves nothing."""
    params = Params(overrides)
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
