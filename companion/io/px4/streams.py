"""Requests the streams of PX4 that the companion reads, and stops the others."""

from __future__ import annotations

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4 import messages
from companion.io.px4.link import device_error
from companion.io.px4.questions import Questions

POSITION_RATE_HZ = 200.0
"""Requested rate of LOCAL_POSITION_NED; PX4 delivers about 124 Hz."""
ATTITUDE_RATE_HZ = 250.0
"""Requested rate of ATTITUDE_QUATERNION, which also carries the angular rates."""
IMU_RATE_HZ = 250.0
LANDED_RATE_HZ = 10.0
ESTIMATOR_RATE_HZ = 5.0
HEARTBEAT_ASK_PERIOD_S = 0.1
"""Period at which HEARTBEAT, which PX4 sends once per second, is requested while PX4 is armed."""
_DEFAULT_RATE, _STOP = 0.0, -1.0
"""Intervals of MAV_CMD_SET_MESSAGE_INTERVAL."""


async def ask_for_streams(questions: Questions, estimator_rate_hz: float = ESTIMATOR_RATE_HZ) -> None:
    """Request every stream that `Inbox` stores, at its rate.

    Raises:
        DeviceError: PX4 refused one, or did not answer.
    """
    for message_id, rate_hz in (
        (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, POSITION_RATE_HZ),
        (mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, ATTITUDE_RATE_HZ),
        (mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, IMU_RATE_HZ),
        (mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, LANDED_RATE_HZ),
        (mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS, estimator_rate_hz),
    ):
        expected = f"PX4 to stream {mavlink.mavlink_map[message_id].msgname} at {rate_hz:g} Hz"
        interval_us = 1e6 / rate_hz
        result = await questions.command(expected, messages.SET_MESSAGE_INTERVAL, float(message_id), interval_us)
        if result != messages.MAV_RESULT_ACCEPTED:
            fix = "check the link's bandwidth (MAV_x_RATE, baud) and that it is an onboard-mode MAVLink instance"
            raise device_error(questions.address, expected, messages.result_text(result), fix)


def stop_unread_streams(questions: Questions, *, forwarded: bool) -> None:
    """Stop the streams of PX4's onboard mode that the companion does not read, 250 messages a second, which cost processor time. A
    ground station behind the link reads them: with `forwarded` they get PX4's default rates again. PX4 may lack one; answers are
    ignored.
    """
    interval_us = _DEFAULT_RATE if forwarded else _STOP
    for message_id in messages.UNREAD_IDS:
        command = (messages.SET_MESSAGE_INTERVAL, float(message_id), interval_us)
        questions.send(*messages.command_long(*command, questions.system_id))
