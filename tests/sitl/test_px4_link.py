"""The simulator link to a real PX4 over a real TCP socket: lockstep, its deadline, sensors, a PX4 that leaves and comes back."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import socket

import pytest

from companion.model.frames import quat_from_euler_zyx
from sitl.autopilot.types import ImuSample
from sitl.px4 import hil_link as px4_link
from sitl.px4.hil_link import HilSensors, Px4Error, SimulatorLink, field_frd_gauss, pressure_hpa
from tests.sitl.px4_peer import Answer, LockstepPeer
from tests.support import DEADLINE_S

LEVEL = (1.0, 0.0, 0.0, 0.0)
PERIOD_S = 0.004


def sample(i: int) -> ImuSample:
    return ImuSample(i * PERIOD_S, (0.1, 0.2, 0.3), (0.0, 0.0, -9.81))


def link(rotors: int = 4) -> SimulatorLink:
    return SimulatorLink(socket.create_server(("127.0.0.1", 0)), HilSensors(1), rotors)


async def connected(link: SimulatorLink, answer: Answer) -> LockstepPeer:
    return await asyncio.to_thread(LockstepPeer, link.port, answer)


async def boot(link: SimulatorLink, i: int = 0) -> int:
    """Send samples until the first answer; return the number of the next sample."""
    async with asyncio.timeout(DEADLINE_S):
        while not link.in_step:
            link.send(sample(i), 0.3, LEVEL)
            await link.await_lockstep(PERIOD_S)
            i += 1
    return i


async def until_answered(link: SimulatorLink, i: int) -> None:
    """Check that lockstep works again: a sample is awaited and answered."""
    async with asyncio.timeout(DEADLINE_S):
        while True:
            i += 1
            link.send(sample(i), 0.3, LEVEL)
            waited = link.pending
            await link.answered()
            if waited:
                return
            await asyncio.sleep(PERIOD_S)


async def until_it_fails(link: SimulatorLink, i: int) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while True:
            i += 1
            link.send(sample(i), 0.3, LEVEL)
            await link.answered()


def test_each_sample_is_answered_before_the_next_one_and_the_answer_is_its_own() -> None:
    def answer(message: object) -> list[float]:
        return [(message.time_usec // 4000) % 100 / 100.0] * 4  # type: ignore[attr-defined]

    async def scenario() -> None:
        async with link() as under_test:
            with await connected(under_test, answer) as peer:
                first = await boot(under_test)
                for i in range(first, first + 200):
                    under_test.send(sample(i), 0.3, LEVEL)
                    await under_test.answered()
                    assert under_test.clock_begun_s is not None
                    clock_us = px4_link.clock_us(i * PERIOD_S - under_test.clock_begun_s)
                    assert under_test.rotors[0] == pytest.approx((clock_us // 4000) % 100 / 100)
                assert under_test.armed
                stamps = [message.time_usec for message in peer.sensors]
                assert {later - earlier for earlier, later in itertools.pairwise(stamps)} == {4000}
                assert under_test.unanswered == 0

    asyncio.run(scenario())


def test_a_px4_that_rests_on_the_ground_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disarmed in OFFBOARD without setpoints PX4 sends no controls at all."""
    monkeypatch.setattr(px4_link, "ANSWER_PATIENCE_S", 0.5)
    monkeypatch.setattr(px4_link, "ANSWER_DEADLINE_S", 1.0)
    rests = range(100, 200)

    def answer(message: object) -> list[float] | None:
        number = round((message.time_usec - px4_link.clock_us(0.0)) / 4000)  # type: ignore[attr-defined]
        return None if number in rests else [0.5] * 4

    async def scenario() -> None:
        async with link() as under_test:
            with await asyncio.to_thread(LockstepPeer, under_test.port, answer, 0):
                for i in range(await boot(under_test), 300):
                    under_test.send(sample(i), 0.3, LEVEL)
                    await under_test.answered()
                assert under_test.unanswered == 1, "one sample's patience, then none until it answers again"
                await until_answered(under_test, 300)

    asyncio.run(scenario())


def test_a_px4_that_boots_is_not_waited_for_and_one_that_stops_answering_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(px4_link, "ANSWER_PATIENCE_S", 0.5)
    monkeypatch.setattr(px4_link, "ANSWER_DEADLINE_S", 1.5)
    answers = 3

    def answer(message: object) -> list[float] | None:
        nonlocal answers
        answers -= 1
        return [0.5] * 4 if answers >= 0 else None

    async def scenario() -> None:
        async with link() as under_test:
            under_test.send(sample(0), 0.3, LEVEL)
            await under_test.answered()  # nobody there: nothing to wait for
            with await connected(under_test, answer):
                i = await boot(under_test, 1)
                with pytest.raises(Px4Error, match=r"lockstep.*none for") as raised:
                    await until_it_fails(under_test, i)
                assert "\n" not in str(raised.value)
                assert under_test.unanswered == 3, "patience, three times, is the deadline"

    asyncio.run(scenario())


def test_one_sample_without_an_answer_does_not_end_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(px4_link, "ANSWER_PATIENCE_S", 0.5)

    async def scenario() -> None:
        async with link() as under_test:
            with await connected(under_test, lambda m: None if m.time_usec == px4_link.clock_us(1.0) else [0.5] * 4):
                for i in range(await boot(under_test), 500):
                    under_test.send(sample(i), 0.3, LEVEL)
                    await under_test.answered()
                assert under_test.unanswered == 1

    asyncio.run(scenario())


def test_as_many_controls_are_read_as_there_are_rotors() -> None:
    controls = [0.1 * number for number in range(1, 9)]

    async def scenario() -> None:
        async with link(rotors=8) as under_test:
            assert under_test.rotors == (0.0,) * 8
            with await connected(under_test, lambda _: [*controls, 0.9, 1.0]):
                await boot(under_test)
                assert under_test.rotors == pytest.approx(controls)

    asyncio.run(scenario())


def test_a_px4_that_leaves_stops_the_rotors_and_may_come_back() -> None:
    async def scenario() -> None:
        async with link() as under_test:
            with await connected(under_test, lambda message: [0.5] * 4):
                i = await boot(under_test)
                assert under_test.rotors == (0.5, 0.5, 0.5, 0.5)
                under_test.send(sample(i), 0.3, LEVEL)
            assert await under_test.await_disconnect(DEADLINE_S)
            await under_test.answered()  # what was pending will never come
            assert under_test.rotors == (0.0, 0.0, 0.0, 0.0)
            assert not under_test.armed
            with await connected(under_test, lambda message: [0.25] * 4):
                await boot(under_test, i + 1)
                assert under_test.rotors[0] == 0.25
                assert under_test.connections == 2

    asyncio.run(scenario())


def test_the_clock_of_a_px4_begins_anew_however_late_it_connects() -> None:
    """A real one whose clock begins at some minutes has no estimate for a long time."""
    late = 75_000  # 300 s

    async def scenario() -> None:
        async with link() as under_test:
            for begun in (late, 3 * late):
                with await connected(under_test, lambda message: [0.5] * 4) as peer:
                    i = await boot(under_test, begun)
                    under_test.send(sample(i), 0.3, LEVEL)
                    await under_test.answered()
                    stamps = [message.time_usec for message in peer.sensors]
                    assert stamps[0] == px4_link.clock_us(0.0)
                    assert {later - earlier for earlier, later in itertools.pairwise(stamps)} == {4000}
                    assert under_test.clock_begun_s is not None
                    assert begun * PERIOD_S <= under_test.clock_begun_s <= i * PERIOD_S
                assert await under_test.await_disconnect(DEADLINE_S)
            assert under_test.unanswered == 0

    asyncio.run(scenario())


def test_a_second_px4_is_turned_away() -> None:
    async def scenario() -> None:
        async with link() as under_test:
            with await connected(under_test, lambda message: [0.5] * 4):
                i = await boot(under_test)
                reader, writer = await asyncio.open_connection("127.0.0.1", under_test.port)
                async with asyncio.timeout(DEADLINE_S):
                    with contextlib.suppress(ConnectionError):
                        assert await reader.read(1) == b"", "closed"
                writer.close()
                under_test.send(sample(i), 0.3, LEVEL)
                await under_test.answered()
                assert (under_test.connections, under_test.unanswered) == (1, 0)

    asyncio.run(scenario())


def test_what_px4_senses() -> None:
    sensors = HilSensors(1)
    messages = [sensors.message(sample(i), 1.0, LEVEL) for i in range(250)]
    accel_and_gyro = 0b111111
    assert all(message.fields_updated & accel_and_gyro == accel_and_gyro for message in messages)
    assert sum(message.fields_updated >> 6 & 1 for message in messages) == 50, "magnetometer, Hz"
    pressures = [message.abs_pressure for message in messages if message.fields_updated >> 9 & 1]
    assert len(pressures) == 50, "barometer, Hz"
    assert sum(pressures) / 50 == pytest.approx(pressure_hpa(489.0), abs=0.01)
    assert all(message.fields_updated >> 10 & 1 == 0 for message in messages), "no airspeed"
    assert (messages[0].xgyro, messages[0].ygyro, messages[0].zgyro) == (0.1, 0.2, 0.3)
    assert messages[0].zacc == -9.81


def test_pressure_falls_with_height() -> None:
    assert pressure_hpa(0.0) == pytest.approx(1013.25)
    assert pressure_hpa(0.0) - pressure_hpa(8.4) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("yaw_enu_deg", "forward", "right"), [(90.0, 0.21, 0.01), (0.0, 0.01, -0.21)])
def test_the_field_points_north_and_down(yaw_enu_deg: float, forward: float, right: float) -> None:
    """World x is east: a vehicle that looks along y looks north."""
    attitude = quat_from_euler_zyx(0.0, 0.0, yaw_enu_deg / 57.29577951308232)
    assert field_frd_gauss(attitude) == pytest.approx((forward, right, 0.43), abs=1e-6)
