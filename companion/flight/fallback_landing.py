"""Fallback landing without the core: PX4 lands, motion capture is still forwarded to it, and nothing else is sent."""

from __future__ import annotations

import asyncio
import socket
from typing import Protocol

from companion.config.loader import FlightConfig
from companion.flight.heartbeat import HeartbeatSender
from companion.model.flight_stage import HEARTBEAT_FRESH_S, flown_by_pilot
from companion.model.launcher_messages import HandedOver
from companion.model.types import AutopilotRequest, AutopilotStatus, Outcome
from companion.runtime import ipc
from companion.runtime.clock import Clock

LANDING_TIMEOUT_S = 30.0
STATUS_MIN_AGE_S = 1.5
"""Time after the start of the landing for which `disarmed` is ignored: PX4 reports it once a second, so the report may predate the
landing.
"""
UNFLOWN_HOVER_THRUST = 0.5
"""Hover thrust for a vehicle that was found in the air: the core requires a value, but its controller never runs."""


class Lander(Protocol):
    """The part of the autopilot driver that a landing needs."""

    def status(self) -> AutopilotStatus | None:
        """Return the latest status."""

    def request(self, request: AutopilotRequest) -> None:
        """Start a request."""


async def land_without_core(
    autopilot: Lander, channel: socket.socket, clock: Clock, guardian: HeartbeatSender | None
) -> Outcome:
    """Command PX4 to land and monitor it, without interfering with a pilot. PX4 disarms by itself (COM_DISARM_LAND).

    Args:
        guardian: connection that receives heartbeats of this process.

    Returns:
        ABORTED once PX4 has disarmed, LOST if it does not disarm within `LANDING_TIMEOUT_S`.
    """
    start_s = clock()
    while clock() - start_s < LANDING_TIMEOUT_S:
        now = autopilot.status()
        if now is not None and not now.armed and clock() - start_s > STATUS_MIN_AGE_S:
            return Outcome.ABORTED
        if now is not None and clock() - now.heartbeat_stamp_s < HEARTBEAT_FRESH_S and flown_by_pilot(now):
            start_s = clock()
        else:
            autopilot.request(AutopilotRequest.LAND)
        ipc.send(channel, HandedOver())
        if guardian is not None:
            guardian.still_here()
        await asyncio.sleep(0.05)
    return Outcome.LOST


def unflown(config: FlightConfig) -> FlightConfig:
    """Return the effective configuration for a vehicle that was found in the air: its hover thrust is not read from PX4."""
    airframe = config.vehicle.airframe
    if airframe.hover_thrust is not None:
        return config
    airframe = airframe.model_copy(update={"hover_thrust": UNFLOWN_HOVER_THRUST})
    return config.model_copy(update={"vehicle": config.vehicle.model_copy(update={"airframe": airframe})})
