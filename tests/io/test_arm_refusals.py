"""What the arm edge refuses to fly with: one line that says what was found, and servos left without torque."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest
import serial

from companion.config.arm import Arm as ArmConfig
from companion.config.arm import Joint
from companion.io.dynamixel.arm import DynamixelArm
from companion.runtime.clock import flight_clock
from sitl.servo import registers as reg
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from tests.io.arm_rig import arm_config, device_on, flying_arm, new_servos, register, state_when
from tests.io.refusal import refusal


async def opening(path: str, config: ArmConfig | None = None) -> str:
    """Text with which the edge refuses a port."""
    text = await refusal(DynamixelArm(device_on(path), config or arm_config(), flight_clock()))
    assert text.startswith(f"arm bus {path}: ")
    return text


def refused(servos: list[ServoModel], config: ArmConfig | None = None) -> str:
    """Text with which the edge refuses these servos; the servos are left without torque."""

    async def main() -> str:
        async with ServoBus(servos) as bus:
            text = await opening(bus.path, config)
            with serial.Serial(bus.path, exclusive=True):
                pass  # the port is free again
            return text

    text = asyncio.run(main())
    assert [register(servo, 64) for servo in servos] == [0] * len(servos)
    return text


async def test_a_port_that_is_missing_no_port_or_busy_is_refused(tmp_path: Path) -> None:
    missing = await opening("/dev/ttyUSB_not_here")
    assert missing.startswith("arm bus /dev/ttyUSB_not_here: no such port; ")
    assert "serial port" in missing and "devices.arm.port" in missing
    plain = tmp_path / "file"
    plain.touch()
    assert "not a usable serial port" in await opening(str(plain))
    async with ServoBus(new_servos()) as bus:
        with serial.Serial(bus.path, exclusive=True):
            assert "port is busy; another program" in await opening(bus.path)


async def test_second_companion_is_refused_and_the_first_flies_on() -> None:
    async with flying_arm() as setup:
        assert "port is busy" in await opening(setup.bus.path)
        await state_when(setup.arm, lambda s: s.read_failures == 0)


def changed(number: int, address: int, value: bytes) -> list[ServoModel]:
    servos = new_servos()
    servos[number].write(address, value)
    return servos


def tripped() -> list[ServoModel]:
    servos = new_servos()
    servos[1].trip_overload()
    return servos


@pytest.mark.parametrize(
    ("servos", "found"),
    [
        (lambda: new_servos()[:1], "servo 12 (joint 2): does not answer at 3000000 baud; ids that answer: 11;"),
        (lambda: new_servos(57600), "servo 11 (joint 1): does not answer at 3000000 baud; no servo answers at all;"),
        (
            lambda: [ServoModel(11, model=1020), ServoModel(12)],
            "servo 11 (joint 1): is XM430-W350 (model 1020); the vehicle file says XM430-W210",
        ),
        (tripped, "servo 12 (joint 2): reports a hardware error: overload (hardware error status (register 70) = 32)"),
        (
            lambda: new_servos(start_deg=(165.0, 170.0)),
            "servo 12 (joint 2): is at 170.0 deg (present position (register 132) = 2958), outside its limits -150 to 150 deg",
        ),
        (
            lambda: changed(0, 38, (400).to_bytes(2, "little")),
            "current limit (register 38) is 400, which is 1.40 N m; torque_max_nm 2.5 needs 714",
        ),
    ],
    ids=["absent", "baud rate", "model", "hardware error", "angle", "current limit"],
)
def test_a_servo_that_is_not_as_the_vehicle_file_says_is_refused_and_not_rebooted(
    servos: Callable[[], list[ServoModel]], found: str
) -> None:
    made = servos()
    errors = [register(servo, 70) for servo in made]
    assert found in refused(made)
    assert [register(servo, 70) for servo in made] == errors


def test_old_firmware_of_a_330_is_refused_because_its_addresses_differ() -> None:
    joint = Joint(servo="XL330-M288", servo_id=1, sign=1, zero_count=0, angle_deg=(-90, 90), torque_max_nm=0.4)
    servos = [ServoModel(1, kind="XL330-M288", firmware=52)]
    text = refused(servos, arm_config(joint, torque_per_amp_nm_a=None))
    assert "servo 1 (joint 1): has firmware 52; the XL330-M288 needs 53 or newer" in text


@pytest.mark.parametrize(
    ("register", "value", "named"),
    [
        (
            reg.HOMING_OFFSET,
            512,
            "homing offset (register 20) is 512, expected 0, because the vehicle file's zero_count",
        ),
        (reg.DRIVE_MODE, 1, "drive mode (register 10) is 1, expected 0, because the vehicle file's sign"),
        (reg.SECONDARY_ID, 11, "secondary id (register 12) is 11, expected 255, because it would follow another servo"),
        (reg.PWM_LIMIT, 300, "PWM limit (register 36) is 300, expected 885, because a lower limit gives less torque"),
        (
            reg.STARTUP,
            1,
            "startup configuration (register 60) is 1, expected 0, because after a restart it would switch",
        ),
        (reg.STARTUP, 2, "startup configuration (register 60) is 2, expected 0"),
        (reg.SHUTDOWN, 0x14, "shutdown (register 63) is 20, expected 52, because overheating, shock and overload"),
    ],
)
def test_eeprom_that_changes_a_meaning_is_refused_at_every_start(
    register: reg.Register, value: int, named: str
) -> None:
    text = refused(changed(1, register.address, register.encode(value)))
    assert f"servo 12 (joint 2): {named}" in text
    assert text.endswith("; run companion arm setup")
