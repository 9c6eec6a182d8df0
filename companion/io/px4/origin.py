"""Global origin for a vehicle without GPS.

PX4 considers its global position valid only with an origin; with one, HOLD, RETURN and LAND work on motion capture alone. The origin is
latitude 0, longitude 0, altitude 0, because EKF2 without GPS has placed local (0, 0, 0) there by itself: the local position does not
move, whether vision is fused already or not. Any other origin shifts the local position (measured on PX4 1.16.1 with 47.4 deg N, 8.5
deg E, 488 m). If it is set before vision is fused, LOCAL_POSITION_NED is off by thousands of kilometres until fusion starts, and z
stays off by 488 m. If it is set during fusion, the filter resets and its innovation ratio rises to 2.
"""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from typing import Any

from mavsdk import MavsdkError
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkDirect, MavlinkMessage

from companion.io.px4.calls import NATIVE_CALL_DEADLINE_S, NativeCalls
from companion.io.px4.link import device_error
from companion.io.px4.messages import GPS_GLOBAL_ORIGIN_ID, refusal, request_message_json

ORIGIN_LATITUDE_DEG = 0.0
ORIGIN_LONGITUDE_DEG = 0.0
ORIGIN_ALTITUDE_M = 0.0


def set_origin_json(system_id: int) -> str:
    """Return SET_GPS_GLOBAL_ORIGIN for a system. The altitude is in mm, the angles in 1e-7 deg."""
    return json.dumps(
        {
            "target_system": system_id,
            "latitude": round(ORIGIN_LATITUDE_DEG * 1e7),
            "longitude": round(ORIGIN_LONGITUDE_DEG * 1e7),
            "altitude": round(ORIGIN_ALTITUDE_M * 1e3),
            "time_usec": 0,
        }
    )


async def ensure_origin(
    address: str, calls: NativeCalls, direct: MavlinkDirect, system_id: int, armed: Callable[[], Awaitable[bool]]
) -> bool:
    """Set PX4's origin unless it has one or is armed. Return whether PX4 reports an origin.

    PX4 reports its origin only while its position is valid, so right after boot, before any vision, the result is False although the
    origin was accepted. Sending the same origin again has no effect.

    Raises:
        DeviceError: PX4 does not answer at all.
    """
    if await _has_origin(address, calls, direct, system_id):
        return True
    if await armed():
        return False  # moving the origin in flight is worse than having none
    direct.send_message(MavlinkMessage("SET_GPS_GLOBAL_ORIGIN", fields_json=set_origin_json(system_id)))
    return await _has_origin(address, calls, direct, system_id)


async def _has_origin(address: str, calls: NativeCalls, direct: Any, system_id: int) -> bool:
    expected = "PX4 to report whether it has a global origin"
    command = MavlinkMessage("COMMAND_LONG", fields_json=request_message_json(GPS_GLOBAL_ORIGIN_ID, system_id))
    try:
        ack = await calls.run(expected, NATIVE_CALL_DEADLINE_S, direct.send_command, command)
    except MavsdkError as error:
        raise device_error(address, expected, str(error).split(";")[0], "check the link") from None
    # PX4 sends the message before it accepts the request, and denies the request if it has no origin.
    return refusal(ack.fields_json) is None
