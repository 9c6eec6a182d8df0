"""The force-torque edge against the emulated sensor on a pty, and its packet codec."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config.devices import ForceDevice
from companion.io.force_torque import rft
from companion.io.force_torque.driver import RobotousForceTorque
from companion.io.force_torque.rft import Command, PacketScanner, Wrench
from companion.io.protocols import DeviceError, ForceTorque
from companion.model.types import ForceSample
from companion.runtime.clock import flight_clock
from sitl.force_torque import ForceTorqueServer
from tests.io.refusal import refusal
from tests.support import DEADLINE_S
from tests.wires import plugged, serial_line

counts = st.integers(-32768, 32767) | st.sampled_from([0x55AA, -0x55AB, 0x5555, -0x5556, 0x0055, 0x00AA])
wrenches = st.tuples(*[counts] * 6, st.integers(0, 255)).map(
    lambda c: Wrench(
        force_n=(c[0] / 50, c[1] / 50, c[2] / 50), torque_nm=(c[3] / 2000, c[4] / 2000, c[5] / 2000), overload_bits=c[6]
    )
)


# -- codec ---------------------------------------------------------------------------------------------------------------------


def test_golden_packets() -> None:
    assert rft.encode_command(Command.START).hex() == "550b000000000000000baa"
    assert rft.encode_command(Command.SET_RATE, 6).hex() == "550f0600000000000015aa"
    assert rft.encode_command(Command.SET_BIAS, 1).hex() == "5511010000000000" + "0012aa"
    wrench = Wrench(force_n=(1.0, -1.0, 200.0), torque_nm=(0.5, -0.0005, 4.0), overload_bits=0x20)
    packet = rft.encode_wrench(Command.START, wrench)
    assert packet.hex() == "55" + "0b" + "0032" + "ffce" + "2710" + "03e8" + "ffff" + "1f40" + "20" + "0000" + "a9aa"
    assert rft.decode_wrench(packet[1:-2]) == wrench


def test_text() -> None:
    assert rft.decode_text(b"\x01RFT60-HA01\0\0\0\0\0") == "RFT60-HA01"
    assert "\n" not in rft.decode_text(b"\x01RFT\n\x9960-HA01\0\0\0")


@given(
    sent=st.lists(wrenches, min_size=1, max_size=6),
    gaps=st.lists(st.binary(max_size=25).map(lambda noise: noise.replace(b"\x55", b"\xaa")), min_size=6, max_size=6),
    cuts=st.lists(st.integers(1, 40), min_size=1, max_size=5),
)
def test_no_packet_is_missed_however_the_stream_is_cut(sent: list[Wrench], gaps: list[bytes], cuts: list[int]) -> None:
    stream = b"".join(gap + rft.encode_wrench(Command.START, wrench) for gap, wrench in zip(gaps, sent, strict=False))
    scanner = PacketScanner(rft.RESPONSE_BYTES)
    found: list[bytes] = []
    position, step = 0, 0
    while position < len(stream):
        size = cuts[step % len(cuts)]
        found += scanner.feed(stream[position : position + size])
        position, step = position + size, step + 1
    assert [rft.decode_wrench(field) for field in found] == sent
    assert scanner.packets == len(sent)
    assert scanner.skipped_bytes == sum(map(len, gaps[: len(sent)]))


@given(wrench=wrenches, position=st.integers(0, 18), change=st.integers(1, 255))
def test_one_wrong_byte_is_always_noticed(wrench: Wrench, position: int, change: int) -> None:
    packet = bytearray(rft.encode_wrench(Command.START, wrench))
    packet[position] ^= change
    assert PacketScanner(rft.RESPONSE_BYTES).feed(bytes(packet)) == []


# -- driver and sensor -----------------------------------------------------------------------------------------------------------


def device_on(port: str, **changes: object) -> ForceDevice:
    return ForceDevice.model_validate({"port": port} | changes)


def driver(port: str, answer_timeout_s: float = DEADLINE_S, **changes: object) -> RobotousForceTorque:
    return RobotousForceTorque(device_on(port, **changes), flight_clock(), answer_timeout_s=answer_timeout_s)


@asynccontextmanager
async def world(server: ForceTorqueServer) -> AsyncIterator[None]:
    """Tick the sensor in real time."""

    async def tick() -> None:
        loop = asyncio.get_running_loop()
        while True:
            server.tick(loop.time())
            await asyncio.sleep(0.002)

    ticking = asyncio.create_task(tick())
    try:
        yield
    finally:
        ticking.cancel()
        await asyncio.gather(ticking, return_exceptions=True)


async def sample_with(edge: RobotousForceTorque, force_x_n: float) -> ForceSample:
    """The first sample that shows a force."""
    async with asyncio.timeout(DEADLINE_S):
        while True:
            for sample in await edge.tare_samples(0.005):
                if sample.force_sensor_n[0] == force_x_n:
                    return sample


async def test_samples_arrive_quantised() -> None:
    async with ForceTorqueServer() as server, world(server):
        server.set_wrench((1.013, -2.0, 30.0), (0.12345, -0.0002, 1.0))
        async with driver(server.port) as edge:
            source: ForceTorque = edge
            sample = source.latest()
            assert sample is not None
            assert sample.force_sensor_n == (1.02, -2.0, 30.0)
            assert sample.torque_sensor_nm == (0.1235, 0.0, 1.0)
            assert not sample.overload
            assert edge.product_name == "RFT60-HA01"
            assert edge.firmware == "V1.2.0"
            assert server.streaming
            assert server.rate_hz == 200
            server.set_wrench((5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            later = await sample_with(edge, 5.0)
            assert later.stamp_s >= sample.stamp_s
        async with asyncio.timeout(DEADLINE_S):
            while server.streaming:  # noqa: ASYNC110 - the STOP is read by another task, no event to wait for
                await asyncio.sleep(0.001)


async def test_reopening_a_sensor_that_still_streams() -> None:
    async with ForceTorqueServer() as server, world(server):
        crashed = driver(server.port)
        await crashed.__aenter__()
        crashed._send = lambda *_: None  # type: ignore[method-assign]  # killed before it could say STOP
        await crashed.__aexit__(None, None, None)
        assert server.streaming
        async with driver(server.port) as edge:
            assert edge.latest() is not None


async def test_rate_is_set_and_read_back() -> None:
    async with ForceTorqueServer() as server, world(server):
        async with driver(server.port, rate_hz=333):
            assert server.rate_hz == 333
        async with driver(server.port, rate_hz=200):
            assert server.rate_hz == 200


async def test_overload_by_the_sensor_and_by_the_device_file() -> None:
    async with ForceTorqueServer() as server, world(server), driver(server.port, force_max_n=50.0) as edge:
        server.set_wrench((60.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        assert (await sample_with(edge, 60.0)).overload
        server.set_wrench((40.0, 0.0, 0.0), (0.0, 0.0, 4.1))
        assert (await sample_with(edge, 40.0)).overload
        server.set_wrench((30.0, 0.0, 0.0), (0.0, 0.0, 3.9))
        assert not (await sample_with(edge, 30.0)).overload


async def test_tare_takes_the_samples_that_it_was_asked_for() -> None:
    async with ForceTorqueServer() as server, world(server):
        server.set_wrench((1.2, -0.8, 2.5), (0.0, 0.0, 0.0))
        async with driver(server.port) as edge:
            samples = await edge.tare_samples(0.25)
            assert len(samples) == 50
            assert {sample.force_sensor_n for sample in samples} == {(1.2, -0.8, 2.5)}


async def test_sensor_falls_silent_in_flight() -> None:
    async with ForceTorqueServer() as server, world(server), driver(server.port) as edge:
        server.silent = True
        with pytest.raises(
            DeviceError, match="of 100 samples received, none in the last 1 s, while taring; the sensor fell silent"
        ):
            await edge.tare_samples(0.5)
        assert edge.latest() is not None


async def test_in_flight_the_ticks_read_the_port() -> None:
    async with ForceTorqueServer() as server:
        async with world(server):
            edge = await driver(server.port).__aenter__()
            edge.read_in_ticks()
            server.set_wrench((5.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            before = edge.counts().samples
            async with asyncio.timeout(DEADLINE_S):
                while (sample := edge.latest()) is None or sample.force_sensor_n[0] != 5.0:  # noqa: ASYNC110 - as the ticks do
                    await asyncio.sleep(0.005)
            assert edge.counts().samples > before
        edge.latest()
        assert edge.latest() is edge.latest()  # no new bytes: not lost
        assert edge.counts().lost is None
    edge.latest()
    assert edge.counts().lost is not None
    await edge.__aexit__(None, None, None)


async def test_port_vanishes_in_flight() -> None:
    server = ForceTorqueServer()
    async with server, world(server):
        edge = await driver(server.port).__aenter__()
    last = edge.latest()
    with pytest.raises(DeviceError, match="the port was lost"):
        await edge.tare_samples(10.0)
    assert edge.latest() == last
    assert edge.counts().lost is not None
    await edge.__aexit__(None, None, None)


@pytest.mark.parametrize("in_ticks", [False, True])
async def test_a_port_that_comes_back_under_its_name_is_read_again(tmp_path: Path, in_ticks: bool) -> None:
    """The second sensor has just got its power: it streams nothing until it is started."""

    async with AsyncExitStack() as stack:
        async with ForceTorqueServer() as server, world(server):
            with plugged(tmp_path / "force", server.port) as port:
                edge = await stack.enter_async_context(driver(port))
                if in_ticks:
                    edge.read_in_ticks()
        await looked_at(edge, lambda sample: edge.counts().lost is not None)
        async with ForceTorqueServer() as server, world(server):
            server.set_wrench((7.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            with plugged(tmp_path / "force", server.port):
                await looked_at(edge, lambda sample: sample.force_sensor_n[0] == 7.0)
                assert edge.counts().lost is None


class DeafToStart(ForceTorqueServer):
    """Misses the first START."""

    missed = False

    def _execute(self, command: Command, parameter: int) -> None:
        if command == Command.START and not self.missed:
            self.missed = True
        else:
            super()._execute(command, parameter)


async def test_a_lost_start_command_is_repeated_after_the_port_was_reopened(tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        async with ForceTorqueServer() as server, world(server):
            with plugged(tmp_path / "force", server.port) as port:
                edge = await stack.enter_async_context(driver(port, 1.0))
        await looked_at(edge, lambda sample: edge.counts().lost is not None)
        async with DeafToStart() as server, world(server):
            server.set_wrench((7.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            with plugged(tmp_path / "force", server.port):
                await looked_at(edge, lambda sample: sample.force_sensor_n[0] == 7.0)
                assert server.missed


async def test_the_start_of_a_sensor_is_cancelled_if_its_port_is_lost_again(tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        async with ForceTorqueServer() as server, world(server):
            with plugged(tmp_path / "force", server.port) as port:
                edge = await stack.enter_async_context(driver(port))
        await looked_at(edge, lambda sample: edge.counts().lost is not None)
        async with ForceTorqueServer() as server:
            server.silent = True
            with plugged(tmp_path / "force", server.port):
                await looked_at(edge, lambda sample: edge.counts().lost is None)
                (starting,) = (task for task in asyncio.all_tasks() if "_start_again" in repr(task.get_coro()))
        await looked_at(edge, lambda sample: edge.counts().lost is not None)
        await asyncio.wait((starting,), timeout=5.0)
        assert starting.cancelled()


async def test_another_device_under_its_name_is_not_read_as_the_sensor(tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        async with ForceTorqueServer() as server, world(server):
            with plugged(tmp_path / "force", server.port) as port:
                edge = await stack.enter_async_context(driver(port))
        async with ForceTorqueServer("RFT40-SA01") as server, world(server):
            with plugged(tmp_path / "force", server.port):
                await looked_at(edge, lambda sample: "expected a RFT60-HA01" in (edge.counts().lost or ""))
                assert not server.streaming


async def looked_at(edge: RobotousForceTorque, condition: Callable[[ForceSample], bool]) -> None:
    """Look at the newest sample, as the ticks do, until the condition holds."""
    async with asyncio.timeout(DEADLINE_S):
        while (sample := edge.latest()) is None or not condition(sample):  # noqa: ASYNC110 - as the ticks do
            await asyncio.sleep(0.005)


# -- what can be wrong ---------------------------------------------------------------------------------------------------------


def test_no_such_port() -> None:
    text = asyncio.run(refusal(driver("/dev/no-such-port")))
    assert text.startswith("force sensor /dev/no-such-port: no such port; serial ports of this computer: ")


async def test_port_in_use() -> None:
    async with ForceTorqueServer() as server, world(server), driver(server.port):
        assert "in use by another program" in await refusal(driver(server.port))


def test_port_that_is_a_file(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a port")
    assert "not usable as a serial port" in asyncio.run(refusal(driver(str(path))))
    assert path.read_text() == "not a port"


async def test_silent_sensor() -> None:
    async with ForceTorqueServer() as server:
        server.silent = True
        text = await refusal(driver(server.port, answer_timeout_s=0.2))
        assert "no answer to command 1 (PRODUCT_NAME) within 0.2 s, nothing was received" in text


async def test_sensor_that_answers_but_never_streams() -> None:
    async with ForceTorqueServer() as server:  # no world, so it never ticks
        text = await refusal(driver(server.port, answer_timeout_s=1.0))
        assert "0 of 5 samples after START within 1 s" in text


async def test_a_sensor_of_another_model_is_refused() -> None:
    async with ForceTorqueServer(product_name="RFT40-SA01") as server:
        assert 'a "RFT40-SA01" answers, expected a RFT60-HA01' in await refusal(driver(server.port))


@contextmanager
def babbler(garbage: bytes) -> Iterator[str]:
    """A tty whose other end answers every question with garbage."""
    loop = asyncio.get_running_loop()
    with serial_line() as (far, port):
        loop.add_reader(far, lambda: os.write(far, garbage) if os.read(far, 100) else None)
        try:
            yield port
        finally:
            loop.remove_reader(far)


async def test_wrong_checksums() -> None:
    packet = bytearray(rft.pack(b"\x01RFT60-HA01", rft.RESPONSE_BYTES))
    packet[-2] ^= 0xFF
    with babbler(bytes(packet)) as port:
        text = await refusal(driver(port, answer_timeout_s=1.0))
        assert "bytes received but no valid packet" in text
        assert "(0 wrong checksums)" not in text
        assert "baud rate (115200)" in text


# -- the emulated sensor alone -------------------------------------------------------------------------------------------------
