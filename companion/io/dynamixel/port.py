"""The SDK's serial port adapted to a control loop, in real and in simulated time. The SDK implements the protocol."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import time
from pathlib import Path

import serial
from dynamixel_sdk import PortHandler
from serial.tools import list_ports

from companion.io.protocols import DeviceError
from companion.runtime import simulated_time
from companion.runtime.simulated_time import SimulatedTime

_POLL_MS = 1.0
NOISE_BYTES = 252 * 14
"""As many bytes as the longest replies to one instruction: those of 252 servos to a broadcast ping."""
_LOOK_S = 0.001
"""Longest wait in simulated time without asking whether a reply is still to come."""


class ServoPort(PortHandler):  # type: ignore[misc]
    """The SDK's port with a serial timeout (the original busy-polls while holding the GIL), a lock, and its own packet timeout.

    A reply times out only if the process spent half of the timeout waiting at the port or reading other bytes than the reply's: a
    process that was not scheduled for a while reads the port again before it gives up, and a servo that sends without pause does not
    keep it reading.
    """

    is_open: bool
    _arrived = b""
    """Bytes that were read from the port and not yet asked for by the SDK, which reads the head of a packet before the rest."""
    _waited_ms = 0.0
    _surplus_bytes = 0
    """Bytes that were read beyond those of the reply; negative while the reply is not complete."""
    _reply_missing = False
    reply_timeout_ms = 100.0
    """Longest wait for a reply, in addition to the transmission time of its bytes."""
    late_reply_ms = 100.0
    """Pause after a timeout, in which a late reply is discarded. A reply does not name its register: without the pause it
    would be taken for the reply to the next request. 0 where all requests are the same."""

    def setupPort(self, cflag_baud: int) -> bool:
        """Open the port at `self.baudrate` (called by the SDK).

        Raises:
            DeviceError: the port does not exist, is busy, is not accessible, or is not a serial port.
        """
        if self.is_open:
            self.closePort()
        try:
            opened = self.open_serial(cflag_baud)
        except (OSError, ValueError) as error:
            raise DeviceError(f"arm bus {self.port_name}: {_open_failure(self.port_name, error)}") from error
        self.use(opened)
        self.tx_time_per_byte = 10_000.0 / self.baudrate
        return True

    def open_serial(self, baud: int) -> serial.Serial:
        """Return the port, newly opened; `use` takes it into use.

        Raises:
            OSError: the port does not exist, is busy or not accessible.
            ValueError: it is not a serial port, or does not support the baud rate.
        """
        opened = serial.Serial(self.port_name, baud, timeout=_POLL_MS * 1e-3, exclusive=True, bytesize=serial.EIGHTBITS)
        # A pty or a native UART has no latency timer; only the kernel's value matters.
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            opened.set_low_latency_mode(True)
        return opened

    def use(self, opened: serial.Serial) -> None:
        """Exchange data through an open port from now on."""
        self.ser, self.is_open, self._arrived = opened, True, b""

    def closePort(self) -> None:
        """Close the port. A second call has no effect."""
        if self.is_open:
            self.is_open = False
            self.ser.close()

    def getCurrentTime(self) -> float:
        """Return monotonic time, ms; the SDK's own follows the wall clock, which NTP may set."""
        return time.monotonic() * 1e3

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start the timeout for `packet_length` bytes."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self.reply_timeout_ms)
        self._surplus_bytes = -packet_length

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start a timeout of `msec`."""
        self.packet_start_time = self.getCurrentTime()
        self.packet_timeout = msec
        self._waited_ms = 0.0
        self._surplus_bytes = 0

    def clearPort(self) -> None:
        """Discard the bytes that have arrived; after a timeout, also wait for a late reply and discard it. The SDK calls this before
        each request.

        Raises:
            OSError: the port is gone.
        """
        if self._reply_missing:
            self._reply_missing = False
            end_ms = self.getCurrentTime() + self.late_reply_ms
            while self.getCurrentTime() < end_ms:
                self.ser.read(NOISE_BYTES)
        self.ser.reset_input_buffer()
        self._arrived = b""

    def readPort(self, length: int) -> bytes:
        """Return up to `length` bytes, after at most 1 ms.

        Raises:
            OSError: the port is gone.
        """
        if self.isPacketTimeout():
            return b""  # the SDK checks the time only when it lacks bytes: packets without pause would keep it reading
        if not self._arrived:
            self._wait()
        data, self._arrived = self._arrived[:length], self._arrived[length:]
        self._surplus_bytes += len(data)
        return data

    def peek(self, length: int) -> bytes:
        """Return up to `length` bytes, after at most 1 ms, and leave them in place for `readPort` and `skip`.

        Raises:
            OSError: the port is gone.
        """
        if len(self._arrived) < length:
            self._wait()
        return self._arrived[:length]

    def skip(self, length: int) -> None:
        """Take the bytes that `peek` returned."""
        self._arrived = self._arrived[length:]
        self._surplus_bytes += length

    def _wait(self) -> None:
        start_ms = self.getCurrentTime()
        self._arrived += self._receive()
        self._waited_ms += min(_POLL_MS, self.getCurrentTime() - start_ms)

    def _receive(self) -> bytes:
        """Return all bytes that have arrived, after a wait of at most 1 ms; empty if none have. pyserial's `read` takes only the bytes
        asked for, so that each packet would cost two waits and two reads.
        """
        return self._read_now() if select.select((self.ser.fd,), (), (), _POLL_MS * 1e-3)[0] else b""

    def _read_now(self) -> bytes:
        try:
            data = os.read(self.ser.fd, NOISE_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError(f"{self.port_name}: disconnected, or another program reads from it")
        return data

    def writePort(self, packet: list[int] | bytes) -> int:
        """Pass a packet to the port's output buffer, which has room for many, and return the number of bytes taken. pyserial's `write`
        waits once more after each packet.

        Raises:
            OSError: the port is gone, or its buffer is full because the adapter has stopped sending.
        """
        return os.write(self.ser.fd, bytes(packet))

    def isPacketTimeout(self) -> bool:
        """Return whether the reply has timed out."""
        listened_ms = self._waited_ms + self.tx_time_per_byte * max(0, self._surplus_bytes)
        late = self.getTimeSinceStart() > self.packet_timeout and listened_ms > 0.5 * self.packet_timeout
        self._reply_missing = late or self._surplus_bytes >= NOISE_BYTES
        return self._reply_missing


class SimulatedPort(ServoPort):
    """Serial port to the servo bus in simulated time: a reply is missing once the world has answered all that was written."""

    def __init__(self, port_name: str | None, simulated: SimulatedTime) -> None:
        super().__init__(port_name)
        self._simulated = simulated
        self._silent = False

    def getCurrentTime(self) -> float:
        """Return simulated time, ms."""
        return self._simulated.now() * 1e3

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Expect a reply."""
        super().setPacketTimeoutMillis(msec)
        self._silent = False

    def writePort(self, packet: list[int] | bytes) -> int:
        """Pass a packet to the port and count its bytes."""
        written = super().writePort(packet)
        self._simulated.bus_bytes += written
        return written

    def clearPort(self) -> None:
        """Discard the bytes that have arrived, and count them."""
        while self._received():
            pass
        self._arrived = b""

    def isPacketTimeout(self) -> bool:
        """Return whether no reply will arrive."""
        return (self._silent and not self._arrived) or self._surplus_bytes >= NOISE_BYTES

    def _receive(self) -> bytes:
        while True:
            if data := self._received(_LOOK_S):
                return data
            if self._simulated.bus_is_silent:
                self._silent = True
                return b""

    def _received(self, timeout_s: float = 0.0) -> bytes:
        if not select.select((self.ser.fd,), (), (), timeout_s)[0]:
            return b""
        data = self._read_now()
        self._simulated.bus_received_bytes += len(data)
        return data


def servo_port(port_name: str | None) -> ServoPort:
    """Return a port for the time that this process lives in."""
    simulated = simulated_time.current()
    return ServoPort(port_name) if simulated is None else SimulatedPort(port_name, simulated)


def _open_failure(port: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT or not Path(port).exists():
        found = sorted(p.device for p in list_ports.comports())
        there = f"serial ports here: {', '.join(found)}" if found else "this computer has no serial port"
        return f"no such port; {there}; correct devices.arm.port or plug the U2D2 in"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission to open it; add this user to the group that owns the port (usually dialout)"
    if number in (errno.EBUSY, errno.EAGAIN):
        return "port is busy; another program (a second companion, DYNAMIXEL Wizard) has it open: close that one"
    return f"is not a usable serial port: {error}"


def usb_latency_ms(port: str | None, sysfs: Path = Path("/sys/class/tty")) -> int | None:
    """Return the latency timer of the FTDI chip behind a port, ms, or None without a port or a timer (a pty, a native UART)."""
    if port is None:
        return None
    try:
        return int((sysfs / Path(port).resolve().name / "device" / "latency_timer").read_text())
    except (OSError, ValueError):
        return None
