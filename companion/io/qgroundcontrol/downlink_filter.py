"""Filter of the vehicle's messages to a ground station. Pure: time is an argument."""

from __future__ import annotations

from collections import Counter

from pymavlink.dialects.v20 import common as mavlink

from companion.io.px4.frames import CRC_EXTRA, Frame, frames

STREAM_RATE_HZ = 10.0
"""Rate of each fast stream to the ground; the companion requests up to 250 Hz from PX4."""


FAST_STREAMS = frozenset(
    getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    for name in (
        *("ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "HIGHRES_IMU", "SCALED_IMU"),
        *(
            "SCALED_IMU2",
            "SCALED_IMU3",
            "SCALED_PRESSURE",
            "ODOMETRY",
            "ATTITUDE_TARGET",
            "SERVO_OUTPUT_RAW",
            "VFR_HUD",
        ),
        *(
            "POSITION_TARGET_LOCAL_NED",
            "POSITION_TARGET_GLOBAL_INT",
            "ACTUATOR_OUTPUT_STATUS",
            "RC_CHANNELS",
            "TIMESYNC",
        ),
        *("ALTITUDE", "DISTANCE_SENSOR", "OPTICAL_FLOW_RAD", "VIBRATION", "ESTIMATOR_STATUS"),
    )
)


class DownlinkFilter:
    """Filter of the vehicle's messages to the ground: thins fast streams.

    The rest is renumbered for each sender, because a ground station counts gaps in the numbers as lost messages.
    """

    def __init__(self) -> None:
        self._next_s: dict[tuple[int, int, int], float] = {}
        self._sequence: Counter[tuple[int, int]] = Counter()
        self._extras: dict[int, int | None] = dict(CRC_EXTRA)

    def pick(self, datagram: bytes, now_s: float) -> list[bytes]:
        """Return the frames to send from a datagram that the flight process forwarded."""
        picked = []
        for frame in frames(datagram):
            if frame is None or not self._due(frame, now_s):
                continue
            extra = self._extra(frame)
            if extra is None or frame.signed:
                picked.append(frame.data)
                continue
            sender = (frame.system, frame.component)
            picked.append(frame.numbered(self._sequence[sender], extra))
            self._sequence[sender] += 1
        return picked

    def _extra(self, frame: Frame) -> int | None:
        """Return the message's CRC_EXTRA; if the dialect lacks it, find it by its first frame: all 256 values are tried."""
        if frame.message_id not in self._extras:
            fits = (extra for extra in range(256) if frame.right_checksum(extra) == frame.checksum)
            self._extras[frame.message_id] = next(fits, None)
        return self._extras[frame.message_id]

    def _due(self, frame: Frame, now_s: float) -> bool:
        if frame.message_id not in FAST_STREAMS:
            return True
        key = (frame.system, frame.component, frame.message_id)
        due_s = self._next_s.get(key, now_s)
        if now_s < due_s:
            return False
        # On a grid, so that a stream of 12 Hz does not become one of 6; a grid that was missed starts again.
        self._next_s[key] = max(due_s + 1.0 / STREAM_RATE_HZ, now_s)
        return True
