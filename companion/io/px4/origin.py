"""Global origin for a vehicle without GPS.

PX4 considers its global position valid only with an origin; with one, HOLD, RETURN and LAND work on motion capture alone. The origin is
latitude 0, longitude 0, altitude 0, because EKF2 without GPS has placed local (0, 0, 0) there by itself: the local position does not
move, whether vision is fused already or not. Any other origin shifts the local position (measured on PX4 1.16.1 with 47.4 deg N, 8.5
deg E, 488 m). If it is set before vision is fused, LOCAL_POSITION_NED is off by thousands of kilometres until fusion starts, and z
stays off by 488 m. If it is set during fusion, the filter resets and its innovation ratio rises to 2.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4 import messages
from companion.io.px4.questions import Questions

ORIGIN_LATITUDE_DEG = 0.0
ORIGIN_LONGITUDE_DEG = 0.0
ORIGIN_ALTITUDE_M = 0.0


async def ensure_origin(questions: Questions, armed: Callable[[], Awaitable[bool]]) -> bool:
    """Set PX4's origin unless it has one or is armed. Return whether PX4 reports an origin.

    PX4 reports its origin only while its position is valid, so right after boot, before any vision, the result is False although the
    origin was accepted. Sending the same origin again has no effect.

    Raises:
        DeviceError: PX4 does not answer at all.
    """
    if await _has_origin(questions):
        return True
    if await armed():
        return False  # moving the origin in flight is worse than having none
    origin = (ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, ORIGIN_ALTITUDE_M)
    questions.send(*messages.set_global_origin(*origin, questions.system_id))
    return await _has_origin(questions)


async def _has_origin(questions: Questions) -> bool:
    expected = "PX4 to report whether it has a global origin"
    message_id = float(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
    # PX4 sends the message before it accepts the request, and denies the request if it has no origin.
    result = await questions.command(expected, messages.REQUEST_MESSAGE, message_id)
    return result == messages.MAV_RESULT_ACCEPTED
