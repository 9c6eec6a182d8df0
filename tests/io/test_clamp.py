"""The clamp's servo on the arm's bus over a real pty: set-up, commands, position, and what it does when the companion falls silent."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from companion.config.arm import Jaws
from companion.io.dynamixel.arm import DynamixelArm
from companion.io.protocols import DeviceError
from companion.model.team import ClampCommand
from companion.runtime.clock import flight_clock
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from sitl.world.jaws import Jaws as World
from tests.io.arm_rig import arm_config, device_on, new_servos, register, until
from tests.support import DEADLINE_S

CONFIG = Jaws(servo_id=13, open_deg=90.0, closed_deg=180.0)
EMPTY_DEG = CONFIG.empty_deg
"""Where jaws without a handle between them close."""


class Clamp:
    """The servo with its jaws."""

    def __init__(self, start_deg: float = 90.0, **servo: Any) -> None:
        at_rad = math.radians(start_deg)
        self.servo = ServoModel(13, shaft_angle_rad=at_rad, **{"kind": "XL330-M288", **servo})
        self.world = World(CONFIG, self.servo)
        self.world.angle_rad = at_rad
        self.t_s = 0.0

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.002)):
            self.t_s += 0.002
            self.world.step(self.t_s, handle_near=False)

    @property
    def angle_deg(self) -> float:
        return math.degrees(self.world.angle_rad)


@asynccontextmanager
async def on_bus(clamp: Clamp) -> AsyncIterator[tuple[DynamixelArm, list[ServoModel]]]:
    joints = new_servos()
    async with (
        ServoBus([*joints, clamp.servo]) as bus,
        DynamixelArm(device_on(bus.path), arm_config(), flight_clock(), CONFIG) as arm,
    ):
        yield arm, joints


async def taken(arm: DynamixelArm, clamp: Clamp, command: ClampCommand, goal_deg: float) -> None:
    """Command the clamp and wait until its servo has taken it."""
    arm.command_clamp(command)
    goal = round(goal_deg * 4096 / 360)
    await asyncio.wait_for(until(lambda: register(clamp.servo, 116, 4) == goal), DEADLINE_S)


async def seen_deg(arm: DynamixelArm, angle_deg: float) -> None:
    """Wait until the companion sees this angle, in joint reads of its own."""

    async def reads() -> None:
        while (clamp := arm.clamp()) is None or abs(math.degrees(clamp.angle_rad) - angle_deg) > 2.0:
            await arm.read(1.0)

    await asyncio.wait_for(reads(), DEADLINE_S)


async def test_the_servo_is_set_up_and_moves_only_on_command() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, joints):
        servo = clamp.servo
        assert (register(servo, 11), register(servo, 9), register(servo, 98)) == (5, 0, 0)
        assert (register(servo, 102, 2), register(servo, 64)) == (400, 0)
        assert [register(joint, 64) for joint in joints] == [1, 1]
        await seen_deg(arm, 90.0)
        arm.command_clamp(None)
        await arm.read(1.0)
        assert register(servo, 64) == 0
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        assert register(servo, 64) == 1
        clamp.run(1.0)
        await seen_deg(arm, EMPTY_DEG)
        await taken(arm, clamp, ClampCommand.OPEN, 90.0)
        clamp.run(1.0)
        await seen_deg(arm, 90.0)


async def test_a_command_that_is_lost_on_the_bus_is_repeated() -> None:
    clamp = Clamp()
    async with (
        ServoBus([*new_servos(), clamp.servo]) as bus,
        DynamixelArm(device_on(bus.path), arm_config(), flight_clock(), CONFIG) as arm,
    ):
        noise = [True] * 5
        bus.damaged = lambda: bool(noise) and noise.pop()
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        await asyncio.wait_for(until(lambda: not noise and register(clamp.servo, 64) == 1), DEADLINE_S)


async def test_a_closed_clamp_stays_closed_when_the_companion_falls_silent_and_when_it_starts_again() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, joints):
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        clamp.run(1.0)
        for joint in joints:
            joint.update(0.0, joint.drive.angle_rad, 0.0)
            joint.update(10.0, joint.drive.angle_rad, 0.0)  # no instruction for 10 s
        clamp.run(10.0)
        assert [register(joint, 98) for joint in joints] == [255, 255]
        assert clamp.angle_deg == pytest.approx(EMPTY_DEG, abs=2.0) and register(clamp.servo, 64) == 1
    assert register(clamp.servo, 64) == 1 and [register(joint, 64) for joint in joints] == [0, 0]
    async with ServoBus([*new_servos(), clamp.servo]) as bus:
        never_off = [True]
        write = clamp.servo.write

        def watched(address: int, data: bytes) -> None:
            write(address, data)
            never_off.append(clamp.servo.drive.torque_on)

        clamp.servo.write = watched  # type: ignore[method-assign]
        async with DynamixelArm(device_on(bus.path), arm_config(), flight_clock(), CONFIG) as arm:
            await seen_deg(arm, EMPTY_DEG)
        assert len(never_off) > 1 and all(never_off)


async def test_the_turns_that_the_servo_has_lost_are_added() -> None:
    clamp = Clamp(start_deg=90.0 - 360.0)
    clamp.servo.write(11, bytes((5,)))  # a mode with several turns
    clamp.servo.drive.turn_counts = 0
    async with on_bus(clamp) as (arm, _):
        await seen_deg(arm, 90.0)
        arm.command_clamp(ClampCommand.CLOSE)
        goal = round((EMPTY_DEG - 360.0) * 4096 / 360)
        await asyncio.wait_for(until(lambda: register(clamp.servo, 116, 4) == goal), DEADLINE_S)


async def test_a_clamp_that_shuts_down_while_it_grips_reports_why() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, _):
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        clamp.run(1.0)
        await seen_deg(arm, EMPTY_DEG)
        gripping = arm.clamp()
        assert gripping is not None and gripping.hardware_error is None
        clamp.servo.trip_overload()

        async def reads() -> None:
            while (state := arm.clamp()) is None or state.hardware_error != 32:
                await arm.read(1.0)

        await asyncio.wait_for(reads(), DEADLINE_S)
        assert register(clamp.servo, 64) == 0 and "overload" in arm.problem


async def test_the_joints_go_on_while_the_clamp_is_silent_and_its_state_grows_old() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, _):
        clamp.servo.fail_silent(True)
        await arm.read(1.0)
        old, state = arm.clamp(), await arm.read(1.0)
        assert old is not None and state is not None
        # A busy computer may miss some answers of the joints, too.
        while state.stamp_s < old.stamp_s + 0.05 or state.read_failures:
            state = await arm.read(1.0)
            assert state is not None
        assert arm.clamp() == old


@pytest.mark.parametrize("temperature_c", [0.0, 30.0])
async def test_a_clamp_that_restarts_in_flight_gets_its_settings_and_its_turns_before_its_torque(
    temperature_c: float,
) -> None:
    clamp = Clamp(start_deg=90.0 - 360.0)
    clamp.servo.write(11, bytes((5,)))
    clamp.servo.set_temperature_c(temperature_c)
    clamp.servo.drive.turn_counts = -4096
    async with on_bus(clamp) as (arm, _):
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        await asyncio.wait_for(until(lambda: register(clamp.servo, 64) == 1), DEADLINE_S)
        clamp.servo.reboot()
        assert (register(clamp.servo, 64), register(clamp.servo, 102, 2)) == (0, 1750)
        energised: list[int] = []
        write = clamp.servo.write

        def watched(address: int, data: bytes) -> None:
            write(address, data)
            if (address, data) == (64, b"\x01"):
                energised.append(register(clamp.servo, 102, 2))

        clamp.servo.write = watched  # type: ignore[method-assign]
        at_deg = register(clamp.servo, 132, 4) * 360.0 / 4096
        turns_deg = 360.0 * round((135.0 - at_deg) / 360.0)
        goal = round((EMPTY_DEG - turns_deg) * 4096 / 360)
        await asyncio.wait_for(state_after(arm, lambda: register(clamp.servo, 116, 4) == goal), DEADLINE_S)
        assert register(clamp.servo, 64) == 1
        assert energised and set(energised) == {400}
        await seen_deg(arm, at_deg + turns_deg)


async def test_a_restarted_clamp_without_a_command_is_seen_again_and_stays_limp() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, _):
        clamp.servo.reboot()
        await arm.read(1.0)
        old = arm.clamp()
        assert old is not None
        await asyncio.wait_for(state_after(arm, lambda: arm.clamp() != old), DEADLINE_S)
        assert (register(clamp.servo, 64), register(clamp.servo, 102, 2)) == (0, 400)


async def test_a_silent_clamp_gets_no_torque() -> None:
    """It may be starting: with its torque on before its settings it would hold with its largest current."""
    clamp = Clamp()
    async with (
        ServoBus([*new_servos(), clamp.servo]) as bus,
        DynamixelArm(device_on(bus.path), arm_config(), flight_clock(), CONFIG) as arm,
    ):
        clamp.servo.fail_silent(True)
        for _ in range(3):
            await arm.read(1.0)
        sent: list[bytes] = []
        answer = bus.answer_to

        def noted(data: bytes, baud_bps: int) -> tuple[bytes, float]:
            sent.append(data)
            return answer(data, baud_bps)

        bus.answer_to = noted  # type: ignore[method-assign]
        arm.command_clamp(ClampCommand.CLOSE)
        await asyncio.wait_for(until(lambda: len(sent) >= 10), DEADLINE_S)
        on = b"\x83" + bytes((64, 0, 1, 0, CONFIG.servo_id, 1))
        assert not any(on in data for data in sent)


async def test_a_hardware_error_of_the_clamp_is_reported_and_it_gets_no_torque() -> None:
    clamp = Clamp()
    async with on_bus(clamp) as (arm, _):
        await taken(arm, clamp, ClampCommand.CLOSE, EMPTY_DEG)
        await asyncio.wait_for(state_after(arm, lambda: register(clamp.servo, 64) == 1), DEADLINE_S)
        assert arm.problem == ""
        clamp.servo.trip_overload()
        await asyncio.wait_for(state_after(arm, lambda: bool(arm.problem)), DEADLINE_S)
        assert arm.problem.endswith("servo 13 (clamp): reports a hardware error: overload")
        written: list[int] = []
        write = clamp.servo.write

        def watched(address: int, data: bytes) -> None:
            written.append(address)
            write(address, data)

        clamp.servo.write = watched  # type: ignore[method-assign]
        for _ in range(10):
            await arm.read(1.0)
        arm.command_clamp(ClampCommand.OPEN)
        for _ in range(10):
            await arm.read(1.0)
        assert 64 not in written


async def state_after(arm: DynamixelArm, condition: Callable[[], bool]) -> None:
    """Read the joints until the condition holds."""
    while not condition():
        await arm.read(1.0)


@pytest.mark.parametrize(
    ("servo", "text"),
    [
        (None, r"servo 13 \(clamp\): does not answer at 3000000 baud; ids that answer: 11, 12"),
        ({"kind": "XM430-W210"}, r"servo 13 \(clamp\): is XM430-W210 .*the vehicle file says XL330-M288"),
    ],
    ids=["absent", "another model"],
)
async def test_a_clamp_that_is_not_as_expected_is_one_line(servo: dict[str, Any] | None, text: str) -> None:
    joints = new_servos()
    others = [] if servo is None else [Clamp(**servo).servo]
    async with ServoBus([*joints, *others]) as bus:
        with pytest.raises(DeviceError, match=text) as raised:
            async with DynamixelArm(device_on(bus.path), arm_config(), flight_clock(), CONFIG):
                pass
        assert "\n" not in str(raised.value)
    assert [register(joint, 64) for joint in joints] == [0, 0]
