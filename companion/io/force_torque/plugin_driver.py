"""Driver of a force-torque sensor that is a plug-in: runs its class (`companion.io.force_torque.sensor.ForceSensor`) in a thread."""

from __future__ import annotations

import functools
import logging
from contextlib import suppress
from typing import Any, Final, Self

from companion.config.device_plugins import RFT60, device_class
from companion.config.devices import ForceDevice
from companion.io.device_thread import DeviceThread
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.force_torque.samples import SampleStream
from companion.io.force_torque.sensor import METHODS, checked
from companion.io.protocols import DeviceError
from companion.model.observations import ForceCounts
from companion.model.types import ForceSample
from companion.plugins import FORCE_SENSORS, PluginError, find, one_line
from companion.runtime.clock import Clock

_LOG: Final = logging.getLogger(__name__)
_OPEN_TIMEOUT_S: Final = 8.0
_FIRST_SAMPLES: Final = 5
_PERIOD_SHARE: Final = 0.5
"""Shortest time between two calls of `read`, as a share of the period of the samples: a `read` that does not wait would keep the
control loop from running."""


def open_force(device: ForceDevice, clock: Clock) -> RobotousForceTorque | PluginForceTorque:
    """Return the driver of the vehicle's force sensor, to be opened as a context manager."""
    return (RobotousForceTorque if device.type == RFT60 else PluginForceTorque)(device, clock)


class PluginForceTorque(SampleStream):
    """Readings of a plug-in's sensor; implements `companion.io.protocols.ForceTorque`.

    An invalid reading is dropped and counted. When `read` raises or no longer returns, `latest()` becomes stale and nothing is raised.
    """

    def __init__(self, device: ForceDevice, clock: Clock, *, first_timeout_s: float = 2.0) -> None:
        super().__init__(f"force sensor {device.type}", device.rate_hz)
        self._device = device
        self._clock = clock
        self._first_timeout_s = first_timeout_s
        self._sensor: Any = None
        self._invalid = 0
        self._thread = DeviceThread(f"force {device.type}", self._open, self._serve, self._close)

    def counts(self) -> ForceCounts:
        """Return the counters, for logs and preflight; an invalid reading counts as one with a wrong checksum."""
        return ForceCounts(samples=self._samples, skipped_bytes=0, bad_sums=self._invalid, lost=self._lost)

    async def __aenter__(self) -> Self:
        """Make the sensor, open it, and wait for the first samples.

        Raises:
            DeviceError: the plug-in cannot be used, raises an exception, or returns no valid reading.
        """
        await self._thread.start(
            _OPEN_TIMEOUT_S, f"{self._where}: open() has not returned within {_OPEN_TIMEOUT_S:g} s"
        )
        try:
            samples = await self._collect(_FIRST_SAMPLES, self._first_timeout_s)
            if len(samples) < _FIRST_SAMPLES:
                raise DeviceError(
                    f"{self._where}: {len(samples)} of {_FIRST_SAMPLES} samples within {self._first_timeout_s:g} s; "
                    f"{self._lost or self._problem or 'read() returned none'}"
                )
        except BaseException:
            await self._thread.stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the sensor; never raises."""
        await self._thread.stop()

    # -- thread ----------------------------------------------------------------------------------------------------------------

    def _open(self) -> DeviceError | None:
        try:
            found = device_class(FORCE_SENSORS, self._device.type, METHODS)
            plugin = find(FORCE_SENSORS, self._device.type)
        except PluginError as error:
            return DeviceError(str(error))
        try:
            self._sensor = found(found.options.model_validate(self._device.options), self._device)
            self._sensor.open()
            self.product_name = str(self._sensor.product_name)
        except Exception as error:
            return DeviceError(f"{plugin}: cannot be opened: {one_line(error)}")
        self._where = str(plugin)
        return None

    def _serve(self) -> None:
        shortest_s = _PERIOD_SHARE / self._device.rate_hz
        while not self._thread.stopping.is_set():
            began_s = self._clock()
            try:
                returned = self._sensor.read()
            except Exception as error:
                self._lost = f"read() raised {one_line(error)}"
                _LOG.error("%s: no more readings", self._where, exc_info=error)
                self._thread.post(self._wake)
                return
            arrived_s = self._clock()
            if returned is not None:
                self._take(returned, arrived_s)
            if arrived_s - began_s < shortest_s:
                self._thread.stopping.wait(shortest_s)

    def _take(self, returned: object, arrived_s: float) -> None:
        try:
            reading = checked(returned)
        except (TypeError, ValueError) as error:
            self._invalid += 1
            self._problem = one_line(error)
            return
        beyond = max(map(abs, reading.force_n)) > self._device.force_max_n
        self._latest = sample = ForceSample(
            stamp_s=arrived_s,
            force_sensor_n=reading.force_n,
            torque_sensor_nm=reading.torque_nm,
            overload=reading.overload or beyond,
        )
        self._samples += 1
        if self._collectors:
            self._thread.post(functools.partial(self._hand_on, sample))

    def _close(self) -> None:
        if self._sensor is not None:
            with suppress(Exception):
                self._sensor.close()
