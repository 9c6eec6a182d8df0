"""The newest sample of a force-torque sensor, and the collection of samples for a tare; shared by the drivers."""

from __future__ import annotations

import asyncio
import math
from contextlib import suppress
from typing import Final

from companion.io.protocols import DeviceError
from companion.model.types import ForceSample

SILENT_S: Final = 1.0
"""Time without a sample after which a sensor that is being read for the tare counts as silent, s."""


class SampleStream:
    """Samples of an open sensor. They are raw, in the sensor frame; the user of a sample removes the bias.

    Args:
        where: device and address, for errors.
    """

    def __init__(self, where: str, rate_hz: float) -> None:
        self._where = where
        self._rate_hz = rate_hz
        self._collectors: list[_Collector] = []
        self._latest: ForceSample | None = None
        self._samples = 0
        self._lost: str | None = None
        self._problem = ""
        """Why the newest invalid reading was dropped; empty if none was."""
        self.product_name = ""
        self.firmware = ""

    def latest(self) -> ForceSample | None:
        """Return the newest raw sample; never blocks."""
        return self._latest

    def read_in_ticks(self) -> None:
        """Do nothing, because a thread reads the sensor; a driver that reads in the event loop overrides it."""

    async def tare_samples(self, duration_s: float) -> list[ForceSample]:
        """Return the samples of the next `duration_s` (counted at the configured rate), for the caller to average.

        Raises:
            DeviceError: no sample arrived for `SILENT_S`.
        """
        count = max(1, math.ceil(duration_s * self._rate_hz))
        samples: list[ForceSample] = []
        while len(samples) < count:
            more = await self._collect(count - len(samples), SILENT_S)
            samples += more
            if not more:
                raise DeviceError(
                    f"{self._where}: {len(samples)} of {count} samples received, none in the last {SILENT_S:g} s, while taring; "
                    f"{self._lost or self._problem or 'the sensor fell silent'}"
                )
        return samples

    async def _collect(self, count: int, deadline_s: float) -> list[ForceSample]:
        """Return the next `count` samples, or fewer at the deadline or when the sensor is lost."""
        collector = _Collector(count)
        self._collectors.append(collector)
        if self._lost is not None:
            collector.full.set()
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(deadline_s):
                    await collector.full.wait()
        finally:
            self._collectors.remove(collector)
        return collector.samples

    def _hand_on(self, sample: ForceSample) -> None:
        """Add a sample to those that are being collected; called in the event loop."""
        for collector in self._collectors:
            collector.add(sample)

    def _wake(self) -> None:
        """End the collection of samples, because the sensor is lost; called in the event loop."""
        for collector in self._collectors:
            collector.full.set()


class _Collector:
    """Collects a given number of samples."""

    def __init__(self, count: int) -> None:
        self._count = count
        self.samples: list[ForceSample] = []
        self.full = asyncio.Event()

    def add(self, sample: ForceSample) -> None:
        if len(self.samples) < self._count:
            self.samples.append(sample)
        if len(self.samples) == self._count:
            self.full.set()
