"""Moves the real arm along what a leader wants, over the flight's own arm edge, and lets go of it whatever happens."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from companion.commissioning.arm.motion import Motion, Moved, gentle
from companion.config.vehicle import Vehicle
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.protocols import DeviceError
from companion.model.types import ArmState, Vec2
from companion.runtime.clock import flight_clock

PERIOD_S: Final = 0.005
_READ_TIMEOUT_S: Final = 0.03


class Leader(Protocol):
    """Says where to go next."""

    def begin(self, state: ArmState) -> Sequence[Vec2]:
        """Where the arm is; returns every pose (rad) that it is going to be led to, as far as that is known.

        Raises:
            ConfigError: nothing can be done from here.
        """
        ...

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """After each control step; True: all is done."""
        ...


@dataclass(frozen=True, slots=True)
class Driven:
    """How it ended."""

    stop: str
    """Why it ended early, one line; empty: the leader said that all is done."""
    angle_deg: Vec2
    """Both joints at the end."""
    load_max_nm: Vec2
    """Largest torque beside gravity."""


async def drive(vehicle: Vehicle, leader: Leader) -> Driven:
    """Open the arm, follow the leader, let go. Cancelled at any time, the arm is limp within a few ms.

    Raises:
        DeviceError: the arm does not open, or a pose is too heavy.
        ConfigError: the leader's.
    """
    clock = flight_clock()
    safety = vehicle.safety
    async with DynamixelArm(vehicle.devices.arm, gentle(vehicle.arm), clock) as arm:
        state = arm.latest()
        assert state is not None, "the edge has read once before it is open"
        motion = Motion(vehicle, state)
        refusal = motion.refusal(leader.begin(state))
        if refusal:
            raise DeviceError(refusal)
        moved: Moved | None = None
        stepped_s, due_s = state.stamp_s, clock()
        while True:
            newest = await arm.read(_READ_TIMEOUT_S)
            if newest is not None:
                state = newest
            age_s = clock() - state.stamp_s
            if age_s > safety.arm_timeout_s:
                text = f"lost the arm: no answer for {age_s:.2f} s, {state.read_failures} reads; look for a loose cable"
                return _driven(text, motion, state)
            if state.stamp_s > stepped_s:
                moved = motion.step(state, state.stamp_s - stepped_s)
                stepped_s = state.stamp_s
                arm.write_torque(moved.torque_nm)
                if moved.stop:
                    return _driven(moved.stop, motion, state)
                if leader.update(motion, moved, state):
                    return _driven("", motion, state)
            due_s = max(due_s + PERIOD_S, clock())
            await asyncio.sleep(due_s - clock())


def _driven(stop: str, motion: Motion, state: ArmState) -> Driven:
    (a, b), (one, other) = state.angle_rad, motion.load_max_nm
    return Driven(stop, (math.degrees(a), math.degrees(b)), (one, other))
