"""An emulated Robotous RFT60-HA01 force-torque sensor on a pty.

It answers commands 1, 2, 3, 10, 11, 12, 15, 16 and 17 as the real sensor does (see `companion.io.force_torque.rft`). While streaming,
it executes only STOP and SET_BIAS, which have no answer. Readings are quantised to 1/50 N and 1/2000 N m. The caller adds noise and
latency.
"""

from __future__ import annotations

from typing import Final, Self

from companion.io.force_torque import rft
from companion.io.force_torque.rft import Command, Overload, PacketScanner, SetError, Wrench
from companion.model.algebra import minus
from companion.model.types import Vec3
from sitl.pty import PtyLine

FORCE_CAPACITY_N: Final = 200.0
TORQUE_CAPACITY_NM: Final = 4.0
_ZERO: Vec3 = (0.0, 0.0, 0.0)
_FORCE_BITS = (Overload.FX, Overload.FY, Overload.FZ)
_TORQUE_BITS = (Overload.TX, Overload.TY, Overload.TZ)
TIME_EPSILON_S: Final = 1e-9
_MAX_CATCH_UP = 8  # packets; if the world's time jumps further, the rest is skipped


def quantised(force_n: Vec3, torque_nm: Vec3) -> tuple[Vec3, Vec3]:
    """Return a reading as the companion receives it, rounded to the protocol's counts."""
    fx, fy, fz = force_n
    tx, ty, tz = torque_nm
    force, torque = rft.FORCE_PER_N, rft.TORQUE_PER_NM
    return (
        (round(fx * force) / force, round(fy * force) / force, round(fz * force) / force),
        (round(tx * torque) / torque, round(ty * torque) / torque, round(tz * torque) / torque),
    )


def overloaded(force_n: Vec3, torque_nm: Vec3) -> bool:
    """Return whether the load on any axis exceeds that axis's capacity."""
    fx, fy, fz = force_n
    tx, ty, tz = torque_nm
    return (
        abs(fx) > FORCE_CAPACITY_N
        or abs(fy) > FORCE_CAPACITY_N
        or abs(fz) > FORCE_CAPACITY_N
        or abs(tx) > TORQUE_CAPACITY_NM
        or abs(ty) > TORQUE_CAPACITY_NM
        or abs(tz) > TORQUE_CAPACITY_NM
    )


class ForceTorqueServer:
    """The emulated sensor; an async context manager on the running event loop.

    Args:
        product_name: answer to PRODUCT_NAME.
        in_lockstep: whether a packet is sent only when the companion can read it.

    Attributes:
        silent: fault in which the sensor neither answers nor streams, as with a cut cable.
        stuck: fault in which the sensor repeats its last reading.
        dropped: number of packets that were dropped because nothing reads the pty.
    """

    def __init__(self, product_name: str = "RFT60-HA01", *, in_lockstep: bool = False) -> None:
        self.silent = False
        self.stuck = False
        self.dropped = 0
        self._texts = {
            Command.PRODUCT_NAME: product_name,
            Command.SERIAL_NUMBER: "RFT60HA-0001",
            Command.FIRMWARE_VERSION: "V1.2.0",
        }
        self._scanner = PacketScanner(rft.COMMAND_BYTES)
        self._pty = PtyLine(self._on_commands)
        self._pty.is_counted = in_lockstep
        self._force_n: Vec3 = _ZERO
        self._torque_nm: Vec3 = _ZERO
        self._bias_force_n: Vec3 = _ZERO
        self._bias_torque_nm: Vec3 = _ZERO
        self._rate_code = 0
        self.streaming = False
        """Whether continuous output is on."""
        self._due_s: float | None = None
        self._reading = Wrench(force_n=_ZERO, torque_nm=_ZERO, overload_bits=0)

    @property
    def port(self) -> str:
        """Path of the tty that the companion opens."""
        return self._pty.path

    @property
    def rate_hz(self) -> int:
        """Present output rate in Hz."""
        return rft.RATE_CODES[self._rate_code]

    async def __aenter__(self) -> Self:
        self._pty.open()
        return self

    async def __aexit__(self, *_: object) -> None:
        self._pty.close()

    def set_wrench(self, force_n: Vec3, torque_nm: Vec3) -> None:
        """Set the true wrench on the sensor: force in N and torque in N m, in the sensor frame."""
        self._force_n = force_n
        self._torque_nm = torque_nm

    def start_over(self) -> None:
        """Send the next packet at world time zero: world time starts over."""
        self._due_s = 0.0

    def await_arrival(self) -> None:
        """Wait until the companion can read what was sent, in a world in lockstep."""
        self._pty.await_arrival()

    def due(self, t_s: float) -> bool:
        """Return whether a packet is due by world time `t_s`."""
        return self.streaming and (self._due_s is None or t_s >= self._due_s - TIME_EPSILON_S)

    def tick(self, t_s: float) -> None:
        """Send every packet that is due by world time `t_s`; call this method every 1 to 2 ms of world time."""
        if not self.streaming:
            return
        period_s = 1.0 / self.rate_hz
        if self._due_s is None or t_s - self._due_s > _MAX_CATCH_UP * period_s:
            self._due_s = t_s
        while self._due_s <= t_s + TIME_EPSILON_S:
            self._due_s += period_s
            self._send_reading(Command.START)

    def inject(self, noise: bytes) -> None:
        """Send bytes on the line unchanged, for example noise or half a packet."""
        self._write(noise)

    def _measure(self) -> Wrench:
        if self.stuck:
            return self._reading
        bits = 0
        for value, bit in zip(self._force_n, _FORCE_BITS, strict=True):
            bits |= bit if abs(value) > FORCE_CAPACITY_N else 0
        for value, bit in zip(self._torque_nm, _TORQUE_BITS, strict=True):
            bits |= bit if abs(value) > TORQUE_CAPACITY_NM else 0
        self._reading = Wrench(
            force_n=minus(self._force_n, self._bias_force_n),
            torque_nm=minus(self._torque_nm, self._bias_torque_nm),
            overload_bits=bits,
        )
        return self._reading

    def _send_reading(self, command: Command) -> None:
        self._write(rft.encode_wrench(command, self._measure()))

    def _write(self, packet: bytes) -> None:
        if not self.silent and self._pty.write(packet):
            self.dropped += 1

    def _on_commands(self, received: bytes) -> None:
        for field in self._scanner.feed(received):
            if not self.silent:
                self._execute(Command(field[0]), field[1])

    def _execute(self, command: Command, parameter: int) -> None:
        if command == Command.STOP:
            self.streaming = False
            return
        if command == Command.SET_BIAS:
            self._bias_force_n = self._force_n if parameter else _ZERO
            self._bias_torque_nm = self._torque_nm if parameter else _ZERO
            return
        if self.streaming:
            return
        if command == Command.START:
            self.streaming = True
            self._due_s = None
        elif command == Command.READ_ONCE:
            self._send_reading(Command.READ_ONCE)
        elif command == Command.SET_RATE:
            known = parameter in rft.RATE_CODES
            if known:
                self._rate_code = parameter
            error = SetError.NONE if known else SetError.VALUE_RANGE
            self._write(rft.pack(bytes((command, int(known), error)), rft.RESPONSE_BYTES))
        elif command == Command.GET_RATE:
            self._write(rft.pack(bytes((command, self._rate_code)), rft.RESPONSE_BYTES))
        else:
            text = self._texts[command].encode("ascii")[:15]
            self._write(rft.pack(bytes((command,)) + text, rft.RESPONSE_BYTES))
