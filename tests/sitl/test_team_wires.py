"""One machine of a team behind its wires: the clamp on the servo bus, and the bar in the frames of motion capture."""

from __future__ import annotations

import asyncio
import math

from companion.config.devices import ArmDevice
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.mocap.driver import MocapDriver
from companion.model.team import ClampCommand
from companion.model.types import IDENTITY_QUAT
from companion.runtime.clock import flight_clock
from companion.sitl_config.team import load_team
from companion.sitl_config.world import World
from sitl.mocap import MocapFrame
from sitl.server import Sitl
from sitl.servo.model import ERROR_OVERLOAD
from sitl.wires import MachineWires, Ports
from sitl.world.start import start_of
from tests.support import DEADLINE_S, ROOT

BAR = ((0.5, -0.25, 1.5), (0.6, 0.0, 0.0, 0.8))


def machine(world: World | None = None) -> Sitl:
    config = load_team(ROOT / "configs/teams/carry.yaml").members[0][1]
    start = config.mission.start
    at = start_of(start.position_m, start.yaw_deg, start.arm_deg)
    return Sitl([MachineWires(config.vehicle, world or config.world, at, Ports(), lambda _: None)])


async def test_the_clamp_on_the_servo_bus_closes_and_opens_the_jaws_of_the_world() -> None:
    server = machine()
    vehicle = server.machines[0].vehicle
    async with server.wires() as (devices,):
        device = ArmDevice(port=devices["arm"]["port"], baud=vehicle.arm_device.baud)
        server._step()
        async with DynamixelArm(device, vehicle.arm, flight_clock(), vehicle.jaws) as arm:
            jaws = server.machines[0].plant.jaws
            assert jaws is not None and vehicle.jaws is not None

            async def moved(command: ClampCommand, angle_deg: float) -> None:
                arm.command_clamp(command)
                while (state := arm.clamp()) is None or abs(math.degrees(state.angle_rad) - angle_deg) > 2.0:
                    server._step()
                    await arm.read(1.0)
                assert abs(math.degrees(jaws.angle_rad) - angle_deg) < 3.0 and not jaws.closed  # around a handle

            await asyncio.wait_for(moved(ClampCommand.CLOSE, vehicle.jaws.empty_deg), DEADLINE_S)
            await asyncio.wait_for(moved(ClampCommand.OPEN, vehicle.jaws.open_deg), DEADLINE_S)


async def test_the_fault_of_the_clamp_is_a_hardware_error_on_the_servo_bus() -> None:
    server = machine(World.model_validate({"faults": [{"kind": "clamp_overload", "after": "start", "t_s": 0.02}]}))
    vehicle = server.machines[0].vehicle
    async with server.wires() as (devices,):
        device = ArmDevice(port=devices["arm"]["port"], baud=vehicle.arm_device.baud)
        server._step()
        async with DynamixelArm(device, vehicle.arm, flight_clock(), vehicle.jaws) as arm:
            async with asyncio.timeout(DEADLINE_S):
                while (state := arm.clamp()) is None or state.hardware_error != ERROR_OVERLOAD:
                    server._step()
                    await arm.read(1.0)


async def test_the_bar_of_a_frame_is_streamed_with_the_id_of_the_vehicle_file() -> None:
    server = machine()
    async with server.wires() as (devices,):
        device = server.machines[0].vehicle.devices.mocap.model_copy(update=devices["mocap"])
        assert device.bar_id is not None

        async def publish() -> None:
            while True:
                t_s = server.machines[0].plant.t_s
                frame = MocapFrame(0, t_s - 0.004, (0.0, 0.0, 1.0), IDENTITY_QUAT, True, 0.001, bar=BAR)
                server._publish(frame, t_s)
                server._step()
                await asyncio.sleep(0.001)

        streaming = asyncio.create_task(publish())
        try:
            async with MocapDriver(device, flight_clock(), lambda _: None, connect_timeout_s=DEADLINE_S) as driver:
                async with asyncio.timeout(DEADLINE_S):
                    while (bar := driver.bar()) is None:  # noqa: ASYNC110 - the driver has no event for it
                        await asyncio.sleep(0.001)
                assert driver.bodies[device.bar_id] in ("bar", "")
        finally:
            streaming.cancel()
    assert bar.tracking_valid
    assert math.dist(bar.position_world_m, BAR[0]) < 1e-6
    assert math.dist(bar.attitude_wxyz, BAR[1]) < 1e-6
