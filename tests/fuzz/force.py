"""Force-torque sensor: bytes through a real pty into the read handler of the driver."""

from __future__ import annotations

import asyncio
import math
import os
import select
import time
from contextlib import ExitStack
from random import Random
from typing import ClassVar, Self

from companion.config.devices import ForceDevice
from companion.io.force_torque import rft
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.force_torque.rft import RATE_CODES, Command, Wrench
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, one_line
from tests.support import DEADLINE_S
from tests.wires import serial_line

_SIZE_MAX_BYTES = 3000
"""A pty buffers 4095 bytes."""
_ASKED = (Command.PRODUCT_NAME, Command.FIRMWARE_VERSION, Command.SET_RATE, Command.GET_RATE)
_MARK_N = 20.0
"""Force of the last valid packet after an input; the two before it carry another one."""


class ForceTarget(Target):
    """An input is the bytes on the line."""

    name: ClassVar[str] = "force"

    def __init__(self) -> None:
        self._corpus = _corpus()
        self._marks = [_wrench(0.0), _wrench(0.0), _wrench(_MARK_N)]

    def __enter__(self) -> Self:
        self._loop, self._stack = asyncio.new_event_loop(), ExitStack()
        self._far, port = self._stack.enter_context(serial_line())
        self._edge = RobotousForceTorque(ForceDevice(port=port), time.monotonic)
        self._edge._serial = self._stack.enter_context(self._edge._open())
        self._fd = self._edge._serial.fileno()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        self._loop.close()

    def make(self, rng: Random) -> bytes:
        data = mutated(rng, self._corpus, _SIZE_MAX_BYTES)
        if rng.random() < 0.3 and len(data) >= rft.RESPONSE_BYTES:  # with a sum that fits, so that the content counts
            data = rft.pack(data[1 : rft.RESPONSE_BYTES - 2], rft.RESPONSE_BYTES) + data[rft.RESPONSE_BYTES :]
        return data

    def feed(self, data: bytes) -> None:
        edge = self._edge
        edge._answers = {command: self._loop.create_future() for command in _ASKED}
        before, received = edge.counts(), edge._received_bytes
        # Behind any noise the scanner is in step again two packets later at the latest.
        sent = data + b"".join(self._marks)
        os.write(self._far, sent)
        while edge._received_bytes - received < len(sent):
            if not select.select([self._fd], [], [], DEADLINE_S)[0]:
                raise TimeoutError("the pty did not deliver")
            edge._on_readable()
            if edge._lost is not None:
                raise Wrong(f"the port was given up: {edge._lost}")
        sample = edge.latest()
        if edge._scanner._tail or sample is None or sample.force_sensor_n[0] != _MARK_N:
            edge._scanner = rft.PacketScanner(rft.RESPONSE_BYTES)  # the next input starts afresh
            raise Wrong(f"a valid packet behind it is not understood: {edge.counts()}")
        self._check(before.samples, before.skipped_bytes, len(data))
        edge._latest = None

    def _check(self, samples_before: int, skipped_before: int, size: int) -> None:
        edge, health = self._edge, self._edge.counts()
        sample = edge.latest()
        if sample is None or not all(map(math.isfinite, (*sample.force_sensor_n, *sample.torque_sensor_nm))):
            raise Wrong(f"a sample that is not finite: {sample}")
        samples, skipped = health.samples - samples_before, health.skipped_bytes - skipped_before
        answered = size + rft.RESPONSE_BYTES * len(self._marks) - skipped - rft.RESPONSE_BYTES * samples
        if samples < 1 or answered < 0 or answered % rft.RESPONSE_BYTES:
            raise Wrong(f"{size} bytes are not accounted for: {samples} samples, {skipped} bytes skipped")
        for command, answer in edge._answers.items():
            if not answer.done():
                continue
            field = answer.result()
            RATE_CODES.get(field[1])
            text = rft.decode_text(field)
            if text:
                one_line(text, f"the answer to command {command}")
        edge._answers = {}


def _wrench(force_n: float) -> bytes:
    return rft.encode_wrench(
        Command.START, Wrench(force_n=(force_n, 0.0, 0.0), torque_nm=(0.0, 0.0, 0.0), overload_bits=0)
    )


def _corpus() -> list[bytes]:
    """Return every kind of response, alone and streamed, and commands, which a wrong cable echoes."""
    awkward = Wrench(
        force_n=(0x55AA / 50, -0x55AB / 50, 0x5555 / 50),
        torque_nm=(-0x5556 / 2000, 0x55AA / 2000, 0x55AA / 2000),
        overload_bits=0x3F,
    )
    stream = b"".join(_wrench(0.1 * k) for k in range(20))
    asked = (
        (Command.PRODUCT_NAME, b"RFT60-HA01"),
        (Command.SERIAL_NUMBER, b"S-1"),
        (Command.FIRMWARE_VERSION, b"V1.2"),
    )
    texts = [rft.pack(bytes((command,)) + text, rft.RESPONSE_BYTES) for command, text in asked]
    rates = [rft.pack(bytes((command, 5, 0)), rft.RESPONSE_BYTES) for command in (Command.GET_RATE, Command.SET_RATE)]
    echoes = [rft.encode_command(command, 1) for command in Command]
    return [
        *[stream] * 4,
        *[rft.encode_wrench(Command.START, awkward)] * 2,
        rft.encode_wrench(Command.READ_ONCE, awkward) * 5,
        *texts,
        *rates,
        *echoes,
        bytes((rft.SOP,)) * 60,
    ]
