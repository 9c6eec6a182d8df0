"""Faults where they meet a wire or another process: noise on the bus, a slow link, a recorder that cannot write."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from companion.model.constants import TICK_PERIOD_S
from companion.model.types import AutopilotStatus, FlightMode, LandedState, VehicleState
from companion.sitl_config.faults import Fault
from companion.sitl_config.loader import load_sitl
from sitl.fast.link import FastLink
from sitl.fast.loop import FastFlight
from sitl.faults.processes import inject_process_fault
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from sitl.servo.protocol import packet, status
from tests.sitl.simulated_devices import turns_until
from tests.support import CATCH, DEADLINE_S

# -- the servo bus -----------------------------------------------------------------------------------------------------

_LED = 65


def test_a_damaged_instruction_is_heard_by_nobody() -> None:
    async def scenario() -> tuple[int, bytes]:
        servo = ServoModel(1)
        async with ServoBus([servo], wire_time=False) as bus:
            asked: list[bool] = []

            def first_only() -> bool:
                asked.append(not asked)
                return asked[-1]

            bus.damaged = first_only
            fd = os.open(bus.path, os.O_RDWR | os.O_NOCTTY)
            try:
                speed = termios.tcgetattr(fd)
                speed[4] = speed[5] = termios.B3000000
                termios.tcsetattr(fd, termios.TCSANOW, speed)
                os.write(fd, packet(1, bytes((3, _LED, 0, 1))))
                await turns_until(lambda: len(asked) == 1)
                os.write(fd, packet(1, bytes((2, 0, 0, 6, 0))))
                expected = status(1, 0, servo.read(0, 6))
                return servo.read(_LED, 1)[0], await _read(fd, len(expected))
            finally:
                os.close(fd)

    led, answer = asyncio.run(scenario())
    assert led == 0, "the damaged write was carried out"
    assert answer == status(1, 0, ServoModel(1).read(0, 6)), "and the answer to it came first"


def test_a_delayed_answer_comes_that_much_later() -> None:
    delay_s = 0.03

    async def scenario() -> float:
        async with ServoBus([ServoModel(1)]) as bus:
            bus.answers_late_s = delay_s
            fd = os.open(bus.path, os.O_RDWR | os.O_NOCTTY)
            try:
                speed = termios.tcgetattr(fd)
                speed[4] = speed[5] = termios.B3000000
                termios.tcsetattr(fd, termios.TCSANOW, speed)
                asked_s = asyncio.get_running_loop().time()
                os.write(fd, packet(1, bytes((2, 0, 0, 6, 0))))
                await _read(fd, len(status(1, 0, bytes(6))))
                return asyncio.get_running_loop().time() - asked_s
            finally:
                os.close(fd)

    assert asyncio.run(scenario()) >= delay_s


async def _read(fd: int, size: int) -> bytes:
    loop = asyncio.get_running_loop()
    data = b""
    while len(data) < size:
        ready: asyncio.Future[None] = loop.create_future()
        loop.add_reader(fd, ready.set_result, None)
        try:
            await asyncio.wait_for(ready, DEADLINE_S)
        finally:
            loop.remove_reader(fd)
        data += os.read(fd, size - len(data))
    return data


# -- the link of the fast loop -----------------------------------------------------------------------------------------


@pytest.fixture
def flight() -> FastFlight:
    return FastFlight(load_sitl(CATCH))


def at_rest(t_s: float) -> tuple[VehicleState, AutopilotStatus]:
    level = (1.0, 0.0, 0.0, 0.0)
    nothing = (0.0, 0.0, 0.0)
    state = VehicleState(
        position_stamp_s=t_s,
        attitude_stamp_s=t_s,
        imu_stamp_s=t_s,
        position_world_m=(t_s, 0.0, 0.0),
        velocity_world_m_s=nothing,
        attitude_wxyz=level,
        angular_rate_body_rad_s=nothing,
        specific_force_body_m_s2=(0.0, 0.0, 9.81),
        boot_s=t_s,
    )
    return state, AutopilotStatus(
        heartbeat_stamp_s=t_s,
        armed=True,
        mode=FlightMode.OFFBOARD,
        landed=LandedState.IN_AIR,
        battery_voltage_v=16.0,
        battery_remaining=1.0,
    )


def test_over_a_slow_link_everything_comes_in_order_and_that_much_later(flight: FastFlight) -> None:
    world, link = flight.plant.world, FastLink(flight.faults, flight.plant.world, flight.px4, TICK_PERIOD_S)
    arrived: list[tuple[float, float]] = []
    flight.faults.active["link_delay"] = Fault(kind="link_delay", t_s=0.0, size=0.05)
    for tick in range(40):
        world.t_s = t_s = round(tick * TICK_PERIOD_S, 4)
        link.deliver_due()
        link.send(lambda sent_s=t_s: arrived.append((sent_s, world.t_s)))  # type: ignore[misc]
        state, heard = link.receive(*at_rest(t_s))
        assert state is not None and heard is not None
        if tick >= 10:
            assert state.position_world_m[0] == pytest.approx(t_s - 0.05), "what was said then"
            assert state.attitude_stamp_s == heard.heartbeat_stamp_s == pytest.approx(t_s), "but it arrives now"
            assert state.boot_s == pytest.approx(t_s - 0.05)
    assert [sent_s for sent_s, _ in arrived] == sorted(sent_s for sent_s, _ in arrived)
    assert len(arrived) == 30
    assert all(at_s - sent_s == pytest.approx(0.05) for sent_s, at_s in arrived)


def test_a_link_that_slows_down_in_flight_brings_nothing_twice(flight: FastFlight) -> None:
    """Its messages keep their order: for as long as the delay grows, the last word stays."""
    world, link = flight.plant.world, FastLink(flight.faults, flight.plant.world, flight.px4, TICK_PERIOD_S)
    heard: list[float | None] = []
    for tick in range(60):
        world.t_s = t_s = round(tick * TICK_PERIOD_S, 4)
        if tick == 20:
            flight.faults.active["link_delay"] = Fault(kind="link_delay", t_s=0.0, size=0.05)
        if tick == 40:
            flight.faults.active.clear()
        state, _ = link.receive(*at_rest(t_s))
        assert state is not None
        heard.append(state.boot_s)
    ticks = [round(boot_s / TICK_PERIOD_S) for boot_s in heard if boot_s is not None]
    assert ticks == [*range(20), *[19] * 10, *range(20, 30), *range(40, 60)]


def test_over_a_dead_link_nothing_comes_and_the_last_word_stays(flight: FastFlight) -> None:
    world, link = flight.plant.world, FastLink(flight.faults, flight.plant.world, flight.px4, TICK_PERIOD_S)
    last = link.receive(*at_rest(0.0))
    flight.faults.active["link_loss"] = Fault(kind="link_loss", t_s=0.0)
    world.t_s = 1.0
    link.send(lambda: pytest.fail("it arrived"))
    link.deliver_due()
    assert link.receive(*at_rest(1.0)) == last
    flight.faults.active.clear()
    assert link.receive(*at_rest(1.0)) == at_rest(1.0)
    assert last[1] is not None
    assert replace(last[1], heartbeat_stamp_s=1.0) == at_rest(1.0)[1]


# -- processes ---------------------------------------------------------------------------------------------------------

_WRITER = """
import sys
with open(sys.argv[2], "wb", buffering=0) as file:
    file.write(b"before")
    print("ready", flush=True)
    sys.stdin.readline()
    try:
        file.write(b"after")
    except OSError as error:
        print(error.errno, flush=True)
"""


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A child process with the recorder's command line that writes on request."""
    command = [sys.executable, "-c", _WRITER, "companion.recorder.main", str(tmp_path / "log")]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate(timeout=DEADLINE_S)


def test_on_a_full_disk_the_recorder_alone_cannot_write(recorder: subprocess.Popen[str], tmp_path: Path) -> None:
    assert inject_process_fault("disk_full", os.getpid())
    out, _ = recorder.communicate("\n", timeout=DEADLINE_S)
    assert out.strip().isdigit(), "its write went through"
    assert (tmp_path / "log").read_bytes() == b"before"
    (tmp_path / "other").write_bytes(b"x" * 10_000)


def test_the_recorder_is_found_among_the_children_and_killed(recorder: subprocess.Popen[str]) -> None:
    assert inject_process_fault("kill_recorder", os.getpid())
    assert recorder.wait(DEADLINE_S) == -9


def test_a_process_that_is_not_there_is_not_struck() -> None:
    assert not inject_process_fault("kill_recorder", os.getpid())
