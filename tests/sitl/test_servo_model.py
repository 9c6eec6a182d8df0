"""One emulated servo: register rules, units, motor, watchdog, hardware errors."""

from __future__ import annotations

import math

import pytest

from companion.config.loader import load_vehicle
from companion.sitl_config.world import World
from sitl.servo.bus import ServoLine
from sitl.servo.from_config import servos_of
from sitl.servo.model import AMP_PER_COUNT as AMP
from sitl.servo.model import RAD_PER_COUNT, ServoModel, ServoRefusal
from sitl.servo.protocol import ALERT, StatusError, packet, status

VEHICLE = load_vehicle("tarot650_2r")


def word(value: int, size: int = 2) -> bytes:
    return value.to_bytes(size, "little", signed=value < 0)


def get(servo: ServoModel, address: int, size: int, *, signed: bool = False) -> int:
    return int.from_bytes(servo.read(address, size), "little", signed=signed)


def refusal(servo: ServoModel, address: int, data: bytes) -> StatusError:
    with pytest.raises(ServoRefusal) as caught:
        servo.write(address, data)
    return caught.value.error


def in_current_mode(servo_id: int = 1) -> ServoModel:
    servo = ServoModel(servo_id)
    servo.write(11, b"\x00")
    servo.write(64, b"\x01")
    return servo


# --- registers ------------------------------------------------------------------------------------------------------------


def test_eeprom_is_locked_while_torque_is_on() -> None:
    servo = in_current_mode()
    assert refusal(servo, 9, b"\x00") is StatusError.ACCESS
    assert refusal(servo, 11, b"\x03") is StatusError.ACCESS
    servo.write(64, b"\x00")
    servo.write(11, b"\x05")
    assert get(servo, 11, 1) == 5


def test_goal_current_beyond_the_current_limit_is_refused() -> None:
    servo = ServoModel(1)
    servo.write(11, b"\x00")
    servo.write(38, word(500))
    assert refusal(servo, 102, word(501)) is StatusError.DATA_LIMIT
    assert refusal(servo, 102, word(-1194)) is StatusError.DATA_RANGE
    servo.write(102, word(-500))
    assert get(servo, 102, 2, signed=True) == -500


def test_a_write_of_several_registers_is_all_or_nothing() -> None:
    servo = ServoModel(1)
    assert refusal(servo, 64, b"\x01\x07") is StatusError.DATA_RANGE
    assert get(servo, 64, 1) == 0


def test_position_starts_within_one_turn_and_then_counts_turns() -> None:
    servo = ServoModel(1)
    servo.update(0.0, -1.0, 0.0)
    start = get(servo, 132, 4, signed=True)
    assert start == 4096 - round(1.0 / RAD_PER_COUNT)
    servo.update(0.001, -1.0 - 4.0 * math.pi, 0.0)
    assert get(servo, 132, 4, signed=True) == start - 2 * 4096
    servo.reboot()
    assert get(servo, 132, 4, signed=True) == start


def test_the_startup_configuration_switches_the_torque_on() -> None:
    servo = in_current_mode()
    servo.write(64, b"\x00")
    servo.write(60, b"\x01")
    servo.reboot()
    assert get(servo, 64, 1) == 1
    servo.write(64, b"\x00")
    servo.write(60, b"\x00")
    servo.reboot()
    assert get(servo, 64, 1) == 0


def test_settings_of_the_world_are_in_their_registers() -> None:
    settings = {
        "firmware": 40,
        "id": 9,
        "return_delay_us": 100,
        "drive_mode": 1,
        "operating_mode": 5,
        "shadow_id": 7,
        "current_limit_counts": 600,
        "position_limit_counts": (10, 4000),
    }
    _, servo = servos_of(VEHICLE, World.model_validate({"servos": [{}, settings]}))
    assert [get(servo, address, 1) for address in (6, 7, 9, 10, 11, 12)] == [40, 9, 50, 1, 5, 7]
    assert (get(servo, 38, 2), get(servo, 48, 4), get(servo, 52, 4)) == (600, 4000, 10)


# --- motor ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [3, 5])
def test_position_modes_hold_against_a_load(mode: int) -> None:
    servo = ServoModel(1, shaft_angle_rad=1.0)
    servo.write(11, bytes((mode,)))
    servo.write(64, b"\x01")
    servo.write(116, word(1024, 4))
    angle, velocity, dt, inertia, load_nm = 1.0, 0.0, 1e-3, 0.02, 0.3
    for step in range(3000):
        torque = 1.3 * servo.update(step * dt, angle, velocity) - load_nm
        velocity += torque / inertia * dt
        angle += velocity * dt
    assert angle == pytest.approx(math.pi / 2, abs=0.03)
    assert abs(velocity) < 0.01


def test_watchdog_trips_and_stays_until_cleared() -> None:
    servo = in_current_mode()
    line = ServoLine([servo])
    servo.write(98, b"\x05")
    servo.write(102, word(200))
    servo.update(1.0, 0.0, 0.0)
    line.feed(packet(7, b"\x01"))  # a packet for another servo counts
    assert servo.update(1.099, 0.0, 0.0) != 0.0
    assert servo.update(1.101, 0.0, 0.0) == 0.0
    assert get(servo, 98, 1) == 0xFF
    assert get(servo, 102, 2) == 0
    for address, data in ((102, word(10)), (100, word(10)), (104, word(10, 4)), (116, word(10, 4)), (98, b"\x05")):
        assert refusal(servo, address, data) is StatusError.DATA_RANGE
    servo.write(98, b"\x00")
    servo.write(102, word(10))
    assert servo.update(1.2, 0.0, 0.0) == pytest.approx(10 * AMP)


def test_overload_lets_go_until_reboot() -> None:
    servo = in_current_mode()
    line = ServoLine([servo])
    servo.write(102, word(200))
    servo.trip_overload()
    assert servo.update(0.001, 0.0, 0.0) == 0.0
    assert get(servo, 64, 1) == 0
    assert get(servo, 70, 1) == 0x20
    assert line.feed(packet(1, bytes((3, 64, 0, 1)))) == status(1, ALERT | StatusError.RESULT_FAIL)
    assert line.feed(packet(1, b"\x08"))[8] == 0
    assert get(servo, 70, 1) == 0
    servo.write(64, b"\x01")
    assert get(servo, 11, 1) == 0, "EEPROM outlives a reboot"
    assert get(servo, 102, 2) == 0, "RAM does not"
