"""The arm edge over a real pty against the emulated servos; the real dynamixel-sdk speaks in between."""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import threading
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
import serial

from companion.config.arm import Joint
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.protocols import Arm as ArmEdge
from companion.model.observations import ServoReport
from companion.model.servos import WATCHDOG_ERROR, ServoName
from companion.runtime.clock import flight_clock
from sitl.servo.bus import ServoBus
from sitl.servo.kinds import KINDS
from sitl.servo.model import ServoModel
from tests.io.arm_rig import (
    JOINTS,
    KT,
    NM_PER_COUNT,
    START_DEG,
    arm_config,
    device_on,
    flying_arm,
    new_servos,
    register,
    shaft_rad,
    state_when,
    until,
)
from tests.support import DEADLINE_S
from tests.wires import plugged


@pytest.fixture(autouse=True)
def _nothing_left() -> Iterator[None]:
    yield
    assert_nothing_left()


def assert_nothing_left() -> None:
    assert [thread.name for thread in threading.enumerate() if thread.name == "arm-bus"] == []


async def test_an_arm_opens_although_every_third_packet_is_damaged() -> None:
    servos, number = new_servos(), itertools.count()
    async with ServoBus(servos) as bus:
        bus.damaged = lambda: next(number) % 3 == 0
        async with DynamixelArm(device_on(bus.path), arm_config(), flight_clock()) as arm:
            assert arm.latest() is not None
            assert [register(servo, 64) for servo in servos] == [1, 1]


async def test_joint_state_arrives_in_the_papers_angles() -> None:
    async with flying_arm() as setup:
        edge: ArmEdge = setup.arm
        state = edge.latest()
        assert state is not None
        assert [math.degrees(a) for a in state.angle_rad] == pytest.approx(START_DEG, abs=0.05)
        for joint, servo, angle in zip(JOINTS, setup.servos, (1.0, -0.7), strict=True):
            servo.update(0.001, shaft_rad(joint, angle), joint.sign * 0.5)
        asked_s = setup.clock()
        fresh = await state_when(edge, lambda s: s.stamp_s > asked_s)
        state = await state_when(edge, lambda s: s.stamp_s > fresh.stamp_s)
        assert state.angle_rad == pytest.approx((1.0, -0.7), abs=0.001)
        assert state.velocity_rad_s == pytest.approx((0.5, 0.5), abs=0.012)
        assert state.temperature_c == (30.0, 30.0)
        assert (state.hardware_error, state.read_failures) == ((0, 0), 0)
        assert state.stamp_s <= setup.clock()


async def test_servos_are_set_up_for_current_control() -> None:
    async with flying_arm(watchdog_ms=120) as setup:
        for servo in setup.servos:
            assert [register(servo, a) for a in (9, 11, 64, 98)] == [0, 0, 1, 6]
            assert register(servo, 102, 2) == 0


async def test_torque_returned_is_the_torque_that_flows() -> None:
    async with flying_arm(watchdog_ms=2540) as setup:
        sent = setup.arm.write_torque((0.5, -99.0))
        assert sent == pytest.approx((0.5, -1.5), abs=NM_PER_COUNT)
        await until(lambda: register(setup.servos[1], 102, 2) != 0)
        flowing = [
            joint.sign * KT * servo.update(0.001, shaft_rad(joint, 1.0), 0.0)
            for joint, servo in zip(JOINTS, setup.servos, strict=True)
        ]
        assert flowing == pytest.approx(sent, abs=1e-9)
        state = await state_when(setup.arm, lambda s: s.torque_nm[1] != 0.0)
        assert state.torque_nm == pytest.approx(sent, abs=1e-9)


async def test_newest_torque_wins() -> None:
    async with flying_arm(watchdog_ms=2540) as setup:
        for step in range(200):
            setup.arm.write_torque((step * 0.01, 0.0))
        last = setup.arm.write_torque((0.7, 0.3))
        counts = [round(JOINTS[i].sign * last[i] / NM_PER_COUNT) for i in (0, 1)]
        await until(lambda: [register(s, 102, 2) for s in setup.servos] == counts)


async def test_torque_that_is_not_renewed_goes_to_zero_while_reads_go_on() -> None:
    async with flying_arm() as setup:
        setup.arm.write_torque((0.5, 0.5))
        await until(lambda: register(setup.servos[0], 102, 2) != 0)
        for _ in range(10):
            await setup.arm.read(1.0)
        await until(lambda: [register(s, 102, 2) for s in setup.servos] == [0, 0])
        assert [register(s, 64) for s in setup.servos] == [1, 1]


async def test_servo_falling_silent_counts_and_comes_back() -> None:
    async with flying_arm(watchdog_ms=2540) as setup:
        before = setup.arm.latest()
        assert before is not None
        setup.servos[1].fail_silent(True)
        lost = await state_when(setup.arm, lambda s: s.read_failures >= 5)
        setup.arm.write_torque((0.4, 0.4))
        await until(lambda: register(setup.servos[0], 102, 2) != 0)
        assert register(setup.servos[1], 102, 2) == 0
        later = await setup.arm.read(1.0)
        assert later is not None
        assert later.read_failures > lost.read_failures
        assert later.stamp_s == lost.stamp_s, "the stamp is of the last complete read"
        setup.servos[1].fail_silent(False)
        back = await state_when(setup.arm, lambda s: s.read_failures == 0)
        assert back.stamp_s > lost.stamp_s


async def test_hardware_error_is_reported_and_never_rebooted() -> None:
    async with flying_arm() as setup:
        setup.servos[0].trip_overload()
        state = await state_when(setup.arm, lambda s: s.hardware_error != (0, 0))
        assert state.hardware_error == (0x20, 0)
        setup.servos[1].set_temperature_c(85.0)
        state = await state_when(setup.arm, lambda s: s.temperature_c[1] > 80.0)
        assert state.hardware_error == (0x20, 0x04)
        for _ in range(50):
            setup.arm.write_torque((0.3, 0.3))
            state = await state_when(setup.arm, lambda s: s.read_failures == 0)
            assert state.hardware_error == (0x20, 0x04)
        assert [register(s, 64) for s in setup.servos] == [0, 0]


async def test_servo_that_restarts_by_itself_is_a_lost_servo_not_an_angle_of_zero() -> None:
    async with flying_arm() as setup:
        before = setup.arm.latest()
        assert before is not None
        setup.servos[1].reboot()
        state = await state_when(setup.arm, lambda s: s.read_failures >= 5)
        assert state.angle_rad == pytest.approx(before.angle_rad)


async def test_tripped_watchdog_is_shown_and_started_again() -> None:
    async with flying_arm() as setup:
        servo, joint = setup.servos[0], JOINTS[0]
        servo.update(1.0, shaft_rad(joint, 1.0), 0.0)
        servo.update(9.0, shaft_rad(joint, 1.0), 0.0)  # no packet came in between, by the servo's time
        assert register(servo, 98) == 0xFF
        state = await state_when(setup.arm, lambda s: s.hardware_error != (0, 0))
        assert state.hardware_error == (WATCHDOG_ERROR, 0)
        await state_when(setup.arm, lambda s: s.hardware_error == (0, 0))
        assert [register(s, 98) for s in setup.servos] == [5, 5]
        setup.arm.write_torque((0.3, 0.0))
        await until(lambda: register(servo, 102, 2) != 0)


@pytest.mark.parametrize(("losses", "temperature_c"), [(1, 0.0), (5, 30.0)], ids=["one write", "all attempts"])
async def test_a_watchdog_whose_restart_is_lost_on_the_bus_is_restarted_all_the_same(
    losses: int, temperature_c: float
) -> None:
    async with flying_arm() as setup:
        servo, left = setup.servos[0], [True] * losses
        servo.set_temperature_c(temperature_c)
        answer = setup.bus.answer_to

        def losing(data: bytes, baud_bps: int) -> tuple[bytes, float]:
            if left and bytes((11, 6, 0, 3, 98, 0, 5)) in data:
                left.pop()
                return b"", 0.0
            return answer(data, baud_bps)

        setup.bus.answer_to = losing  # type: ignore[method-assign]
        servo.update(1.0, shaft_rad(JOINTS[0], 1.0), 0.0)
        servo.update(9.0, shaft_rad(JOINTS[0], 1.0), 0.0)
        await asyncio.wait_for(state_when(setup.arm, lambda s: not left and s.read_failures == 0), DEADLINE_S)
        await asyncio.wait_for(state_when(setup.arm, lambda s: s.hardware_error == (0, 0)), DEADLINE_S)
        assert [register(s, 98) for s in setup.servos] == [5, 5]
        await asyncio.wait_for(until(lambda: rewritten(setup.arm, setup.servos)), DEADLINE_S)


def test_closing_the_arm_sets_current_torque_and_watchdog_to_0() -> None:
    async def main() -> list[ServoModel]:
        async with flying_arm() as setup:
            setup.arm.write_torque((0.5, 0.5))
            await until(lambda: register(setup.servos[0], 102, 2) != 0)
            await setup.arm.__aexit__(None, None, None)
            with serial.Serial(setup.bus.path, exclusive=True):
                pass  # closed and unlocked
            return setup.servos

    servos = asyncio.run(asyncio.wait_for(main(), DEADLINE_S))
    for servo in servos:
        assert (register(servo, 102, 2), register(servo, 64), register(servo, 98)) == (0, 0, 0)


async def test_closing_the_arm_during_a_burst_of_noise_still_switches_the_torque_off() -> None:
    servos, noise = new_servos(), [True] * 3
    async with ServoBus(servos) as bus:
        async with DynamixelArm(device_on(bus.path), arm_config(), flight_clock()) as arm:
            await until(lambda: rewritten(arm, servos))
            bus.damaged = lambda: bool(noise) and noise.pop()
        assert not noise
        assert [(register(servo, 64), register(servo, 98)) for servo in servos] == [(0, 0), (0, 0)]


async def test_a_servo_that_does_not_hear_the_torque_off_keeps_its_watchdog() -> None:
    async with flying_arm() as setup:
        await until(lambda: rewritten(setup.arm, setup.servos))
        servo = setup.servos[0]
        answer = setup.bus.answer_to

        def deaf_to_torque(data: bytes, baud_bps: int) -> tuple[bytes, float]:
            """A loose plug: servo 11 misses the goal current 0 and the torque off, then it hears the bus again."""
            servo.fail_silent(
                b"\x83" + (102).to_bytes(2, "little") in data or data[4:10] == bytes((11, 6, 0, 3, 64, 0))
            )
            return answer(data, baud_bps)

        setup.bus.answer_to = deaf_to_torque  # type: ignore[method-assign]
        await setup.arm.__aexit__(None, None, None)
        assert [(register(one, 64), register(one, 98)) for one in setup.servos] == [(1, 5), (0, 0)]
        servo.update(1.0, servo.drive.angle_rad, 0.0)
        servo.update(2.0, servo.drive.angle_rad, 0.0)
        assert (register(servo, 98), register(servo, 102, 2)) == (0xFF, 0)


async def test_leaving_a_dead_bus_is_quiet_and_ends() -> None:
    servos = new_servos()
    async with ServoBus(servos) as bus:
        arm = DynamixelArm(device_on(bus.path), arm_config(), flight_clock())
        await arm.__aenter__()
        for servo in servos:
            servo.fail_silent(True)
        await state_when(arm, lambda s: s.read_failures >= 3)
        await arm.__aexit__(None, None, None)
        assert_nothing_left()


def test_unplugged_port_counts_as_failures_and_leaving_ends() -> None:
    async def main() -> None:
        async with ServoBus(new_servos()) as bus:
            arm = DynamixelArm(device_on(bus.path), arm_config(), flight_clock())
            await arm.__aenter__()
        await state_when(arm, lambda s: s.read_failures >= 3)
        arm.write_torque((0.1, 0.1))
        assert arm.problem
        await arm.__aexit__(None, None, None)
        assert_nothing_left()

    before = set(os.listdir("/proc/self/fd"))
    asyncio.run(asyncio.wait_for(main(), DEADLINE_S))
    assert set(os.listdir("/proc/self/fd")) == before


async def test_a_port_that_comes_back_under_its_name_is_read_again_and_moves_nothing_by_itself(tmp_path: Path) -> None:
    servos = new_servos()
    async with AsyncExitStack() as stack:
        async with ServoBus(servos) as bus:
            with plugged(tmp_path / "arm", bus.path) as port:
                arm = await stack.enter_async_context(DynamixelArm(device_on(port), arm_config(), flight_clock()))
                await until(lambda: rewritten(arm, servos))
        lost = await state_when(arm, lambda s: bool(arm.problem))
        for servo, joint in zip(servos, JOINTS, strict=True):  # no packet comes, by the servos' time: watchdogs trip
            servo.update(1.0, shaft_rad(joint, 1.0), 0.0)
            servo.update(9.0, shaft_rad(joint, 1.0), 0.0)
        arm.write_torque((0.4, 0.4))
        async with ServoBus(servos) as bus:
            with plugged(tmp_path / "arm", bus.path):
                back = await state_when(arm, lambda s: s.read_failures == 0)
                assert back.hardware_error == (WATCHDOG_ERROR, WATCHDOG_ERROR)
                assert back.stamp_s > lost.stamp_s
                await state_when(arm, lambda s: s.hardware_error == (0, 0))
                assert [register(servo, 102, 2) for servo in servos] == [0, 0], "no torque of before the loss"
                await until(lambda: rewritten(arm, servos))
                await arm.__aexit__(None, None, None)
                await until(lambda: [register(servo, 64) for servo in servos] == [0, 0])


async def test_servos_that_lost_their_power_with_the_port_keep_their_torque_off(tmp_path: Path) -> None:
    servos = new_servos()
    async with AsyncExitStack() as stack:
        async with ServoBus(servos) as bus:
            with plugged(tmp_path / "arm", bus.path) as port:
                arm = await stack.enter_async_context(DynamixelArm(device_on(port), arm_config(), flight_clock()))
        lost = await state_when(arm, lambda s: bool(arm.problem))
        for servo in servos:
            servo.reboot()
        async with ServoBus(servos) as bus:
            with plugged(tmp_path / "arm", bus.path):
                arm.write_torque((0.4, 0.4))
                await until(lambda: rewritten(arm, servos))
                state = await state_when(arm, lambda s: s.read_failures > lost.read_failures + 5)
                assert state.stamp_s == lost.stamp_s
                assert [register(servo, 64) for servo in servos] == [0, 0]


def rewritten(arm: DynamixelArm, servos: list[ServoModel]) -> bool:
    """Command a torque, which is withdrawn unless it is renewed; whether its goal has arrived at all servos."""
    arm.write_torque((0.4, 0.4))
    return all(register(servo, 102, 2) for servo in servos)


def test_cancelled_opening_leaves_nothing_behind() -> None:
    async def main() -> list[ServoModel]:
        servos = new_servos()
        async with ServoBus(servos) as bus:
            opening = asyncio.create_task(DynamixelArm(device_on(bus.path), arm_config(), flight_clock()).__aenter__())
            await until(lambda: register(servos[0], 11) == 0)
            opening.cancel()
            with pytest.raises(asyncio.CancelledError):
                await opening
            assert_nothing_left()
            with serial.Serial(bus.path, exclusive=True):
                pass
        return servos

    servos = asyncio.run(asyncio.wait_for(main(), DEADLINE_S))
    assert [register(servo, 64) for servo in servos] == [0, 0]


@pytest.mark.parametrize("baud", [57600, 4_000_000])
async def test_other_baud_rates_work(baud: int) -> None:
    servos = new_servos(baud)
    async with (
        ServoBus(servos) as bus,
        DynamixelArm(device_on(bus.path, baud=baud), arm_config(), flight_clock()) as arm,
    ):
        await state_when(arm, lambda s: s.read_failures == 0)


async def test_three_models_on_one_bus_are_each_driven_in_their_own_units() -> None:
    limits_nm: dict[ServoName, float] = {"XM540-W270": 6.0, "XL330-M288": 0.3, "XM430-W210": 1.2}
    torques_nm = (6.0, -0.3, 1.2)
    common: dict[str, Any] = {"sign": 1, "zero_count": 2048, "angle_deg": (-90, 90), "velocity_max_deg_s": 150.0}
    joints = [
        Joint(servo=name, servo_id=20 + index, torque_max_nm=limit_nm, **common)
        for index, (name, limit_nm) in enumerate(limits_nm.items())
    ]
    config = arm_config(*joints, torque_per_amp_nm_a=None)

    servos = [
        ServoModel(joint.servo_id, kind=joint.kind.name, shaft_angle_rad=shaft_rad(joint, 0.5)) for joint in joints
    ]
    async with (
        ServoBus(servos) as bus,
        DynamixelArm(device_on(bus.path, watchdog_ms=2000), config, flight_clock()) as arm,
    ):
        assert [report.model for report in arm.servos] == [1120, 1200, 1030]
        sent_nm = arm.write_torque(torques_nm)
        assert sent_nm == pytest.approx(torques_nm, rel=0.005)
        await until(lambda: all(register(servo, 102, 2) for servo in servos))
        for joint, servo, torque_nm in zip(joints, servos, torques_nm, strict=True):
            current_a = servo.update(0.1, shaft_rad(joint, 0.5), 0.0)
            assert current_a * KINDS[joint.kind.name].nm_per_amp == pytest.approx(torque_nm, rel=0.01)
        state = await state_when(arm, lambda s: all(s.torque_nm))
        assert state.torque_nm == pytest.approx(sent_nm, rel=1e-9)
        assert state.angle_rad == pytest.approx((0.5, 0.5, 0.5), abs=0.002)


async def test_servos_left_in_odd_states_are_taken_over() -> None:
    servos = new_servos()
    for servo in servos:
        servo.write(11, b"\x00")
        servo.write(64, b"\x01")
        servo.write(98, b"\x01")
        servo.write(102, (300).to_bytes(2, "little"))
        servo.write(68, b"\x00")
    first = servos[0]
    for t_s in (0.0, 1.0):
        first.update(t_s, shaft_rad(JOINTS[0], 1.0), 0.0)
    assert register(first, 98) == 0xFF
    async with ServoBus(servos) as bus, DynamixelArm(device_on(bus.path), arm_config(), flight_clock()):
        for servo in servos:
            assert [register(servo, a) for a in (9, 11, 64, 68, 98)] == [0, 0, 1, 2, 5]
            assert register(servo, 102, 2) == 0


async def test_noise_on_the_line_costs_reads_not_the_thread() -> None:
    async with flying_arm() as setup:
        noise = bytes(range(256)) + b"\xff\xff\xfd\x00\x0b\x0d\x00\x55\x00" * 5
        for _ in range(30):
            setup.bus.inject(noise)
            await setup.arm.read(1.0)
        assert (await state_when(setup.arm, lambda s: s.read_failures == 0)).hardware_error == (0, 0)
        assert not setup.arm.problem


async def test_a_read_begun_early_is_there_when_it_is_asked_for() -> None:
    async with flying_arm(watchdog_ms=2000) as setup:
        before = setup.arm.latest()
        assert before is not None
        setup.arm.begin_read()
        setup.arm.begin_read()  # nothing new while one is under way
        await until(lambda: setup.arm.latest() is not before)
        early = setup.arm.latest()
        state = await setup.arm.read(0.0)
        assert state is early
        assert state is not None
        assert state.asked_s is not None
        assert before.stamp_s <= state.asked_s < state.stamp_s
        later = await setup.arm.read(1.0)
        assert later is not None
        assert later.stamp_s > state.stamp_s


async def test_a_read_begins_at_its_time_or_when_it_is_wanted() -> None:
    async with flying_arm(watchdog_ms=2000) as setup:
        at_s = setup.clock() + 0.05
        setup.arm.begin_read(at_s)
        setup.arm.write_torque((0.0, 0.0))  # is not held up by it
        await until(lambda: (state := setup.arm.latest()) is not None and state.written_s is not None)
        state = setup.arm.latest()
        assert state is not None
        assert state.asked_s is not None
        assert state.asked_s >= at_s
        assert state.written_s is not None
        assert state.written_s < state.asked_s
        assert await setup.arm.read(0.0) is state
        setup.arm.begin_read(setup.clock() + 3600.0)
        wanted = await setup.arm.read(DEADLINE_S)
        assert wanted is not None
        assert wanted.stamp_s > state.stamp_s


async def test_a_read_that_is_far_off_keeps_no_torque_alive() -> None:
    async with flying_arm() as setup:
        setup.arm.write_torque((0.5, 0.5))
        await until(lambda: register(setup.servos[0], 102, 2) != 0)
        setup.arm.begin_read(setup.clock() + 3600.0)
        await until(lambda: [register(servo, 102, 2) for servo in setup.servos] == [0, 0])
        assert [register(servo, 98) for servo in setup.servos] == [5, 5]  # by us: no watchdog had to trip


async def test_the_time_of_a_read_is_learnt() -> None:
    async with flying_arm() as setup:
        taken_s = []
        for _ in range(100):
            state = await setup.arm.read(1.0)
            assert state is not None
            assert state.asked_s is not None
            taken_s.append(state.stamp_s - state.asked_s)
        assert min(taken_s) < setup.arm.read_takes_s < max(taken_s) + 3 * (max(taken_s) - min(taken_s))


async def test_the_edge_shows_both_servos_as_it_left_them() -> None:
    servos = new_servos()
    servos[0].set_voltage_v(11.8)
    servos[1].write(38, (900).to_bytes(2, "little"))
    async with ServoBus(servos) as bus, DynamixelArm(device_on(bus.path), arm_config(), flight_clock()) as arm:
        first, second = arm.servos
        assert first == ServoReport(
            servo_id=11,
            model=1030,
            firmware=48,
            operating_mode=0,
            return_delay_us=0,
            current_limit_counts=1193,
            watchdog_ms=100,
            voltage_v=11.8,
        )
        assert (second.servo_id, second.current_limit_counts, second.voltage_v) == (12, 900, 12.0)
