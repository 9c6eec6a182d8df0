"""Reads IMU samples with PX4's timestamps (HIGHRES_IMU) and measures the offset between PX4's and the companion's clock (TIMESYNC).
I/O only.

HIGHRES_IMU carries the time of its sample (`time_usec`), so the latency of the message does not matter. PX4 answers a TIMESYNC
request (`tc1` = 0) immediately with its time; half the round-trip time is used as the delay of the reply.
"""

from __future__ import annotations

import asyncio
import math
import statistics
import struct
from bisect import bisect_left
from dataclasses import dataclass
from typing import Final, Self

from companion.config.devices import AutopilotDevice
from companion.io.protocols import DeviceError
from companion.io.px4 import messages
from companion.io.px4.driver import MavsdkAutopilot
from companion.model.frames import flu_from_frd
from companion.preflight.hand_test.motion import ImuAt
from companion.runtime.clock import Clock

SYNC_PERIOD_S: Final = 0.1
_TIMESYNC_ID: Final = 111
_TIMESYNC: Final = struct.Struct("<qq")
_IMU: Final = struct.Struct("<Q6f")
_SYNC_MIN: Final = 5
_SYNC_DEADLINE_S: Final = 5.0
_NEAR: Final = 30
"""Number of answers around an instant from which its clock offset is computed."""


@dataclass(frozen=True, slots=True)
class Sync:
    """PX4's answer to one TIMESYNC request."""

    t_s: float
    """Midpoint between request and answer, companion's clock."""
    offset_s: float
    """PX4's clock minus the companion's."""
    round_trip_s: float


class LatencyLink(MavsdkAutopilot):
    """The autopilot driver, extended to keep every IMU sample and to request PX4's clock ten times a second."""

    def __init__(self, device: AutopilotDevice, clock: Clock) -> None:
        super().__init__(device, clock)
        self._now = clock
        self._keep_flight_state = self._inbox.readers[messages.HIGHRES_IMU_ID]
        self._asked_ns: set[int] = set()
        self._syncing: asyncio.Task[None] | None = None
        self.syncs: list[Sync] = []
        self._raw: list[tuple[float, float, ImuAt]] = []

    async def __aenter__(self) -> Self:
        """Open the link as for a flight, then wait for PX4's clock.

        Raises:
            DeviceError: the link cannot be opened, or PX4 does not answer TIMESYNC.
        """
        await super().__aenter__()
        try:
            self._inbox.readers[messages.HIGHRES_IMU_ID] = self._on_imu
            self._inbox.readers[_TIMESYNC_ID] = self._on_sync
            self._syncing = asyncio.create_task(self._ask_clock(), name="timesync")
            await self._first_answers()
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop the requests, then close the link."""
        if self._syncing is not None:
            self._syncing.cancel()
            await asyncio.wait((self._syncing,))
        await super().__aexit__(None, None, None)

    def imu(self, last_s: float = math.inf) -> list[ImuAt]:
        """Return all samples so far on the companion's clock, or those of the last `last_s`."""
        offsets = _Offsets(self.syncs)
        found: list[ImuAt] = []
        from_s = self._raw[-1][1] - last_s if self._raw else 0.0
        first = bisect_left(self._raw, from_s, key=lambda one: one[1])
        for _, px4_s, sample in self._raw[first:]:
            t_s = px4_s - offsets.at(px4_s)
            if not found or t_s > found[-1].t_s:
                found.append(sample._replace(t_s=t_s))
        return found

    def imu_age_s(self) -> float | None:
        """Return the median time from a sample to the arrival of its message; None if none arrived."""
        offsets = _Offsets(self.syncs)
        ages = [arrived_s - (px4_s - offsets.at(px4_s)) for arrived_s, px4_s, _ in self._raw]
        return statistics.median(ages) if ages else None

    def round_trip_s(self) -> float:
        """Return the median round trip of TIMESYNC."""
        return statistics.median(sync.round_trip_s for sync in self.syncs)

    async def _first_answers(self) -> None:
        try:
            async with asyncio.timeout(_SYNC_DEADLINE_S):
                while len(self.syncs) < _SYNC_MIN or not self._raw:  # noqa: ASYNC110 - read from the link by its own timer
                    await asyncio.sleep(SYNC_PERIOD_S)
        except TimeoutError:
            what = "an answer to TIMESYNC" if len(self.syncs) < _SYNC_MIN else "HIGHRES_IMU"
            raise DeviceError(
                f"autopilot {self._device.address}: expected {what} within {_SYNC_DEADLINE_S:g} s, found none; use a link of PX4's "
                "onboard mode (MAV_x_MODE 2) that no router filters"
            ) from None

    async def _ask_clock(self) -> None:
        while True:
            asked_ns = int(self._now() * 1e9)
            self._asked_ns.add(asked_ns)
            self._send_message(_TIMESYNC_ID, _TIMESYNC.pack(0, asked_ns))
            await asyncio.sleep(SYNC_PERIOD_S)

    def _on_imu(self, arrived_s: float, payload: bytes) -> None:
        self._keep_flight_state(arrived_s, payload)
        time_us, xa, ya, za, xg, yg, zg = _IMU.unpack_from(payload.ljust(_IMU.size, b"\0"))
        sample = ImuAt(0.0, flu_from_frd((xa, ya, za)), flu_from_frd((xg, yg, zg)))
        self._raw.append((arrived_s, 1e-6 * time_us, sample))

    def _on_sync(self, arrived_s: float, payload: bytes) -> None:
        px4_ns, asked_ns = _TIMESYNC.unpack_from(payload.ljust(_TIMESYNC.size, b"\0"))
        if px4_ns == 0 or asked_ns not in self._asked_ns:
            return  # PX4's own request, or an answer to another program
        self._asked_ns.discard(asked_ns)
        asked_s = 1e-9 * asked_ns
        middle_s = 0.5 * (asked_s + arrived_s)
        self.syncs.append(Sync(middle_s, 1e-9 * px4_ns - middle_s, arrived_s - asked_s))


class _Offsets:
    """PX4's clock minus the companion's at any time: the median of the faster half of the answers around that time."""

    def __init__(self, syncs: list[Sync]) -> None:
        self._px4_s = [sync.t_s + sync.offset_s for sync in syncs]
        self._syncs = syncs
        self._known: dict[int, float] = {}

    def at(self, px4_s: float) -> float:
        """Return the offset at a time of PX4's clock."""
        key = int(2.0 * px4_s)
        if key not in self._known:
            order = sorted(range(len(self._syncs)), key=lambda k: abs(self._px4_s[k] - px4_s))[:_NEAR]
            near = sorted((self._syncs[k] for k in order), key=lambda sync: sync.round_trip_s)
            quick = near[: max(1, (len(near) + 1) // 2)]
            self._known[key] = statistics.median(sync.offset_s for sync in quick)
        return self._known[key]
