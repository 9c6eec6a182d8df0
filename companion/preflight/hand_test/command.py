"""The hand test at the terminal: instructions, progress, evaluation, and the record of a passed test."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from rich.console import Console

from companion.config.loader import FlightConfig
from companion.io.devices import AvailableDevices, Devices
from companion.model.check_row import Row, refusals
from companion.model.types import AutopilotStatus, MocapPose, VehicleState
from companion.preflight.checks import Check
from companion.preflight.hand_test import evaluation as hand_test_evaluation
from companion.preflight.hand_test import record as hand_record
from companion.preflight.hand_test.steps import INSTRUCTIONS, HandResult, HandSample, HandTest, HandView, Step
from companion.runtime.console import console_on
from companion.runtime.terminal import Bars, pressed, raw_keys

LOOK_PERIOD_S: Final = 0.004
ARM_PERIOD_S: Final = 0.02
_ARM_TIMEOUT_S: Final = 0.003
ENDED_BY_HAND: Final = "ended by the operator"
_STEPS: Final = tuple(step for step in Step if step is not Step.DONE)

RECORD = Check(
    "hand.record",
    "hand test: record",
    "a passed test is recorded",
    "the next check will ask for the test again",
    warns=True,
)


async def run_hand_test(
    devices: Devices | AvailableDevices,
    config: FlightConfig,
    console: Console,
    json: bool = False,
    *,
    record: Path | None = None,
) -> list[Row]:
    """Guide the operator through the test and return its rows. Any key or Ctrl-C ends the test.

    Args:
        devices: open devices; poses need not be forwarded to PX4. An open arm is read during the test to keep its watchdogs from
            tripping.
        json: whether standard output must stay free; all text for the operator then goes to standard error.
        record: file in which a passed test is recorded (`hand_record.record_path()`); None to record nothing, as in SITL.
    """
    outcome = await perform(devices, config, console, json)
    if isinstance(outcome, str):
        return [hand_test_evaluation.ended(outcome)]
    rows = hand_test_evaluation.rows(outcome, config.vehicle.devices.mocap.up_axis)
    if record is not None and devices.mocap is not None and not refusals(rows):
        server = devices.mocap.server
        setup = hand_record.Setup.of(config.vehicle, server.protocol_version if server is not None else "")
        rows.append(_keep(record, setup, rows))
    return rows


async def perform(
    devices: Devices | AvailableDevices, config: FlightConfig, console: Console, json: bool = False
) -> HandResult | str:
    """Guide the operator through the test and return the measurements, or why there are none. Arguments as in `run_hand_test`."""
    mocap, autopilot, arm = devices.mocap, devices.autopilot, devices.arm
    if config.vehicle.devices.mocap.external:
        return "another program feeds PX4 (devices.mocap.type: external): there is no motion capture to test"
    if mocap is None or autopilot is None:
        missing = "motion capture" if mocap is None else "PX4"
        return f"{missing} is not connected"
    test, clock, arm_due_s = HandTest(), _StampClock(), 0.0
    stop = asyncio.Event()
    if json and console.file is sys.stdout:
        console = console_on(sys.stderr)
    console.print(
        "[bold]hand test[/]  battery connected, motors disarmed, propellers off; the operator carries the vehicle "
        "(any key ends the test)"
    )
    with _interrupted(stop), raw_keys() as keys, Bars(console, ["hand test"]) as bars:
        while True:
            pose, vehicle, status = mocap.latest(), autopilot.vehicle(), autopilot.status()
            now_s = clock.now(pose, vehicle, status)
            view = test.update(HandSample(now_s, pose, vehicle, _armed(status, now_s, config)))
            _show(bars, view)
            if view.result is not None or view.ended or stop.is_set() or pressed(keys):
                break
            if arm is not None and now_s >= arm_due_s:
                arm_due_s = now_s + ARM_PERIOD_S
                await arm.read(_ARM_TIMEOUT_S)
            await asyncio.sleep(LOOK_PERIOD_S)
    return view.result if view.result is not None else view.ended or ENDED_BY_HAND


def _keep(path: Path, setup: hand_record.Setup, rows: list[Row]) -> Row:
    try:
        tests = hand_record.load(path)
    except hand_record.RecordError:
        tests = []  # an unreadable record is replaced, so that the test just passed is kept
    try:
        hand_record.save(path, hand_record.with_passed(tests, setup, datetime.now(UTC), rows))
    except hand_record.RecordError as error:
        return RECORD.bad(str(error), "", "correct the folder's permissions and repeat the test")
    return RECORD.good(f"written to {path}")


def _armed(status: AutopilotStatus | None, now_s: float, config: FlightConfig) -> bool | None:
    if status is None or now_s - status.heartbeat_stamp_s > config.vehicle.safety.heartbeat_timeout_s:
        return None
    return status.armed


class _StampClock:
    """The flight clock, derived from the devices' stamps; it continues on monotonic time when all devices are silent."""

    def __init__(self) -> None:
        self._ahead_s: float | None = None

    def now(self, pose: MocapPose | None, vehicle: VehicleState | None, status: AutopilotStatus | None) -> float:
        """Return the time, s; 0 before the first stamp."""
        here_s = time.monotonic()
        stamps = [
            *((pose.stamp_s,) if pose is not None else ()),
            *((vehicle.imu_stamp_s,) if vehicle is not None else ()),
            *((status.heartbeat_stamp_s,) if status is not None else ()),
        ]
        if stamps:
            newest_s = max(stamps) - here_s
            self._ahead_s = newest_s if self._ahead_s is None else max(self._ahead_s, newest_s)
        return here_s + (self._ahead_s or 0.0)


@contextlib.contextmanager
def _interrupted(stop: asyncio.Event) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    loop, before = asyncio.get_running_loop(), signal.getsignal(signal.SIGINT)
    loop.add_signal_handler(signal.SIGINT, stop.set)
    try:
        yield
    finally:
        loop.remove_signal_handler(signal.SIGINT)
        signal.signal(signal.SIGINT, before)


def _show(bars: Bars, view: HandView) -> None:
    number = f"{_STEPS.index(view.step) + 1}/{len(_STEPS)}" if view.step in _STEPS else "   "
    bars.say(
        f"   {view.notice}" if view.notice else f"{number}  {INSTRUCTIONS[view.step]}", "yellow" if view.notice else ""
    )
    bars.show([view.progress], [f"{view.step.value}  {view.seen}"])
