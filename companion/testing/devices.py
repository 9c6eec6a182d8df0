"""Checks of the contract of force sensors and arms, which the author of a plug-in calls with the device connected."""

from __future__ import annotations

import asyncio
import itertools
import threading

from companion.config import device_plugins
from companion.config.devices import ForceDevice
from companion.io.force_torque.plugin_driver import open_force
from companion.io.protocols import DeviceError
from companion.plugins import FORCE_SENSORS
from companion.runtime.clock import flight_clock

RATE_MAX = 1.5
"""Largest rate of the samples, as a multiple of `rate_hz`."""


def check_force_sensor(device: ForceDevice, absent: ForceDevice | None = None, duration_s: float = 1.0) -> None:
    """Check an unloaded force sensor that is connected.

    It must open, stream new finite samples at no more than 1.5 times its rate, report no overload, close, and open again.

    Args:
        device: `devices.force` of the vehicle file.
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
        asyncio.run(_refuse(absent))


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


async def _refuse(device: ForceDevice) -> None:
    refusal = ""
    try:
        async with open_force(device, flight_clock()):
            pass
    except DeviceError as error:
        refusal = str(error)
    assert refusal, "it opens, although no sensor is at this address"
    assert refusal.isprintable(), f"the error is more than one line: {refusal}"
