"""`companion arm zero`: the user holds the limp arm; the servos' LEDs go off when a step is accepted. I/O only."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Final

from rich.console import Console

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import ServoTalk
from companion.commissioning.arm.zero import ZeroGuide, ZeroResult, ZeroView
from companion.config.vehicle import Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError
from companion.runtime.terminal import Bars, pressed, raw_keys

PERIOD_S: Final = 0.02
STEP_TIMEOUT_S: Final = 180.0
_FULL_DEG: Final = 90.0
"""Angle at which a progress bar is full."""


def hold(vehicle: Vehicle, guide: ZeroGuide, console: Console) -> ZeroResult:
    """Guide the user through the steps without torque; the LEDs always go off at the end.

    Raises:
        DeviceError: a servo does not answer or is not set up, a pose was not held in time, or the poses contradict each other.
    """
    device, ids = vehicle.arm_device, [joint.servo_id for joint in vehicle.arm.joints]
    names = [*(f"servo {servo_id}" for servo_id in ids), "held"]
    with ServoTalk(device.servo_port) as talk, raw_keys() as keys, Bars(console, names) as bars:
        talk.open(device.baud)
        for servo_id in ids:
            _ready(talk, servo_id)
        try:
            return _steps(talk, ids, guide, bars, keys)
        finally:
            with contextlib.suppress(DeviceError):
                _lights(talk, ids, 0)


def _ready(talk: ServoTalk, servo_id: int) -> None:
    name = f"arm bus: servo {servo_id}"
    if talk.ping(servo_id) is None:
        fix = "find it with companion arm scan, and correct it with companion arm setup"
        raise DeviceError(f"{name} does not answer at {talk.baud} baud; {fix}")
    talk.write(servo_id, dxl.TORQUE_ENABLE, 0)
    drive, offset = talk.read(servo_id, dxl.DRIVE_MODE), talk.read(servo_id, dxl.HOMING_OFFSET)
    if drive or offset:
        found = f"{dxl.DRIVE_MODE} is {drive} and {dxl.HOMING_OFFSET} {offset}, expected 0 and 0"
        raise DeviceError(f"{name}: {found}; run companion arm setup first, because it would change the zero")


def _steps(talk: ServoTalk, ids: Sequence[int], guide: ZeroGuide, bars: Bars, keys: int | None) -> ZeroResult:
    number, deadline_s = 0, 0.0
    while True:
        counts = tuple(talk.read(servo_id, dxl.PRESENT_POSITION) for servo_id in ids)
        now_s = time.monotonic()
        typed = pressed(keys)
        view = guide.update(now_s, counts, accept="\n" in typed or "\r" in typed)
        if view.failed:
            raise DeviceError(f"arm zero: {view.failed}; run companion arm zero again")
        if view.result is not None:
            return view.result
        assert view.step is not None
        if view.number != number:
            number, deadline_s = view.number, now_s + STEP_TIMEOUT_S
            _lights(talk, ids, 0)
            bars.say(f"{number}/{len(guide.steps)}  {view.step.instruction}", "bold")
            _lights(talk, ids, 1)
        if now_s > deadline_s:
            text = f"step {number} ({view.step.name}): not held within {STEP_TIMEOUT_S:.0f} s: {_why(view)}"
            raise DeviceError(f"arm zero: {text}; run it again")
        shares = [*(abs(moved) / _FULL_DEG for moved in view.moved_deg), view.held]
        bars.show(shares, [*(f"{moved:+7.1f} deg" for moved in view.moved_deg), view.notice])
        time.sleep(PERIOD_S)


def _why(view: ZeroView) -> str:
    if view.notice:
        return view.notice
    moved_deg = max(map(abs, view.moved_deg))
    return f"the arm has turned by {moved_deg:.0f} deg" if moved_deg >= 1.0 else "nothing has moved"


def _lights(talk: ServoTalk, ids: Sequence[int], on: int) -> None:
    for servo_id in ids:
        talk.write(servo_id, bus.LED, on)
