"""The simulator link to a real PX4 over a real TCP socket: lockstep, its deadline, sensors, a PX4 that leaves and comes back."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket
from collections.abc import AsyncIterator, Iterable
from typing import Any

import pytest

from companion.model.frames import quat_from_euler_zyx
from sitl.autopilot.types import ImuSample
from sitl.px4 import hil_link as px4_link
from sitl.px4.hil_link import HilSensors, Px4Error, SimulatorLink, field_frd_gauss, pressure_hpa
from tests.sitl.px4_peer import ARMED, Answer, LockstepPeer
from tests.support import DEADLINE_S

LEVEL = (1.0, 0.0, 0.0, 0.0)
PERIOD_S = 0.004


def sample(i: int) -> ImuSample:
    return ImuSample(i * PERIOD_S, (0.1, 0.2, 0.3), (0.0, 0.0, -9.81), 1.0 if i % 5 == 0 else None)


@contextlib.asynccontextmanager
async def opened(rotors: int = 4) -> AsyncIterator[SimulatorLink]:
    async with SimulatorLink(socket.create_server(("127.0.0.1", 0)), HilSensors(1), rotors) as link:
        yield link


async def peer_of(link: SimulatorLink, answer: Answer = lambda message: [0.5] * 4, mode: int = ARMED) -> LockstepPeer:
    return await asyncio.to_thread(LockstepPeer, link.port, answer, mode)


async def boot(link: SimulatorLink, i: int = 0) -> int:
    """Send samples until the first answer; return the number of the next sample."""
    async with asyncio.timeout(DEADLINE_S):
        while not link.in_step:
            link.send(sample(i), LEVEL)
            await link.await_lockstep(PERIOD_S)
            i += 1
    return i


async def step(link: SimulatorLink, numbers: Iterable[int]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        for i in numbers:
            link.send(sample(i), LEVEL)
            await link.answered()


def stamp_steps_us(peer: LockstepPeer) -> set[int]:
    return {later.time_usec - earlier.time_usec for earlier, later in itertools.pairwise(peer.sensors)}


async def test_each_sample_is_answered_before_the_next_one_and_the_answer_is_its_own() -> None:
    def answer(message: Any) -> list[float]:
        return [(message.time_usec // 4000) % 100 / 100.0] * 4

    async with opened() as link:
        with await peer_of(link, answer) as peer:
            first = await boot(link)
            for i in range(first, first + 200):
                await step(link, (i,))
                assert link.clock_begun_s is not None
                clock_us = px4_link.clock_us(i * PERIOD_S - link.clock_begun_s)
                assert link.rotors[0] == pytest.approx((clock_us // 4000) % 100 / 100)
            assert link.armed
            assert stamp_steps_us(peer) == {4000}
            assert link.unanswered == 0


async def test_a_px4_that_rests_on_the_ground_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disarmed in OFFBOARD without setpoints PX4 sends no controls at all."""
    monkeypatch.setattr(px4_link, "ANSWER_PATIENCE_S", 0.5)
    monkeypatch.setattr(px4_link, "ANSWER_DEADLINE_S", 1.0)

    def answer(message: Any) -> list[float] | None:
        number = round((message.time_usec - px4_link.clock_us(0.0)) / 4000)
        return None if number in range(100, 200) else [0.5] * 4

    async with opened() as link:
        with await peer_of(link, answer, mode=0):
            await step(link, range(await boot(link), 300))
            assert link.unanswered == 1, "one sample's patience, then none until it answers again"
            async with asyncio.timeout(DEADLINE_S):
                i, waited = 300, False
                while not waited:
                    i += 1
                    link.send(sample(i), LEVEL)
                    waited = link.pending
                    await link.answered()
                    await asyncio.sleep(PERIOD_S)


async def test_a_px4_that_boots_is_not_waited_for_and_one_that_stops_answering_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(px4_link, "ANSWER_PATIENCE_S", 0.5)
    monkeypatch.setattr(px4_link, "ANSWER_DEADLINE_S", 1.5)
    answers = iter([[0.5] * 4] * 3)
    async with opened() as link:
        await step(link, (0,))  # there is no PX4: nothing to wait for
        with await peer_of(link, lambda _: next(answers, None)):
            i = await boot(link, 1)
            with pytest.raises(Px4Error, match=r"^.*lockstep.*none for.*$"):
                await step(link, itertools.count(i))
            assert link.unanswered == 3, "patience, three times, is the deadline"


async def test_as_many_controls_are_read_as_there_are_rotors() -> None:
    controls = [0.1 * number for number in range(1, 9)]
    async with opened(rotors=8) as link:
        assert link.rotors == (0.0,) * 8
        with await peer_of(link, lambda _: [*controls, 0.9, 1.0]):
            await boot(link)
            assert link.rotors == pytest.approx(controls)


async def test_a_px4_that_leaves_stops_the_rotors_and_may_come_back() -> None:
    async with opened() as link:
        with await peer_of(link):
            i = await boot(link)
            assert link.rotors == (0.5, 0.5, 0.5, 0.5)
            link.send(sample(i), LEVEL)
        assert await link.await_disconnect(DEADLINE_S)
        await link.answered()  # what was pending will never come
        assert link.rotors == (0.0, 0.0, 0.0, 0.0)
        assert not link.armed
        with await peer_of(link, lambda message: [0.25] * 4):
            await boot(link, i + 1)
            assert link.rotors[0] == 0.25
            assert link.connections == 2


async def test_the_clock_of_a_px4_begins_anew_however_late_it_connects() -> None:
    """A real one whose clock begins at some minutes has no estimate for a long time."""
    late = 75_000  # 300 s
    async with opened() as link:
        for begun in (late, 3 * late):
            with await peer_of(link) as peer:
                i = await boot(link, begun)
                await step(link, (i,))
                assert peer.sensors[0].time_usec == px4_link.clock_us(0.0)
                assert stamp_steps_us(peer) == {4000}
                assert link.clock_begun_s is not None
                assert begun * PERIOD_S <= link.clock_begun_s <= i * PERIOD_S
            assert await link.await_disconnect(DEADLINE_S)
        assert link.unanswered == 0


async def test_a_second_px4_is_rejected() -> None:
    async with opened() as link:
        with await peer_of(link):
            i = await boot(link)
            reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
            async with asyncio.timeout(DEADLINE_S):
                with contextlib.suppress(ConnectionError):
                    assert await reader.read(1) == b"", "closed"
            writer.close()
            await step(link, (i,))
            assert (link.connections, link.unanswered) == (1, 0)


def test_what_px4_senses() -> None:
    sensors = HilSensors(1)
    messages = [sensors.message(sample(i), LEVEL) for i in range(250)]
    accel_and_gyro = 0b111111
    assert all(message.fields_updated & accel_and_gyro == accel_and_gyro for message in messages)
    assert sum(message.fields_updated >> 6 & 1 for message in messages) == 50, "magnetometer, Hz"
    pressures = [message.abs_pressure for message in messages if message.fields_updated >> 9 & 1]
    assert len(pressures) == 50, "barometer, Hz"
    assert sum(pressures) / 50 == pytest.approx(pressure_hpa(489.0), abs=0.01)
    assert all(message.fields_updated >> 10 & 1 == 0 for message in messages), "no airspeed"
    assert (messages[0].xgyro, messages[0].ygyro, messages[0].zgyro) == (0.1, 0.2, 0.3)
    assert messages[0].zacc == -9.81


@pytest.mark.parametrize(("yaw_enu_deg", "forward", "right"), [(90.0, 0.21, 0.01), (0.0, 0.01, -0.21)])
def test_the_field_points_north_and_down(yaw_enu_deg: float, forward: float, right: float) -> None:
    """World x is east: a vehicle that looks along y looks north."""
    attitude = quat_from_euler_zyx(0.0, 0.0, yaw_enu_deg / 57.29577951308232)
    assert field_frd_gauss(attitude) == pytest.approx((forward, right, 0.43), abs=1e-6)
