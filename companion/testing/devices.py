"""Checks of the contract of force sensors and arms, which the author of a plug-in calls with the device connected."""

from __future__ import annotations

import asyncio
import itertools
import math
import threading
from collections.abc import Callable

from companion.config import device_plugins
from companion.config.arm import Arm
from companion.config.devices import ArmDevice, ForceDevice
from companion.io.devices import open_arm
from companion.io.force_torque.plugin_driver import open_force
from companion.io.protocols import Device, DeviceError
from companion.plugins import ARMS, FORCE_SENSORS
from companion.runtime.clock import flight_clock
from companion.safety.arm import error_text

RATE_MAX = 1.5
"""Largest rate of the samples, as a multiple of `rate_hz`."""
TORQUE_SHARE = 0.01
READ_TIMEOUT_S = 1.0
SILENCES = 1.5
"""Time without commands, as a multiple of `watchdog_ms`."""
FAILED_MAX = 0.5
"""Largest share of reads that fail; the preflight judges more strictly."""


def check_force_sensor(device: ForceDevice, absent: ForceDevice | None = None, duration_s: float = 1.0) -> None:
    """Check an unloaded force sensor that is connected.

    It must open, stream new finite samples at no more than 1.5 times its rate, report no overload, close, and open again.

    Args:
        absent: the same with an address at which there is no sensor, which must be refused; None to leave that out.
        duration_s: duration for which the samples are judged.

    Raises:
        AssertionError: a check fails; the text states what was found.
        DeviceError: the sensor cannot be opened.
    """
    problems = device_plugins.problems(FORCE_SENSORS, device.type, device.options)
    assert not problems, f"devices.force: {problems}"
    for _ in range(2):
        asyncio.run(_stream(device, duration_s))
    if absent is not None:
        asyncio.run(_refuse(lambda: open_force(absent, flight_clock())))


def check_arm(device: ArmDevice, arm: Arm, absent: ArmDevice | None = None, duration_s: float = 1.0) -> None:
    """Check an arm that is connected and rests within its joint limits. Its torque is on, and 0 except for a hundredth of each limit.

    It must open, state its watchdog, report new joint states while torques are written and while none are, and close without torque,
    twice.

    Args:
        absent: the same with an address at which there is no arm, which must be refused; None to leave that out.
        duration_s: duration for which torques are written.

    Raises:
        AssertionError: a check fails; the text states what was found.
        DeviceError: the arm cannot be opened.
    """
    problems = device_plugins.problems(ARMS, device.type, device.options)
    assert not problems, f"devices.arm: {problems}"
    for _ in range(2):
        asyncio.run(_cycles(device, arm, duration_s))
    if absent is not None:
        asyncio.run(_refuse(lambda: open_arm(absent, arm, flight_clock())))


async def _cycles(device: ArmDevice, arm: Arm, duration_s: float, failed_max: float = FAILED_MAX) -> None:
    before, clock = set(threading.enumerate()), flight_clock()
    small_nm = tuple([TORQUE_SHARE * joint.torque_max_nm for joint in arm.joints])
    async with open_arm(device, arm, clock) as driver:
        said = driver.statement
        assert said is None or (said.product and said.product.isprintable()), f"product_name is {said}"
        ends_s, stamps_s, failed = clock() + duration_s, [0.0], 0
        while clock() < ends_s:
            state = await driver.read(READ_TIMEOUT_S)
            assert state is not None
            failed += state.read_failures > 0
            named = error_text(state.hardware_error)
            assert not named, f"{named}: see the log"
            assert stamps_s[-1] <= state.stamp_s <= clock(), f"a state is stamped {state.stamp_s:g} s at {clock():g} s"
            stamps_s.append(state.stamp_s)
            for number, (joint, angle_rad) in enumerate(zip(arm.joints, state.angle_rad, strict=True), 1):
                low_deg, high_deg = joint.angle_deg
                degrees = math.degrees(angle_rad)
                assert low_deg <= degrees <= high_deg, f"joint {number} is at {degrees:.1f} deg, outside its limits"
            sent_nm = driver.write_torque(small_nm if len(stamps_s) % 2 else tuple([-nm for nm in small_nm]))
            assert all(abs(sent) <= 2.0 * small for sent, small in zip(sent_nm, small_nm, strict=True)), (
                f"{sent_nm} N m are sent in place of {small_nm}"
            )
        assert failed <= failed_max * len(stamps_s), f"{failed} of {len(stamps_s)} reads failed: {driver.problem}"
        await asyncio.sleep(SILENCES * device.watchdog_ms * 1e-3)  # the driver keeps the arm's watchdog from tripping
        silent = await driver.read(READ_TIMEOUT_S)
        assert silent is not None and not any(silent.hardware_error) and silent.stamp_s > stamps_s[-1], (
            f"without commands for {SILENCES:g} times watchdog_ms: {driver.problem or silent}"
        )
    left = [thread.name for thread in set(threading.enumerate()) - before]
    assert not left, f"still running after the arm was closed: {', '.join(left)}"


async def _stream(device: ForceDevice, duration_s: float) -> None:
    before, clock = set(threading.enumerate()), flight_clock()
    async with open_force(device, clock) as sensor:
        samples = await sensor.tare_samples(duration_s)
        counts, now_s = sensor.counts(), clock()
    assert sensor.product_name.isprintable() and sensor.product_name, f"product_name is {sensor.product_name!r}"
    assert counts.lost is None and not counts.bad_sums, f"{counts.bad_sums} readings were invalid; lost: {counts.lost}"
    stamps_s = [sample.stamp_s for sample in samples]
    for earlier_s, later_s in itertools.pairwise([*stamps_s, now_s]):
        assert earlier_s <= later_s, f"a sample is stamped {earlier_s - later_s:g} s after the next one"
    rate_hz = (len(samples) - 1) / (stamps_s[-1] - stamps_s[0])
    assert rate_hz <= RATE_MAX * device.rate_hz, (
        f"{rate_hz:.0f} samples per second, expected {device.rate_hz}; does read() wait?"
    )
    values = {(sample.force_sensor_n, sample.torque_sensor_nm) for sample in samples}
    assert len(values) > 1, f"all {len(samples)} samples are equal: {values.pop()}"
    overloads = sum(sample.overload for sample in samples)
    assert not overloads, f"{overloads} of {len(samples)} samples are overloaded, with nothing on the sensor"
    left = [thread.name for thread in set(threading.enumerate()) - before]
    assert not left, f"still running after the sensor was closed: {', '.join(left)}"


async def _refuse(make: Callable[[], Device]) -> None:
    refusal = ""
    try:
        async with make():
            pass
    except DeviceError as error:
        refusal = str(error)
    assert refusal, "it opens, although nothing is at this address"
    assert refusal.isprintable(), f"the error is more than one line: {refusal}"
