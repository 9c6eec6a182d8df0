"""Observes the open devices for a few seconds and collects their data: the only part of the preflight with I/O."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from msgspec.structs import replace

from companion.config.loader import FlightConfig
from companion.io.devices import AvailableDevices, Devices
from companion.io.dynamixel.port import usb_latency_ms
from companion.io.protocols import Autopilot, DeviceError
from companion.model.estimator import EstimatorReport
from companion.model.markers import MarkerFrame
from companion.model.observations import (
    ForceStream,
    Machine,
    MocapStream,
    Observations,
    StateCounts,
    Waiting,
)
from companion.model.types import ArmState, AutopilotStatus, ForceSample, MocapPose, VehicleState
from companion.runtime.clock import Clock
from companion.runtime.cores import usable_cpus
from companion.runtime.realtime import FLIGHT_PRIORITY, memory_lock_refused, realtime_permitted

LOOK_PERIOD_S = 0.005
"""Period of the observation, as in flight, so that the servo bus has the same load."""
READ_TIMEOUT_S = 0.003
COUNT_PERIOD_S = 0.1
TELL_PERIOD_S = 0.5
GOVERNORS = Path("/sys/devices/system/cpu")

Progress = Callable[[str, float], None]
"""Callback for display: the current subject and the elapsed fraction of the time."""
Unsettled = Callable[[Observations], Waiting | None]

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class _Counts:
    """Counters of all devices at one time."""

    t_s: float
    mocap_frames: int = 0
    mocap_numbers: int = 0
    """Frame number of the newest pose."""
    force_samples: int = 0
    state: StateCounts = field(default_factory=lambda: StateCounts(0, 0, 0))
    arm_cycles: int = 0
    arm_missed: int = 0


async def observe(
    devices: Devices | AvailableDevices,
    config: FlightConfig,
    clock: Clock,
    *,
    out: Path,
    param_names: Iterable[str],
    unsettled: Unsettled,
    progress: Progress,
    known: Observations | None = None,
) -> Observations:
    """Observe all devices for `safety.preflight_s`, and longer while a check may still pass; return the data. At the same time read
    PX4's version and parameters, and read the servo bus as in flight, which keeps its watchdogs from tripping.

    Args:
        devices: open devices; for a device that could not be opened, only the failure is reported.
        out: folder of the flight's files, for the free disk space.
        param_names: PX4's parameters to read.
        unsettled: called when the time is over, with the data of the last `preflight_s`; see
            `companion.preflight.evaluation.unsettled`.
        known: facts that are not observed: plan, recorder, mission length, hand test.
    """
    watcher = _Watcher(devices, config, clock)
    duration_s = config.vehicle.safety.preflight_s
    base = known or Observations(start_s=0.0, duration_s=0.0)
    failures = dict(devices.failures) if isinstance(devices, AvailableDevices) else {}
    base = replace(base, machine=machine_of(config, out), failures=failures)
    async with asyncio.TaskGroup() as group:
        asking = group.create_task(_ask(devices.autopilot, param_names)) if devices.autopilot is not None else None
        devices.forwarder.watch = watcher.on_pose
        try:
            start_s = told_s = clock()
            waiting: Waiting | None = None
            progress(*_words(None, 0.0, duration_s))
            while True:
                await watcher.look()
                elapsed_s = clock() - start_s
                if clock() - told_s >= TELL_PERIOD_S:
                    told_s = clock()
                    progress(*_words(waiting, elapsed_s, duration_s))
                if elapsed_s < duration_s or (asking is not None and not asking.done()):
                    continue
                seen = watcher.seen(base, duration_s)
                if asking is not None:
                    seen = _with_answers(seen, asking.result())
                waiting = unsettled(seen)
                if waiting is None or elapsed_s > duration_s + waiting.longest_s:
                    return seen
                again_s = clock() + TELL_PERIOD_S
                while clock() < again_s:
                    await watcher.look()
        finally:
            devices.forwarder.watch = None


def _words(waiting: Waiting | None, elapsed_s: float, duration_s: float) -> tuple[str, float]:
    if elapsed_s < duration_s:
        return f"all devices ... {math.ceil(duration_s - elapsed_s)} s", elapsed_s / duration_s
    if waiting is None:
        return "PX4's parameters", 1.0
    waited_s = elapsed_s - duration_s
    left_s = max(0.0, waiting.longest_s - waited_s)
    return f"waiting for: {waiting.what}, {left_s:.0f} s at most", min(1.0, waited_s / waiting.longest_s)


@dataclass(frozen=True, slots=True)
class _Answers:
    """PX4's replies to the queries."""

    firmware: str | None
    params: dict[str, float | int]
    failure: str | None


async def _ask(autopilot: Autopilot, names: Iterable[str]) -> _Answers:
    try:
        firmware = await autopilot.firmware()
        return _Answers(firmware, await autopilot.read_params(names), None)
    except DeviceError as error:
        return _Answers(None, {}, str(error))


def _with_answers(seen: Observations, answers: _Answers) -> Observations:
    if answers.failure is not None:
        return replace(seen, failures={**seen.failures, "autopilot": answers.failure})
    return replace(seen, firmware=answers.firmware, params=answers.params)


class _Watcher:
    """Collects the data of the devices; drops data older than the queried interval."""

    def __init__(self, devices: Devices | AvailableDevices, config: FlightConfig, clock: Clock) -> None:
        self._devices = devices
        self._device = config.vehicle.devices.mocap
        self._clock = clock
        self._poses: deque[MocapPose] = deque()
        self._markers: deque[MarkerFrame] = deque()
        self._vehicle: deque[VehicleState] = deque()
        self._status: deque[AutopilotStatus] = deque()
        self._estimator: deque[EstimatorReport] = deque()
        self._arm: deque[ArmState] = deque()
        self._force: deque[ForceSample] = deque()
        self._arm_cycles = self._arm_missed = 0
        self._counts: deque[_Counts] = deque([self._count()])

    def on_pose(self, pose: MocapPose) -> None:
        """Add a pose."""
        self._poses.append(pose)

    async def look(self) -> None:
        """Collect new data, with one bus cycle of the arm."""
        devices = self._devices
        if devices.arm is not None:
            state = await devices.arm.read(READ_TIMEOUT_S)
            if state is not None:
                if not self._arm or state.stamp_s != self._arm[-1].stamp_s:
                    self._arm.append(state)
                    self._arm_cycles += 1
                elif state.read_failures != self._arm[-1].read_failures:
                    self._arm_missed += max(0, state.read_failures - self._arm[-1].read_failures)
                    self._arm_cycles += 1
                    self._arm[-1] = state
        if devices.autopilot is not None:
            _take(self._vehicle, devices.autopilot.vehicle())
            _take(self._status, devices.autopilot.status())
            _take(self._estimator, devices.autopilot.estimator())
        if devices.mocap is not None:
            _take(self._markers, devices.mocap.markers())
        if devices.force is not None:
            _take(self._force, devices.force.latest())
        now_s = self._clock()
        if now_s - self._counts[-1].t_s >= COUNT_PERIOD_S:
            self._counts.append(self._count())
        await asyncio.sleep(LOOK_PERIOD_S)

    def seen(self, base: Observations, duration_s: float) -> Observations:
        """Return the data of the last `duration_s`, accurate to a tenth of a second."""
        now = self._count()
        while len(self._counts) > 1 and self._counts[1].t_s <= now.t_s - duration_s:
            self._counts.popleft()
        first = self._counts[0]
        devices, start_s = self._devices, first.t_s
        _forget(self._poses, lambda pose: pose.stamp_s < start_s)
        _forget(self._markers, lambda frame: frame.stamp_s < start_s)
        _forget(self._vehicle, lambda state: state.attitude_stamp_s < start_s)
        _forget(self._estimator, lambda report: report.stamp_s < start_s)
        _forget(self._arm, lambda state: state.stamp_s < start_s)
        _forget(self._force, lambda sample: sample.stamp_s < start_s)
        return replace(
            base,
            start_s=start_s,
            duration_s=now.t_s - start_s,
            vehicle=tuple(self._vehicle),
            status=tuple(self._status),
            estimator=tuple(self._estimator),
            mocap=tuple(self._poses),
            mocap_stream=self._mocap_stream(first, now),
            markers=tuple(self._markers),
            arm=tuple(self._arm),
            servos=devices.arm.servos if devices.arm is not None else (),
            arm_statement=devices.arm.statement if devices.arm is not None else None,
            force=tuple(self._force),
            state_counts=_between(first.state, now.state) if devices.autopilot is not None else None,
            force_stream=self._force_stream(first, now),
            arm_reads=(now.arm_cycles - first.arm_cycles, now.arm_missed - first.arm_missed)
            if devices.arm is not None
            else None,
        )

    def _count(self) -> _Counts:
        devices = self._devices
        frames = numbers = 0
        if devices.mocap is not None:
            counts, latest = devices.mocap.counts(), devices.mocap.latest()
            frames = counts.frames + counts.superseded
            numbers = latest.frame_number if latest is not None else 0
        return _Counts(
            t_s=self._clock(),
            mocap_frames=frames,
            mocap_numbers=numbers,
            force_samples=devices.force.counts().samples if devices.force is not None else 0,
            state=devices.autopilot.counts() if devices.autopilot is not None else StateCounts(0, 0, 0),
            arm_cycles=self._arm_cycles,
            arm_missed=self._arm_missed,
        )

    def _mocap_stream(self, first: _Counts, now: _Counts) -> MocapStream | None:
        mocap = self._devices.mocap
        if mocap is None:
            return None
        frames, server = now.mocap_frames - first.mocap_frames, mocap.server
        own, bodies = self._device.rigid_body_id, mocap.bodies
        return MocapStream(
            frames=frames,
            lost=max(0, now.mocap_numbers - first.mocap_numbers - frames),
            application=server.name if server is not None else "",
            other_bodies=tuple(sorted(number for number in bodies if number != own)),
            body_name=bodies.get(own, ""),
        )

    def _force_stream(self, first: _Counts, now: _Counts) -> ForceStream | None:
        force = self._devices.force
        if force is None:
            return None
        counts = force.counts()
        product = f"{force.product_name}, firmware {force.firmware}" if force.firmware else force.product_name
        return ForceStream(
            samples=now.force_samples - first.force_samples, bad_sums=counts.bad_sums, product=product, lost=counts.lost
        )


def _take(kept: deque[_T], newest: _T | None) -> None:
    """Append a record if it is new. Devices return the same record until another arrives."""
    if newest is not None and (not kept or newest != kept[-1]):
        kept.append(newest)


def _forget(kept: deque[_T], old: Callable[[_T], bool]) -> None:
    while kept and old(kept[0]):
        kept.popleft()


def _between(first: StateCounts, now: StateCounts) -> StateCounts:
    return StateCounts(now.position - first.position, now.attitude - first.attitude, now.imu - first.imu)


def machine_of(config: FlightConfig, out: Path) -> Machine:
    """Return the disk space, processor, permissions, cores and serial adapters of this computer."""
    folder = next((path for path in (out, *out.absolute().parents) if path.is_dir()), Path())
    try:
        free_bytes: int | None = shutil.disk_usage(folder).free
    except OSError:
        free_bytes = None
    governors = []
    for core in range(os.cpu_count() or 1):
        with contextlib.suppress(OSError):
            text = (GOVERNORS / f"cpu{core}/cpufreq/scaling_governor").read_text(encoding="ascii")
            governors.append(text.strip())
    devices = config.vehicle.devices
    return Machine(
        disk_free_bytes=free_bytes,
        governors=tuple(governors),
        realtime=realtime_permitted(FLIGHT_PRIORITY),
        memory_lock=memory_lock_refused(),
        cpus=usable_cpus(),
        arm_latency_ms=usb_latency_ms(devices.arm.port) if devices.arm is not None else None,
        force_latency_ms=usb_latency_ms(devices.force.port) if devices.force is not None else None,
    )
