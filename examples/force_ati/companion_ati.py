"""ATI Net F/T as a force-torque sensor of the companion. It has not been tried with a real sensor yet.

The Net F/T box streams records over UDP (Raw Data Transfer, RDT, port 49152). A request is u16 0x1234, u16 command (2 starts, 0 stops),
u32 number of records (0: no end). A record is u32 RDT sequence, u32 F/T sequence, u32 status, and Fx Fy Fz Tx Ty Tz as i32 counts. Big
endian. The box's web page sets the RDT rate, and shows the counts per unit of force and torque, which must be N and N m.
"""

from __future__ import annotations

import contextlib
import select
import socket
import struct

from companion.config.base import Model, Positive
from companion.config.devices import ForceDevice
from companion.io.force_torque.sensor import Reading

_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">3I6i")
_STOP, _START = 0, 2
_SILENT_READS = 5


class AtiOptions(Model):
    """ATI Net F/T over its UDP stream (RDT)."""

    host: str
    port: int = 49152
    counts_per_n: Positive = 1e6
    counts_per_nm: Positive = 1e6


class AtiNetFt:
    """Reads the stream of one Net F/T box."""

    options = AtiOptions
    product_name = "ATI Net F/T"

    def __init__(self, options: AtiOptions, device: ForceDevice) -> None:
        self._options = options
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._silent_reads = 0
        self._sequence: int | None = None

    def open(self) -> None:
        """Start the stream."""
        self._socket.setblocking(False)
        self._socket.connect((self._options.host, self._options.port))  # receives from this address only
        self._request(_START)

    def read(self) -> Reading | None:
        """Return the newest record, because older ones wait if the box sends faster than it is read; None if none arrives within 0.1 s,
        or if it is not newer than the last.
        """
        select.select((self._socket,), (), (), 0.1)
        record = None
        with contextlib.suppress(OSError):  # no more records, or an ICMP error while the box restarts
            while True:
                record = self._socket.recv(2 * _RECORD.size)
        if record is None:
            self._silent_reads += 1
            if self._silent_reads % _SILENT_READS == 0:
                with contextlib.suppress(OSError):
                    self._request(_START)  # the box may have been restarted
                self._sequence = None
            return None
        self._silent_reads = 0
        sequence, _, status, *counts = _RECORD.unpack(record)
        if self._sequence is not None and (sequence - self._sequence) % 2**32 > 2**31:
            return None
        self._sequence = sequence
        fx, fy, fz = (count / self._options.counts_per_n for count in counts[:3])
        tx, ty, tz = (count / self._options.counts_per_nm for count in counts[3:])
        return Reading((fx, fy, fz), (tx, ty, tz), overload=status != 0)

    def close(self) -> None:
        """Stop the stream."""
        try:
            self._request(_STOP)
        finally:
            self._socket.close()

    def _request(self, command: int) -> None:
        self._socket.send(_REQUEST.pack(0x1234, command, 0))
