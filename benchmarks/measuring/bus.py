"""Joint read to current write with dynamixel-sdk alone."""

from __future__ import annotations

import asyncio
import multiprocessing
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.measuring.far_end import prepare_far_end
from benchmarks.measuring.hovering import MISSION
from benchmarks.measuring.latency import DEADLINE_S, RATE_HZ, WARM_UP, Latency
from companion.launcher.sitl_process import SitlProcess
from companion.runtime.event_loop import run
from companion.sitl_config.loader import load_sitl

# Present current, velocity and position of an XM430 lie together (126, 10 bytes); goal current is 102.
_PRESENT_ADDRESS, _PRESENT_BYTES, _GOAL_CURRENT_ADDRESS, _GOAL_CURRENT_BYTES = 126, 10, 102, 2
_RETURN_DELAY_ADDRESS = 9
_BAUD_BPS = 3_000_000
_SERVO_IDS = (1, 2)
FAILED_MAX = 0.1
"""Largest share of cycles without an answer; a computer that stalls as a whole misses some."""


def _servos(parent: Connection) -> None:
    """Serve two emulated servos on a pty until the parent ends it."""
    from sitl.servo.bus import ServoBus
    from sitl.servo.model import ServoModel

    prepare_far_end()

    async def serve() -> None:
        async with ServoBus([ServoModel(servo_id, baud_bps=_BAUD_BPS) for servo_id in _SERVO_IDS]) as bus:
            parent.send(bus.path)
            await asyncio.to_thread(parent.poll, 10 * DEADLINE_S)

    run(serve())


@dataclass(frozen=True, slots=True)
class BusCycles:
    """Cycles of sync read and sync write with dynamixel-sdk alone."""

    command_ms: Latency
    """Time from the end of the read to the end of the write."""
    cycle_ms: Latency
    """Time from the start of the read to the end of the write."""
    failed: int
    """Number of cycles without an answer, which are not counted."""
    request_bytes: int
    """Bytes of one cycle on the wire: read packet, answers of all servos, write packet."""
    answer_bytes: int
    write_bytes: int
    baud_bps: int = _BAUD_BPS

    @property
    def wire_ms(self) -> float:
        """Shortest time of one cycle on the wire, with 10 bits per byte."""
        return 1e4 * (self.request_bytes + self.answer_bytes + self.write_bytes) / self.baud_bps


def measure(folder: Path, samples: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure on a bus of its own, then on the world's; the folder is for the world's files."""
    say("bare dynamixel-sdk, a bus of its own")
    alone = bare_dynamixel(samples + WARM_UP)
    say("bare dynamixel-sdk, the world's bus")
    in_world = bare_dynamixel_in_world(samples + WARM_UP, MISSION, folder)
    return {"alone": {**asdict(alone), "wire_ms": alone.wire_ms}, "in_world": asdict(in_world)}


def bare_dynamixel(cycles: int) -> BusCycles:
    """Measure against two emulated servos in their own process."""
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    bus = spawn.Process(target=_servos, args=(there,))
    bus.start()
    try:
        if not here.poll(DEADLINE_S):
            raise RuntimeError("the emulated servo bus did not start")
        return _bus_cycles(here.recv(), cycles)
    finally:
        here.send("stop")
        bus.join(5.0)
        if bus.is_alive():
            bus.terminate()
            bus.join()


def bare_dynamixel_in_world(cycles: int, mission: Path, folder: Path) -> BusCycles:
    """Measure against the servo bus of a simulated world, as a flight uses it.

    Args:
        cycles: number of cycles.
        mission: mission with the start position.
        folder: folder for the world's files.

    Raises:
        LaunchError: the world did not start.
    """
    world = SitlProcess.start(load_sitl(mission), folder)
    try:
        return _bus_cycles(world.devices()["arm"]["port"], cycles)
    finally:
        world.stop()


def _bus_cycles(path: str, cycles: int) -> BusCycles:
    """Run dynamixel-sdk's sync read and sync write at 200 Hz, without real-time priority: the SDK polls the port without a pause and
    would block the kernel thread that delivers the answer."""
    from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

    port, packet = PortHandler(path), PacketHandler(2.0)
    if not port.openPort() or not port.setBaudRate(_BAUD_BPS):
        raise RuntimeError(f"dynamixel-sdk cannot open {path}")
    try:
        for servo_id in _SERVO_IDS:
            packet.write1ByteTxRx(
                port, servo_id, _RETURN_DELAY_ADDRESS, 0
            )  # 0.5 ms each by default; the companion does the same
        read = GroupSyncRead(port, packet, _PRESENT_ADDRESS, _PRESENT_BYTES)
        write = GroupSyncWrite(port, packet, _GOAL_CURRENT_ADDRESS, _GOAL_CURRENT_BYTES)
        for servo_id in _SERVO_IDS:
            read.addParam(servo_id)
            write.addParam(servo_id, bytes(_GOAL_CURRENT_BYTES))

        def cycle() -> tuple[float, float, float] | None:
            begun_s = time.monotonic()
            failed = read.txRxPacket()
            read_s = time.monotonic()
            if failed:
                said.append(packet.getTxRxResult(failed))
                return None
            for servo_id in _SERVO_IDS:
                position = read.getData(servo_id, 132, 4)
                write.changeParam(servo_id, (position % 2).to_bytes(_GOAL_CURRENT_BYTES, "little"))
            write.txPacket()
            return begun_s, read_s, time.monotonic()

        said: list[str] = []
        times: list[tuple[float, float, float]] = []
        due_s = time.monotonic()
        for _ in range(cycles):
            due_s += 1.0 / RATE_HZ
            time.sleep(max(0.0, due_s - time.monotonic()))
            taken = cycle()
            if taken is not None:
                times.append(taken)
        sent, received = _counted(port)
        if cycle() is None or len(said) > FAILED_MAX * cycles:
            raise RuntimeError(f"{len(said)} of {cycles} sync reads failed: {said[-1]}")
    finally:
        port.closePort()
    request, written = sent
    return BusCycles(
        command_ms=Latency.of(written_s - read_s for _, read_s, written_s in times[WARM_UP:]),
        cycle_ms=Latency.of(written_s - begun_s for begun_s, _, written_s in times[WARM_UP:]),
        failed=len(said),
        request_bytes=request,
        answer_bytes=sum(received),
        write_bytes=written,
    )


def _counted(port: Any) -> tuple[list[int], list[int]]:
    """Record the lengths of all writes to a port and of all reads from it from now on."""
    sent: list[int] = []
    received: list[int] = []
    write, read = port.writePort, port.readPort

    def count_write(packet: Sequence[int]) -> Any:
        sent.append(len(packet))
        return write(packet)

    def count_read(length: int) -> Any:
        data = read(length)
        received.append(len(data))
        return data

    port.writePort, port.readPort = count_write, count_read
    return sent, received
