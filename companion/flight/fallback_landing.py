"""When the core does not fly the vehicle: PX4 lands it, motion capture goes on flowing to it, and nothing else is sent."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import Protocol

from companion.config.loader import FlightConfig
from companion.flight.heartbeat import FlightGuard
from companion.model.flight_stage import people_fly
from companion.model.types import AttitudeSetpoint, AutopilotRequest, AutopilotStatus, Outcome
from companion.runtime import ipc
from companion.runtime.clock import Clock

HAND_OVER_S = 30.0
HAND_OVER_MIN_S = 1.5
"""PX4 says once a second whether it is armed; an older word does not count."""
UNFLOWN_HOVER_THRUST = 0.5
"""Of a vehicle that was found in the air: the core must be told one, and its law never flies there."""


class Lander(Protocol):
    """The autopilot edge, as far as a landing needs it."""

    def status(self) -> AutopilotStatus | None:
        """Latest slow state."""

    def send_attitude(self, setpoint: AttitudeSetpoint | None) -> bool:
        """None: from now on no setpoint leaves."""

    def request(self, request: AutopilotRequest) -> None:
        """Start carrying a request out."""


async def hand_over(autopilot: Lander, channel: socket.socket, clock: Clock, guardian: FlightGuard | None) -> Outcome:
    """Ask PX4 to land, and watch; people who fly are left alone, for as long as they do. PX4 disarms by itself: COM_DISARM_LAND.

    Args:
        autopilot: open.
        channel: to the launcher.
        clock: the flight clock.
        guardian: told that this process is alive.

    Returns:
        ABORTED once PX4 has disarmed, LOST if it has not within `HAND_OVER_S`.
    """
    # MAVSDK's Offboard plugin would go on repeating the last setpoint, and PX4's own failsafe would never act.
    with contextlib.suppress(Exception):  # whatever it is, LAND must be requested
        autopilot.send_attitude(None)
    start_s = clock()
    while clock() - start_s < HAND_OVER_S:
        now = autopilot.status()
        if now is not None and not now.armed and clock() - start_s > HAND_OVER_MIN_S:
            return Outcome.ABORTED
        if people_fly(now):
            start_s = clock()
        else:
            autopilot.request(AutopilotRequest.LAND)
        ipc.send(channel, {"type": "handed over"})
        if guardian is not None:
            guardian.still_here()
        await asyncio.sleep(0.05)
    return Outcome.LOST


def unflown(config: FlightConfig) -> FlightConfig:
    """The effective configuration of a vehicle that was found in the air: its hover thrust is not asked for."""
    airframe = config.vehicle.airframe
    if airframe.hover_thrust is not None:
        return config
    airframe = airframe.model_copy(update={"hover_thrust": UNFLOWN_HOVER_THRUST})
    return config.model_copy(update={"vehicle": config.vehicle.model_copy(update={"airframe": airframe})})
