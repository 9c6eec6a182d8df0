"""pymavlink's mavutil, as a ground script uses it, against the PX4 stub: heartbeat, mode name, all parameters, a command."""

from __future__ import annotations

import asyncio
import math
from typing import Any

from pymavlink import mavutil

from sitl.autopilot.mavlink import MavlinkServer, Ports
from tests.sitl.px4_rig import Rig
from tests.support import DEADLINE_S


def ground_script(connection: Any) -> dict[str, Any]:
    """Run mavutil's blocking code; call it in a thread."""
    seen: dict[str, Any] = {}
    beat = connection.wait_heartbeat(timeout=DEADLINE_S)
    assert beat is not None, "no heartbeat"
    seen["autopilot"], seen["type"] = beat.autopilot, beat.type
    seen["mode"] = connection.flightmode
    connection.param_fetch_all()
    while True:
        value = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=DEADLINE_S)
        assert value is not None, f"the list stopped after {len(connection.params)} parameters"
        seen["count"] = value.param_count
        if sum(name != "_HASH_CHECK" for name in connection.params) == value.param_count:
            break
    seen["params"] = {name for name in connection.params if name != "_HASH_CHECK"}
    seen["hover"] = connection.params["MPC_THR_HOVER"]
    connection.arducopter_arm()
    seen["ack"] = connection.recv_match(type="COMMAND_ACK", blocking=True, timeout=DEADLINE_S)
    return seen


async def test_mavutil_sees_the_heartbeat_and_reads_every_parameter() -> None:
    rig = Rig()
    stop = asyncio.Event()
    async with MavlinkServer(rig.stub, Ports(0, 0)) as server:
        connection = mavutil.mavlink_connection(f"udpout:127.0.0.1:{server.onboard_port}", source_system=255)
        try:
            connection.mav.heartbeat_send(6, 8, 0, 0, 4)
            async with asyncio.TaskGroup() as group:
                group.create_task(rig.fly(server, stop))
                try:
                    seen = await asyncio.wait_for(asyncio.to_thread(ground_script, connection), DEADLINE_S)
                finally:
                    stop.set()
        finally:
            connection.close()
    assert seen["autopilot"] == mavutil.mavlink.MAV_AUTOPILOT_PX4
    assert seen["type"] == mavutil.mavlink.MAV_TYPE_QUADROTOR
    assert seen["mode"] == "LOITER"
    assert seen["params"] == set(rig.params)
    assert seen["count"] == len(rig.params)
    assert math.isclose(seen["hover"], 0.5)
    assert seen["ack"].command == mavutil.mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    assert seen["ack"].result == mavutil.mavlink.MAV_RESULT_TEMPORARILY_REJECTED, "no origin: Hold cannot arm"
