"""Servo bus: the real dynamixel-sdk and the arm driver's bus code, behind a serial port in memory.

The port answers what the input says and time is simulated, so that a read that waits for ever is seen at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import ClassVar, Self

from companion.config.devices import ArmDevice
from companion.io.dynamixel import registers as dxl
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.dynamixel.bus import ArmBus
from companion.io.dynamixel.port import NOISE_BYTES, ServoPort
from sitl.servo.bus import ServoLine
from sitl.servo.model import ServoModel
from sitl.servo.protocol import ALERT, Instruction, packet, status
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Endless, Target, Wrong, one_line
from tests.io.arm_rig import JOINTS, arm_config

WIDE = tuple(joint.model_copy(update={"angle_deg": (-180.0, 179.95)}) for joint in JOINTS)
"""The joints of the arm, at any angle."""
IDS = tuple(joint.servo_id for joint in WIDE)
_WATCHDOG_MS = 100
_WATCHDOG = _WATCHDOG_MS // dxl.WATCHDOG_UNIT_MS
_SIZE_MAX_BYTES = 2500
_READ_LIMIT_S = 1.0
"""Limit of simulated time for one cycle."""
_OPEN_LIMIT_S = 30.0
_CLOCK_S = 5e-6
"""Time that a look at the clock takes: code that only looks at it does not hang."""
_REPLACE, _BEFORE, _BEHIND, _SILENCE = range(4)
_READ, _OPEN, _BABBLE = range(3)
"""First byte of an input: answers to a flight's read; damage to the answers while the bus is opened; a line that never falls silent."""


class MemorySerial:
    """The part of a pyserial port that `ServoPort` uses. Waiting advances simulated time; bytes take the time of the wire."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.limit_s = math.inf
        self.answer: Callable[[bytes], bytes] = lambda sent: b""
        self.babble = b""
        """Bytes that repeat without end after the answers."""
        self._waiting = bytearray()

    def write(self, sent: list[int] | bytes) -> int:
        self._waiting += self.answer(bytes(sent))
        return len(sent)

    def read(self, size: int) -> bytes:
        if self.now_s > self.limit_s:
            raise Endless("the bus code still waits for an answer")
        if self.babble and len(self._waiting) < size:
            self._waiting += self.babble * (size // len(self.babble) + 1)
        data = bytes(self._waiting[: max(0, size)])
        del self._waiting[: max(0, size)]
        self.now_s += len(data) * 10.0 / 3e6 + 2e-6 if data or size <= 0 else 1e-3
        return data

    def reset_input_buffer(self) -> None:
        self._waiting.clear()

    def set_low_latency_mode(self, on: bool) -> None:
        """Do nothing: as on a pty there is no latency timer."""

    def close(self) -> None:
        """Do nothing."""


class MemoryPort(ServoPort):
    """The companion's port on a `MemorySerial`."""

    def __init__(self, line: MemorySerial) -> None:
        super().__init__("memory")
        self.ser = line

    def setupPort(self, cflag_baud: int) -> bool:
        self.is_open = True
        self.tx_time_per_byte = 10_000.0 / cflag_baud
        return True

    def writePort(self, packet: list[int] | bytes) -> int:
        written: int = self.ser.write(packet)
        return written

    def _receive(self) -> bytes:
        data: bytes = self.ser.read(NOISE_BYTES)
        return data

    def getCurrentTime(self) -> float:
        self.ser.now_s += _CLOCK_S
        now_ms: float = self.ser.now_s * 1e3
        return now_ms


class DynamixelTarget(Target):
    """See `_READ`, `_OPEN` and `_BABBLE` for the first byte."""

    name: ClassVar[str] = "dynamixel"

    def __init__(self) -> None:
        self._line = MemorySerial()
        self._count = 0
        self._corpus = _corpus()

    def __enter__(self) -> Self:
        self._arm, self._bus = self._new()
        self._line.answer = _servos().feed
        failure = self._arm._open()
        if failure is not None:
            raise failure
        return self

    def __exit__(self, *_: object) -> None:
        self._line.answer, self._line.limit_s = (lambda sent: b""), math.inf
        self._bus.close()

    def make(self, rng: Random) -> bytes:
        kind = rng.random()
        if kind < 0.004:
            return bytes((_BABBLE, rng.randrange(2))) + self._answers(rng)[:200]
        if kind < 0.012:
            return bytes((_OPEN,)) + b"".join(self._damage(rng) for _ in range(rng.choice((1, 1, 2, 5))))
        return bytes((_READ,)) + self._answers(rng)

    def _answers(self, rng: Random) -> bytes:
        """Return damaged answers; in every third the CRC is valid."""
        if rng.random() < 0.67:
            return mutated(rng, self._corpus, _SIZE_MAX_BYTES)
        sealed = b""
        for servo_id in rng.choice((IDS, IDS, IDS, IDS[:1], (IDS[1], IDS[0]), (IDS[0], 7, IDS[1]), (0, 253, 254))):
            block = mutated(rng, [_block(1000, 3), _block(-5, 0xFF), b"\xff\xff\xfd" * 5, b"", bytes(15)], 1100)
            sealed += packet(servo_id, bytes((Instruction.STATUS, rng.choice((0, 0, 0, 1, 0x80, 0x83)))) + block)
        return sealed

    def _damage(self, rng: Random) -> bytes:
        """Return the number of the exchange (of about 70), the kind of damage, and the bytes to use."""
        data = self._answers(rng)[: rng.choice((20, 255))]
        return bytes((rng.randrange(70), rng.randrange(4), len(data))) + data

    def feed(self, data: bytes) -> None:
        if not data:
            return
        if data[0] == _OPEN:
            self._feed_opening(data[1:])
            return
        line = self._line
        opening = data[0] == _BABBLE and len(data) > 2 and data[1] == 1
        line.babble = data[2:] if data[0] == _BABBLE else b""
        line.answer = lambda sent: data[1:]
        try:
            if opening:
                line.answer = _servos().feed
                self._open_another()
            else:
                self._read()
        finally:
            line.babble = b""
            line.reset_input_buffer()
        self._check_that_it_goes_on()

    def _read(self) -> None:
        """Run one cycle of the bus thread."""
        arm, line = self._arm, self._line
        failures = arm._failures
        line.limit_s = line.now_s + _READ_LIMIT_S
        tripped = arm._read_once()
        state = arm.latest()
        if state is None or not all(map(math.isfinite, (*state.angle_rad, *state.velocity_rad_s, *state.torque_nm))):
            raise Wrong(f"a joint state that is not finite: {state}")
        if arm._failures not in (0, failures + 1):
            raise Wrong(f"{arm._failures} failures after {failures}")
        if tripped:
            line.limit_s = line.now_s + _READ_LIMIT_S
            arm._try(self._bus.restart_watchdogs)
        self._no_problem(arm)

    def _check_that_it_goes_on(self) -> None:
        self._count = (self._count + 1) % 4096
        line, counts = self._line, (self._count, 4095 - self._count)
        line.answer = lambda sent: b"".join(
            status(servo_id, 0, _block(count, _WATCHDOG)) for servo_id, count in zip(IDS, counts, strict=True)
        )
        self._read()
        state, scales = self._arm.latest(), self._arm._scales
        assert state is not None and scales is not None
        expected = tuple(scale.angle_rad(count) for scale, count in zip(scales, counts, strict=True))
        if self._arm._failures or state.angle_rad != expected:
            raise Wrong(f"a valid answer behind it is not understood: {state}")

    def _feed_opening(self, program: bytes) -> None:
        damage = _parse_program(program)
        servos, exchange = _servos(), -1

        def answer(sent: bytes) -> bytes:
            nonlocal exchange
            exchange += 1
            whole = servos.feed(sent)
            for kind, noise in damage.get(exchange, ()):
                whole = {_REPLACE: noise, _BEFORE: noise + whole, _BEHIND: whole + noise, _SILENCE: b""}[kind]
            return whole

        self._line.answer = answer
        self._open_another()

    def _open_another(self) -> None:
        arm, bus = self._new()
        self._line.limit_s = self._line.now_s + _OPEN_LIMIT_S
        failure = arm._open()
        if failure is not None:
            one_line(str(failure), "the refusal of the bus")
            if "Error: " in str(failure):
                raise Wrong(f"an exception became the refusal of the bus: {failure}")
        bus.close()

    def _no_problem(self, arm: DynamixelArm) -> None:
        if arm.problem:
            problem, arm.problem = arm.problem, ""
            raise Wrong(f"an exception inside the bus code: {problem}")

    def _new(self) -> tuple[DynamixelArm, ArmBus]:
        device = ArmDevice(port="memory", watchdog_ms=_WATCHDOG_MS)
        arm = DynamixelArm(device, arm_config(*WIDE), lambda: self._line.now_s)
        arm._bus._port = arm._bus._servos.port = MemoryPort(self._line)
        self._line.reset_input_buffer()
        return arm, arm._bus


def _servos() -> ServoLine:
    return ServoLine(
        [ServoModel(servo_id, baud_bps=3_000_000, shaft_angle_rad=3.1) for servo_id in IDS]
    )  # fmt: skip


def _parse_program(program: bytes) -> dict[int, list[tuple[int, bytes]]]:
    """Return the damage per exchange; a truncated program counts as far as it goes."""
    damage: dict[int, list[tuple[int, bytes]]] = {}
    at = 0
    while at + 3 <= len(program):
        exchange, kind, size = program[at : at + 3]
        damage.setdefault(exchange, []).append((kind % 4, program[at + 3 : at + 3 + size]))
        at += 3 + size
    return damage


def _block(position_count: int, watchdog: int) -> bytes:
    """Return the indirect data of one servo, in the layout of `companion.io.dynamixel.registers.BLOCK`."""
    return dxl._BLOCK.pack(position_count, 0, -7, 35, 12, watchdog)


def _corpus() -> list[bytes]:
    """Return answers to the read of a cycle, and every other kind of packet."""
    pairs = [
        b"".join(status(servo_id, error, _block(1000 * k, watchdog)) for k, servo_id in enumerate(IDS))
        for error, watchdog in ((0, _WATCHDOG), (0, 0xFF), (ALERT, _WATCHDOG), (4, _WATCHDOG), (0, 0))
    ]
    return [
        *pairs * 2,
        status(IDS[0], 0, _block(2048, _WATCHDOG)),
        status(IDS[1], 0, _block(2048, _WATCHDOG)),
        status(IDS[0], 0, b"\xff\xff\xfd" * 5),
        status(IDS[0], 0, bytes((6, 4, 45))),
        status(IDS[0], 0),
        status(IDS[0], 0, b"\xff\xff\xfd" * 300),
        packet(IDS[0], bytes((Instruction.READ, 132, 0, 4, 0))),
        b"\xff\xff\xfd\x00",
        b"\xff\xff\xfd\x00\x0b\x00\x04\x55\x00" * 3,
        b"\xff" * 40,
    ]
