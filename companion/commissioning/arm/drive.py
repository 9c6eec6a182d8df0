"""Moves the real arm as a leader decides, with the flight's own driver, and always makes it limp at the end."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from companion.commissioning.arm.motion import Motion, Moved, gentle
from companion.config.vehicle import Vehicle
from companion.io.devices import open_arm
from companion.io.protocols import DeviceError
from companion.model.types import ArmState, Joints
from companion.runtime.clock import flight_clock
from companion.runtime.realtime import FLIGHT_PRIORITY, realtime_thread
from companion.runtime.terminal import Bars

PERIOD_S: Final = 0.005
_SHOW_S: Final = 0.1
_READ_TIMEOUT_S: Final = 0.03


class Leader(Protocol):
    """Decides the motion of the arm."""

    def begin(self, state: ArmState) -> Sequence[Joints]:
        """Return the poses (rad) that the arm will move to, as far as they are known."""
        ...

    def update(self, motion: Motion, moved: Moved | None, state: ArmState) -> bool:
        """Decide how to continue after a control step; `moved` is None before the first. Return True at the end of the motion."""
        ...

    def status(self) -> str:
        """Return the current activity for display."""
        ...


@dataclass(frozen=True, slots=True)
class Driven:
    """Result of a motion."""

    stop: str
    """Why the motion ended early, one line; empty if the leader ended it."""
    angle_deg: Joints
    load_max_nm: Joints
    """Largest torque of each joint in addition to gravity."""


async def drive(vehicle: Vehicle, leader: Leader, bars: Bars) -> Driven:
    """Open the arm's bus, move the arm as `leader` decides, and then make the arm limp. After a cancellation the arm is limp within
    a few ms. The thread has real-time priority meanwhile, if that is permitted: a late step leaves the arm at an outdated torque.

    Raises:
        DeviceError: the bus cannot be opened, or gravity exceeds the torque limit in a pose that `leader` announces.
    """
    with realtime_thread(FLIGHT_PRIORITY):
        return await _drive(vehicle, leader, bars)


async def _drive(vehicle: Vehicle, leader: Leader, bars: Bars) -> Driven:
    clock = flight_clock()
    limits = [joint.angle_deg for joint in vehicle.arm.joints]
    async with open_arm(vehicle.arm_device, gentle(vehicle.arm), clock) as arm:
        state = arm.latest()
        assert state is not None, "the driver reads once while it opens"
        motion = Motion(vehicle, state)
        refusal = motion.refusal(leader.begin(state))
        if refusal:
            raise DeviceError(refusal)
        moved: Moved | None = None
        stepped_s, due_s, show_due_s = state.stamp_s, clock(), 0.0
        while True:
            newest = await arm.read(_READ_TIMEOUT_S)
            if newest is not None:
                state = newest
            age_s = clock() - state.stamp_s
            if age_s > vehicle.safety.arm_timeout_s:
                text = f"the arm is lost: no answer for {age_s:.2f} s, {state.read_failures} failed reads; check for a loose cable"
                return _driven(text, motion, state)
            if state.stamp_s > stepped_s:
                moved = motion.step(state, state.stamp_s - stepped_s)
                stepped_s = state.stamp_s
                arm.write_torque(moved.torque_nm)
                if moved.stop:
                    return _driven(moved.stop, motion, state)
                done = leader.update(motion, moved, state)
                if stepped_s >= show_due_s:
                    show_due_s = stepped_s + _SHOW_S
                    _show(bars, limits, state, moved)
                    bars.say(leader.status())
                if done:
                    return _driven("", motion, state)
            due_s = max(due_s + PERIOD_S, clock())
            await asyncio.sleep(due_s - clock())


def _show(bars: Bars, limits_deg: Sequence[Joints], state: ArmState, moved: Moved) -> None:
    degrees = [math.degrees(angle) for angle in state.angle_rad]
    bars.show(
        [(deg - low) / (high - low) for deg, (low, high) in zip(degrees, limits_deg, strict=True)],
        [
            f"{deg:7.1f} deg  {load:+.2f} N m beyond gravity  {hot:.0f} degC"
            for deg, load, hot in zip(degrees, moved.load_nm, state.temperature_c, strict=True)
        ],
    )


def _driven(stop: str, motion: Motion, state: ArmState) -> Driven:
    return Driven(stop, tuple(map(math.degrees, state.angle_rad)), tuple(motion.load_max_nm))
