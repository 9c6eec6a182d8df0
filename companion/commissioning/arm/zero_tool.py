"""`companion arm zero`, from beginning to end: the arm is limp and somebody holds it; the servos' lights say what counts."""

from __future__ import annotations

import argparse
import contextlib
import time
from typing import Any, Final

from rich.console import Console

from companion.commissioning.arm import bus
from companion.commissioning.arm.bus import ServoTalk
from companion.commissioning.arm.result import finish
from companion.commissioning.arm.screen import Bars, people_console, pressed, raw_keys, say
from companion.commissioning.arm.zero import ZeroGuide, ZeroResult, ZeroView
from companion.config.vehicle import Vehicle
from companion.io.dynamixel import registers as dxl
from companion.io.protocols import DeviceError

PERIOD_S: Final = 0.02
STEP_S: Final = 180.0
"""For each pose; nobody is there any more after that."""
_FULL_DEG: Final = 90.0
"""The bar's full length."""


def run_zero(arguments: argparse.Namespace, vehicle: Vehicle) -> int:
    """Guide, find, propose.

    Raises:
        DeviceError: a servo does not answer; a pose was not held in time; the poses cannot be understood.
        ConfigError: the walls leave no poses; the proposed change does not fit the vehicle file.
    """
    people = people_console(arguments.json)
    guide = ZeroGuide(vehicle.arm)
    _introduce(people, vehicle, guide)
    result = _watch(people, vehicle, guide)
    _show(people, vehicle, result)
    return finish(arguments, people, True, result.changes(vehicle.arm), _json(vehicle, result))


def reach_below_m(vehicle: Vehicle) -> float:
    """How far the arm reaches below the body's origin when it hangs."""
    return sum(vehicle.arm.link_lengths_m) + vehicle.tool.net_radius_m - vehicle.arm.shoulder_body_m[2]


def stand_text(vehicle: Vehicle) -> str:
    """What the machine must stand on so that the arm can hang."""
    below_m, clearance_m = reach_below_m(vehicle), vehicle.airframe.ground_clearance_m
    text = f"the arm reaches {below_m:.2f} m below the body"
    if below_m <= clearance_m:
        return text
    return f"{text}, on its own feet the machine has {clearance_m:.2f} m: put it on a stand, level, with nothing below the arm"


def _introduce(people: Console, vehicle: Vehicle, guide: ZeroGuide) -> None:
    say(people, "zero: the arm is limp, nothing moves by itself; propellers off", "bold")
    say(people, f"  {stand_text(vehicle)}")
    say(
        people,
        "  the servos' lights go on when something is to be done and off when it counts: held still for 2 s, or Enter",
    )
    for number, step in enumerate(guide.steps, 1):
        say(people, f"  {number}. {step.told}")


def _watch(people: Console, vehicle: Vehicle, guide: ZeroGuide) -> ZeroResult:
    joints, device = vehicle.arm.joints, vehicle.devices.arm
    ids = (joints[0].servo_id, joints[1].servo_id)
    names = [f"servo {servo_id}" for servo_id in ids]
    with ServoTalk(device.port) as talk, raw_keys() as keys, Bars(people, [*names, "held"]) as bars:
        talk.open(device.baud)
        for servo_id in ids:
            _ready(talk, servo_id)
        try:
            return _steps(talk, ids, guide, bars, keys)
        finally:
            with contextlib.suppress(DeviceError):
                _lights(talk, ids, 0)


def _ready(talk: ServoTalk, servo_id: int) -> None:
    if not talk.answers(servo_id):
        text = f"servo {servo_id} does not answer at {talk.baud} baud; companion arm scan finds it, companion arm setup puts it right"
        raise DeviceError(f"arm bus: {text}")
    talk.write(servo_id, dxl.TORQUE_ENABLE, 0)
    drive, offset = talk.read(servo_id, bus.DRIVE_MODE), talk.read(servo_id, bus.HOMING_OFFSET)
    if drive or offset:
        text = f"servo {servo_id}: {bus.DRIVE_MODE} is {drive} and {bus.HOMING_OFFSET} {offset}, expected 0 and 0"
        raise DeviceError(
            f"arm bus: {text}; run companion arm setup first: a zero found now would be another one afterwards"
        )


def _steps(talk: ServoTalk, ids: tuple[int, int], guide: ZeroGuide, bars: Bars, keys: int | None) -> ZeroResult:
    number, deadline_s = 0, 0.0
    while True:
        counts = (talk.read(ids[0], dxl.PRESENT_POSITION), talk.read(ids[1], dxl.PRESENT_POSITION))
        now_s = time.monotonic()
        typed = pressed(keys)
        view = guide.update(now_s, counts, accept="\n" in typed or "\r" in typed)
        if view.failed:
            raise DeviceError(f"arm zero: {view.failed}; run companion arm zero again")
        if view.result is not None:
            return view.result
        if view.number != number:
            number, deadline_s = view.number, now_s + STEP_S
            assert view.step is not None
            _lights(talk, ids, 0)
            bars.say(f"{number}/{len(guide.steps)}  {view.step.told}", "bold")
            _lights(talk, ids, 1)
        if now_s > deadline_s:
            assert view.step is not None
            raise DeviceError(
                f"arm zero: step {number} ({view.step.name}): not held within {STEP_S:.0f} s{_why(view)}; run it again"
            )
        _show_view(bars, view)
        time.sleep(PERIOD_S)


def _why(view: ZeroView) -> str:
    if view.notice:
        return f": {view.notice}"
    most = max(map(abs, view.moved_deg))
    return f": the arm has turned by {most:.0f} deg" if most >= 1.0 else ": nothing has moved"


def _lights(talk: ServoTalk, ids: tuple[int, int], on: int) -> None:
    for servo_id in ids:
        talk.write(servo_id, bus.LED, on)


def _show_view(bars: Bars, view: ZeroView) -> None:
    first, second = view.moved_deg
    shares = [abs(first) / _FULL_DEG, abs(second) / _FULL_DEG, view.held]
    bars.show(shares, [f"{first:+7.1f} deg", f"{second:+7.1f} deg", view.notice])


def _show(people: Console, vehicle: Vehicle, result: ZeroResult) -> None:
    if result.swapped:
        say(people, "the servos are swapped: each moved when the other joint was asked for", "bold red")
    for index, (found, joint) in enumerate(zip(result.joints, vehicle.arm.joints, strict=True)):
        turned = "" if found.sign == joint.sign else ", which is the other way round"
        error = result.error_deg(vehicle.arm, index)
        spread = "" if found.spread_deg is None else f", poses agree within {found.spread_deg:.1f} deg"
        say(
            people,
            f"joint {index + 1}: servo {found.servo_id}, sign {found.sign:+d}{turned}, zero_count {found.zero_count} "
            f"(the vehicle file's is {error:+.1f} deg off){spread}",
        )
    if not result.changes(vehicle.arm):
        say(people, "as the vehicle file says, as far as a hand can tell", "bold green")


def _json(vehicle: Vehicle, result: ZeroResult) -> dict[str, Any]:
    joints = [
        {
            "joint": index + 1,
            "servo_id": found.servo_id,
            "sign": found.sign,
            "zero_count": found.zero_count,
            "spread_deg": found.spread_deg,
            "file_error_deg": result.error_deg(vehicle.arm, index),
        }
        for index, found in enumerate(result.joints)
    ]
    return {"swapped": result.swapped, "joints": joints}
