"""A MAVSDK 4 script for PX4 that uses nothing of this repository.

Arms, takes off, goes offboard with position and then with attitude setpoints, lands, waits for the automatic disarm. One line of JSON
per step goes to stdout. Usage: python mavsdk_mission.py CONNECTION_URL
"""

import asyncio
import json
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.offboard import Attitude, OffboardAsync, PositionNedYaw
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync


def say(step: str, **values: Any) -> None:
    print(json.dumps({"step": step, **values}), flush=True)


async def until(
    stream: AsyncIterator[Any], condition: Callable[[Any], bool], what: str, timeout_s: float = 60.0
) -> Any:
    async def search() -> Any:
        async for value in stream:
            if condition(value):
                return value
        raise RuntimeError(f"the stream ended before: {what}")

    try:
        return await asyncio.wait_for(search(), timeout_s)
    except TimeoutError:
        raise RuntimeError(f"not within {timeout_s} s: {what}") from None


async def main(url: str) -> None:
    drone = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await drone.add_any_connection(url)
    system = await drone.first_autopilot(20.0)
    if system is None:
        raise RuntimeError("no autopilot")
    action, telemetry, offboard, param, info = (
        kind(system) for kind in (ActionAsync, TelemetryAsync, OffboardAsync, ParamAsync, InfoAsync)
    )
    say("connected")
    version = await info.get_version()
    say("version", major=version.flight_sw_major, minor=version.flight_sw_minor)

    hover = await param.get_param_float("MPC_THR_HOVER")
    await param.set_param_int("COM_OBL_RC_ACT", 5)
    changed = await param.get_param_int("COM_OBL_RC_ACT")
    everything = await param.get_all_params()
    say("params", hover=hover, changed=changed, count=len(everything.int_params) + len(everything.float_params))

    await action.set_gps_global_origin(47.397742, 8.545594, 488.0)
    await until(telemetry.subscribe_health(), lambda h: h.is_home_position_ok, "home position")
    await telemetry.set_rate_position_velocity_ned(50.0)
    await action.set_takeoff_altitude(1.2)
    await action.arm()
    await until(telemetry.subscribe_armed(), lambda armed: armed, "armed")
    say("armed")
    await action.takeoff()
    await until(telemetry.subscribe_position_velocity_ned(), lambda p: p.position.down_m < -1.0, "1 m of height")
    say("took off")

    await offboard.set_position_ned(PositionNedYaw(0.5, -0.5, -1.2, 0.0))
    await offboard.start()
    there = await until(
        telemetry.subscribe_position_velocity_ned(),
        lambda p: abs(p.position.north_m - 0.5) < 0.1 and abs(p.position.east_m + 0.5) < 0.1,
        "the offboard position",
    )
    say("offboard position", north=there.position.north_m, east=there.position.east_m)

    await offboard.set_attitude(Attitude(-4.0, 0.0, 0.0, hover))
    leaning = await until(telemetry.subscribe_attitude_euler(), lambda a: a.roll_deg < -3.0, "the offboard attitude")
    say("offboard attitude", roll=leaning.roll_deg, active=await offboard.is_active())

    await action.land()
    await until(telemetry.subscribe_armed(), lambda armed: not armed, "the automatic disarm")
    mode = await telemetry.flight_mode()
    say("landed", mode=mode.name)
    drone.destroy()


asyncio.run(main(sys.argv[1]))
