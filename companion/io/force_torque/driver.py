"""Driver of the force-torque sensor Robotous RFT60-HA01 on a serial port."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
from contextlib import suppress
from typing import Final, Self

import serial
from serial.tools import list_ports

from companion.config.devices import ForceDevice, Rft60Options
from companion.io.force_torque import rft
from companion.io.force_torque.rft import Command, PacketScanner
from companion.io.force_torque.samples import SampleStream
from companion.io.protocols import DeviceError
from companion.io.reopening import Reopening
from companion.model.observations import ForceCounts
from companion.model.types import ForceSample
from companion.runtime.clock import Clock

_LOG = logging.getLogger(__name__)

_REPEAT_S: Final = 0.4
_FIRST_SAMPLES: Final = 5
_READ_BYTES: Final = 4096
_MODEL: Final = "RFT60"
_ON_THEIR_WAY_S: Final = 0.2


class RobotousForceTorque(SampleStream):
    """RFT60-HA01 in continuous-output mode; implements `companion.io.protocols.ForceTorque`.

    The port is read from the event loop: 200 packets/s of 19 bytes need no thread. When the sensor falls silent or the port vanishes,
    `latest()` becomes stale and nothing is raised. A port that comes back under its name is opened again by `latest()`.

    Args:
        answer_timeout_s: timeout for each reply of the sensor, and for the first samples.
    """

    options = Rft60Options

    def __init__(self, device: ForceDevice, clock: Clock, *, answer_timeout_s: float = 2.0) -> None:
        super().__init__(f"force sensor {device.port}", device.rate_hz)
        self._device = device
        self._clock = clock
        self._answer_timeout_s = answer_timeout_s
        self._serial: serial.Serial | None = None
        self._scanner = PacketScanner(rft.RESPONSE_BYTES)
        self._answers: dict[int, asyncio.Future[bytes]] = {}
        self._received_bytes = 0
        self._in_ticks = False
        self._reopening: Reopening[serial.Serial] | None = None
        """Attempts to open a lost port again; None while it is open."""
        self._starting: asyncio.Task[None] | None = None
        """Start of the sensor on a port that was opened again."""

    def latest(self) -> ForceSample | None:
        """Return the newest raw sample; never blocks."""
        if self._reopening is not None:
            self._restore(self._reopening)
        elif self._in_ticks:
            self._on_readable()
        return super().latest()

    def read_in_ticks(self) -> None:
        """Read the port in `latest` from now on. The stamp of a sample is then the time of the tick that read it."""
        if self._serial is not None:
            asyncio.get_running_loop().remove_reader(self._serial.fileno())
        self._in_ticks = True

    def counts(self) -> ForceCounts:
        """Return the counters, for logs and preflight."""
        return ForceCounts(
            samples=self._samples,
            skipped_bytes=self._scanner.skipped_bytes,
            bad_sums=self._scanner.bad_sums,
            lost=self._lost,
        )

    async def set_bias(self, on: bool) -> None:
        """Set the sensor's own zero to the current reading (SET_BIAS 1) or clear it (0), and drop the samples in transit.

        No flight uses it. The sensor does not acknowledge the command; check its reading.

        Raises:
            DeviceError: the sensor stopped sending.
        """
        self._send(Command.SET_BIAS, int(on))
        await self.tare_samples(_ON_THEIR_WAY_S)

    async def __aenter__(self) -> Self:
        """Open the port, identify the sensor, set its rate, start continuous output, wait for the first samples.

        Raises:
            DeviceError: the port does not exist or is in use, the device is silent or is a different one, or no samples arrive.
        """
        try:
            self._serial = self._open()
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise DeviceError(f"{self._where}: {self._why_not_open(error)}") from None
        try:
            asyncio.get_running_loop().add_reader(self._serial.fileno(), self._on_readable)
            await self._start()
            await self._first_samples()
        except BaseException:
            self._shut()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Stop the output and close the port; never raises."""
        self._shut()

    # -- opening ---------------------------------------------------------------------------------------------------------------

    def _open(self) -> serial.Serial:
        # The last argument sets VMIN to 1: only a lost port then returns an empty read, not one without new bytes.
        opened = serial.Serial(self._device.port, self._device.baud, timeout=0, exclusive=True, inter_byte_timeout=0)
        # USB adapters otherwise delay bytes by up to 16 ms; ports without this setting (a pty) have no such delay.
        with suppress(OSError, ValueError, NotImplementedError):
            opened.set_low_latency_mode(True)
        return opened

    def _why_not_open(self, error: OSError | ValueError) -> str:
        number = error.errno if isinstance(error, OSError) else None
        if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
            found = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
            return f"no such port; serial ports of this computer: {found}; plug the sensor in or set devices.force.port"
        if number in (errno.EBUSY, errno.EAGAIN):
            return "in use by another program; close it (lsof names it)"
        if number in (errno.EACCES, errno.EPERM):
            return "no permission; add your user to the dialout group and log in again"
        return f"not usable as a serial port ({error}); set devices.force.port to the sensor's port"

    async def _start(self) -> None:
        """Identify the sensor, set its rate and start continuous output."""
        self._send(Command.STOP)  # it may still stream from an earlier run and then accepts no other command
        self.product_name = rft.decode_text(await self._ask(Command.PRODUCT_NAME, repeat_s=_REPEAT_S))
        if _MODEL not in self.product_name:
            raise DeviceError(
                f'{self._where}: a "{self.product_name}" answers, expected a {_MODEL}-HA01 (other models scale their readings '
                "differently); check devices.force.port"
            )
        self.firmware = rft.decode_text(await self._ask(Command.FIRMWARE_VERSION))
        await self._set_rate()
        self._send(Command.START)

    async def _set_rate(self) -> None:
        """Read the rate and write it only if it differs: the sensor keeps it in EEPROM."""
        wanted_hz = self._device.rate_hz
        if await self._read_rate() == wanted_hz:
            return
        code = next(code for code, rate_hz in rft.RATE_CODES.items() if rate_hz == wanted_hz)
        answer = await self._ask(Command.SET_RATE, code)
        rate_hz = await self._read_rate()
        if rate_hz != wanted_hz:
            raise DeviceError(
                f"{self._where}: output rate {wanted_hz} Hz was rejected (error {answer[2]}); it stays at {rate_hz or 'unknown'} Hz; "
                "set devices.force.rate_hz to a rate that the sensor offers"
            )

    async def _read_rate(self) -> int | None:
        return rft.RATE_CODES.get((await self._ask(Command.GET_RATE))[1])

    async def _ask(self, command: Command, parameter: int = 0, repeat_s: float | None = None) -> bytes:
        """Send one request and return its reply. The first one is repeated: half a command from before may corrupt it."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + self._answer_timeout_s
        answer: asyncio.Future[bytes] = loop.create_future()
        self._answers[command] = answer
        try:
            while (remaining_s := deadline_s - loop.time()) > 0.0 and self._lost is None:
                self._send(command, parameter)
                done, _ = await asyncio.wait([answer], timeout=min(repeat_s or remaining_s, remaining_s))
                if done:
                    return answer.result()
        finally:
            if self._answers.get(command) is answer:
                del self._answers[command]
        raise DeviceError(
            f"{self._where}: {self._why_silent(f'no answer to command {command.value} ({command.name})')}"
        )

    async def _first_samples(self) -> None:
        samples = await self._collect(_FIRST_SAMPLES, self._answer_timeout_s)
        if len(samples) < _FIRST_SAMPLES:
            raise DeviceError(
                f"{self._where}: {self._why_silent(f'{len(samples)} of {_FIRST_SAMPLES} samples after START')}"
            )

    def _why_silent(self, what: str) -> str:
        within = f"{what} within {self._answer_timeout_s:g} s"
        if self._lost is not None:
            return f"{what}: {self._lost}"
        if self._received_bytes == 0:
            return f"{within}, nothing was received; check the sensor's power and cable"
        if self._scanner.packets == 0:
            return (
                f"{within}; {self._received_bytes} bytes received but no valid packet ({self._scanner.bad_sums} wrong checksums); "
                "check that this is the sensor's port, its baud rate (115200) and the cable"
            )
        counts = f"{self._scanner.packets} valid packets and {self._scanner.bad_sums} wrong checksums"
        return f"{within}; {counts} received; check the cable and power-cycle the sensor"

    # -- running ---------------------------------------------------------------------------------------------------------------

    def _send(self, command: Command, parameter: int = 0) -> None:
        if self._serial is None or self._lost is not None:
            return
        try:
            os.write(self._serial.fileno(), rft.encode_command(command, parameter))
        except BlockingIOError:
            _LOG.warning("%s: command %s was not sent: the port's output buffer is full", self._where, command.name)
        except OSError as error:
            self._lose(str(error))

    def _on_readable(self) -> None:
        if self._serial is None:
            return
        try:
            received = os.read(self._serial.fileno(), _READ_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:  # a pty whose other end closed, an unplugged adapter
            self._lose(str(error))
            return
        if not received:
            self._lose("end of file")
            return
        arrived_s = self._clock()
        self._received_bytes += len(received)
        for field in self._scanner.feed(received):
            if field[0] in (Command.START, Command.READ_ONCE):
                self._take_sample(field, arrived_s)
            else:
                answer = self._answers.get(field[0])
                if answer is not None and not answer.done():
                    answer.set_result(field)

    def _take_sample(self, field: bytes, arrived_s: float) -> None:
        wrench = rft.decode_wrench(field)
        beyond = max(abs(component) for component in wrench.force_n) > self._device.force_max_n
        sample = ForceSample(
            stamp_s=arrived_s,
            force_sensor_n=wrench.force_n,
            torque_sensor_nm=wrench.torque_nm,
            overload=wrench.overload_bits != 0 or beyond,
        )
        self._latest = sample
        self._samples += 1
        self._hand_on(sample)

    def _lose(self, reason: str) -> None:
        """Close a lost port (a dead descriptor is always readable), wake the waiting callers, and let it be opened again."""
        if self._lost is not None or self._serial is None:
            return
        self._lost = f"the port was lost ({reason})"
        self._close_port()
        if self._starting is not None:
            self._starting.cancel()
        _LOG.error("%s: %s", self._where, self._lost)
        self._wake()
        self._reopening = Reopening("force reopening", self._open)

    def _restore(self, reopening: Reopening[serial.Serial]) -> None:
        """Start the sensor again once its port is open again: it may have lost its power."""
        opened = reopening.take()
        if opened is None:
            return
        _LOG.warning("%s: the port is open again", self._where)
        self._serial, self._reopening, self._lost = opened, None, None
        loop = asyncio.get_running_loop()
        if not self._in_ticks:
            loop.add_reader(opened.fileno(), self._on_readable)
        self._starting = loop.create_task(self._start_again())

    async def _start_again(self) -> None:
        try:
            await self._start()
            await self._first_samples()
        except DeviceError as error:
            self._starting = None  # it is at its end
            self._lose(str(error))

    def _close_port(self) -> None:
        opened, self._serial = self._serial, None
        if opened is not None:
            asyncio.get_running_loop().remove_reader(opened.fileno())
            with suppress(OSError):
                opened.close()

    def _shut(self) -> None:
        if self._starting is not None:
            self._starting.cancel()
        if self._reopening is not None:
            self._reopening.close()
        self._send(Command.STOP)
        self._close_port()
