"""An arm of another package: its contract, its joints, its states and torques in a flight, and its failures."""

from __future__ import annotations

import asyncio
import math
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import JsonValue

from companion.cli.main import main
from companion.config.arm import Arm, Joint
from companion.config.devices import ArmDevice
from companion.config.document import ConfigError
from companion.config.loader import load_flight, load_vehicle, logged_flight
from companion.config.vehicle import Vehicle
from companion.io.arm.plugin_driver import PluginArm
from companion.io.devices import open_arm
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_BAD_INPUT
from companion.model.launcher_messages import WorldMessage, WorldProgress
from companion.model.observations import ArmStatement, Observations
from companion.model.types import ArmState, SafetyAction
from companion.plugins import ARMS
from companion.preflight.arm import rows
from companion.runtime.clock import flight_clock
from companion.safety.arm import error_text
from companion.sitl_config.loader import load_sitl
from companion.testing import check_arm
from companion.testing.devices import _cycles, _refuse
from sitl.fast.loop import FastFlight
from sitl.server import Sitl
from sitl.servo.bus import ServoBus
from sitl.servo.model import ServoModel
from sitl.wires import MachineWires, Ports
from sitl.world.start import start_of
from tests.flights.ends import after
from tests.plugins.arms import NAMES, SCRIPTED, ODrives
from tests.plugins.installed import on_path, write_distribution
from tests.support import ROOT, SHORT_CATCH

EXAMPLE = ROOT / "examples/arm_odrive"
VEHICLE = (ROOT / "configs/vehicles/tarot650_2r.yaml").read_text(encoding="utf-8")
LONG_S = 30.0


@pytest.fixture(autouse=True)
def installed(tmp_path: Path) -> Iterator[None]:
    """Install the example, and a package whose arms fail."""
    (tmp_path / "companion_odrive.py").write_text((EXAMPLE / "companion_odrive.py").read_text())
    (tmp_path / "lab_arm.py").write_text(SCRIPTED)
    announced = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"][ARMS]
    write_distribution(tmp_path, "companion-odrive", "0.1.0", announced, ARMS)
    write_distribution(tmp_path, "lab-arm", "1.0", {name.lower(): f"lab_arm:{name}" for name in NAMES}, ARMS)
    with on_path(tmp_path):
        yield


def joint(number: int, sign: int, zero_count: int, **changes: Any) -> Joint:
    settings = {"servo": None, "servo_id": number, "sign": sign, "zero_count": zero_count, "angle_deg": (-170.0, 170.0)}
    return Joint.model_validate(settings | {"torque_max_nm": 20.0, "velocity_max_deg_s": 720.0} | changes)


def arm_of(*joints: Joint) -> Arm:
    each = (0.1,) * len(joints)
    return Arm(joints=joints, link_lengths_m=each, link_masses_kg=each, link_com_m=each)


ARM = arm_of(joint(3, 1, 0), joint(5, -1, 1024))
"""Joint 2 has its zero at a quarter of a turn."""


def device(name: str, **options: Any) -> ArmDevice:
    return ArmDevice(type=name, options=options)


def made() -> Any:
    """Return the newest arm of the package for tests."""
    import lab_arm  # type: ignore[import-not-found]

    return lab_arm.Steady.made[-1]


@contextmanager
def odrives(monkeypatch: pytest.MonkeyPatch) -> Iterator[ODrives]:
    import companion_odrive

    with ODrives(3, 5) as motors:
        monkeypatch.setattr(companion_odrive, "can_socket", lambda channel: motors.ours.dup())
        yield motors


def odrive(**changes: Any) -> ArmDevice:
    options = {"watchdog_timeout_s": 0.1, "gear_ratio": 8.0, "reply_timeout_s": LONG_S} | changes
    return ArmDevice(type="odrive", watchdog_ms=100, options=options)


ODRIVE_ARM = arm_of(joint(3, 1, 0), joint(5, -1, 0))


def servos_of(arm: Arm) -> ServoBus:
    """Return the simulated world's servos of an arm."""
    return ServoBus([ServoModel(one.servo_id, kind=one.kind.name, baud_bps=3_000_000) for one in arm.joints])


def on_bus(bus: ServoBus) -> ArmDevice:
    return ArmDevice(port=bus.path, watchdog_ms=1000)


async def state_when(arm: PluginArm, condition: Callable[[ArmState], object]) -> ArmState:
    async with asyncio.timeout(LONG_S):
        while True:
            state = await arm.read(1.0)
            if state is not None and condition(state):
                return state


# -- contract ------------------------------------------------------------------------------------------------------------------


def test_the_built_in_arm_keeps_the_contract() -> None:
    servos = [Joint(servo_id=number, sign=1, zero_count=0, angle_deg=(-90, 90), torque_max_nm=2.0) for number in (1, 2)]
    arm = arm_of(*servos)

    async def run() -> None:
        """Run `check_arm` in the event loop of the simulated servos, whose answers a busy computer delays."""
        async with servos_of(arm) as bus:
            for _ in range(2):
                await _cycles(on_bus(bus), arm, 0.5, failed_max=0.9)
        await _refuse(lambda: open_arm(ArmDevice(port="/dev/does-not-exist"), arm, flight_clock()))

    asyncio.run(run())


def test_the_example_keeps_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    with odrives(monkeypatch) as motors:
        check_arm(odrive(), ODRIVE_ARM, duration_s=0.2)
        while motors.states != {3: 1, 5: 1}:  # the last frames are still on the bus
            time.sleep(0.001)
        assert motors.torques_nm == {3: 0.0, 5: 0.0}


@pytest.mark.parametrize(
    ("name", "options", "found"),
    [
        ("raising", {"after": 30}, "reads failed: OSError: bus off"),
        ("unwritable", {"after": 60}, r"reads failed: RuntimeError: write_torque\(\) raised OSError: buffer full"),
        ("nan", {"after": 30}, "reads failed: ValueError: .* for joint 1, expected finite values"),
        ("faulty", {"after": 30}, "servo 1: fault of the motor: see the log"),
        ("stays", {}, "still running after the arm was closed: arm-bus"),
        ("steady", {"afer": 1}, "Extra inputs are not permitted"),
    ],
)
def test_an_arm_that_breaks_the_contract_is_told_how(name: str, options: dict[str, JsonValue], found: str) -> None:
    with pytest.raises(AssertionError, match=found):
        check_arm(device(name, **options), ARM, duration_s=0.5)


def test_an_arm_where_there_is_none_breaks_the_contract() -> None:
    with pytest.raises(AssertionError, match="although nothing is at this address"):
        check_arm(device("steady"), ARM, absent=device("steady"), duration_s=0.05)


# -- before a take-off ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("absent", r"arm 'absent' \(lab-arm 1.0\): cannot be opened: ConnectionError: no motor$"),
        ("unmade", r"arm 'unmade' \(lab-arm 1.0\): cannot be opened: TypeError: "),
        ("nooff", r"arm 'nooff' \(lab-arm 1.0\): its class has no method torque_off\(\)"),
        ("raising", r"\(lab-arm 1.0\): cannot be opened: OSError: bus off$"),
        ("unwritable", r"\(lab-arm 1.0\): failed while being set up: RuntimeError: write_torque\(\) raised OSError: buffer full"),
        ("nan", r"cannot be opened: ValueError: read\(\) returned .* for joint 1, expected finite values"),
        ("short", r"cannot be opened: TypeError: read\(\) returned 1 states, expected 2, one for each joint"),
        ("wrong", r"cannot be opened: TypeError: read\(\) returned \(0.5, -0.25\), expected a list of MotorState"),
        ("slow", r"\(lab-arm 1.0\): read\(\) and write_torque\(\) take \d+\.\d ms or more \(limit 5 ms, one tick\)"),
        ("unwatched", "its attribute 'watchdog' does not state what makes the arm limp when the companion dies"),
        ("patient", r"'watchdog_ms' is 101, expected above 0 and at most devices.arm.watchdog_ms \(100 ms\)"),
        ("timeless", r"'watchdog_ms' is nan, expected above 0"),
        ("nowhere", "arm 'nowhere': is not installed; installed: dynamixel, absent, faulty, "),
    ],
)  # fmt: skip
def test_an_arm_that_cannot_be_used_refuses_the_flight_with_its_name(name: str, expected: str) -> None:
    async def run() -> None:
        with pytest.raises(DeviceError, match=expected):
            await open_arm(device(name, after=0), ARM, flight_clock()).__aenter__()

    before = set(threading.enumerate())
    asyncio.run(run())
    assert set(threading.enumerate()) <= before


def test_an_arm_that_is_refused_is_left_without_torque() -> None:
    async def run() -> None:
        with pytest.raises(DeviceError, match=r"joint 2 is at 175.7 deg, outside its limits -170 to 170 deg"):
            await open_arm(device("steady", angles=[0.5, math.radians(90.0 - 175.7)]), ARM, flight_clock()).__aenter__()

    asyncio.run(run())
    assert made().calls == ["open", "torque_off", "close"] and made().written == [(0.0, 0.0)]


def vehicle_file(tmp_path: Path, device_lines: str, servo: str = "null", without: str = "no such line") -> Path:
    head, devices, tail = VEHICLE.partition("\ndevices:\n")
    text = head + devices + tail.replace("  arm:\n", f"  arm:\n    {device_lines}\n", 1)
    text = text.replace("    - servo_id", f"    - servo: {servo}\n      servo_id")
    if servo == "null":
        text = text.replace("  torque_per_amp_nm_a: 1.3\n", "")
    path = tmp_path / "vehicle.yaml"
    path.write_text("".join(line for line in text.splitlines(keepends=True) if without not in line), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("device_lines", "servo", "expected"),
    [
        ("type: odrive\n    options: {}", "null", "devices.arm.options.watchdog_timeout_s: Field required"),
        ("type: moteus", "null", "devices.arm.type: arm 'moteus': is not installed; installed: dynamixel, absent,"),
        ("type: steady\n    options: {after: true}", "null", "devices.arm.options.after: Input should be a valid integer"),
        ("type: nooptions", "null", "(lab-arm 1.0): its attribute 'options' is not a subclass"),
        ("type: steady", "XM430-W210", "arm.joints[0].servo: must be null, because devices.arm.type is steady"),
        ("type: dynamixel", "null", "arm.joints[1].servo: expected the model of the servo, because devices.arm.type is dynamixel"),
        ("options: {a: 1}", "XM430-W210", "devices.arm.options.a: Extra inputs are not permitted"),
    ],
)  # fmt: skip
def test_settings_are_checked_with_the_vehicle_file(
    tmp_path: Path, device_lines: str, servo: str, expected: str
) -> None:
    with pytest.raises(ConfigError, match=r"vehicle\.yaml:\d+:\d+: ") as refused:
        load_vehicle(vehicle_file(tmp_path, device_lines, servo))
    assert expected in str(refused.value)


@pytest.mark.parametrize(
    ("without", "override", "expected"),
    [
        ("velocity_max", "name=lab", "arm.joints[0].velocity_max_deg_s: missing; required if servo is null"),
        ("-", "arm.joints[1].torque_per_amp_nm_a=1.3", "must be absent, because servo is null"),
        ("-", "arm.torque_per_amp_nm_a=1.3", "must be absent, because arm.joints[].servo is null"),
        ("-", "safety.servo_current_max_a=1.0", "must be null, because arm.joints[].servo is null"),
    ],
)  # fmt: skip
def test_settings_of_servos_are_refused_for_other_motors(
    tmp_path: Path, without: str, override: str, expected: str
) -> None:
    path = vehicle_file(tmp_path, "type: steady", without=without if without != "-" else "no such line")
    with pytest.raises(ConfigError) as refused:
        load_vehicle(path, [f"vehicle.{override}"])
    assert expected in str(refused.value) and (without != "-" or override.split("=")[0] in str(refused.value))


# -- in a flight ---------------------------------------------------------------------------------------------------------------


def test_angles_rates_and_torques_are_those_of_the_joints() -> None:
    async def run() -> None:
        async with PluginArm(device("steady"), ARM, flight_clock()) as arm:
            state = arm.latest()
            assert state is not None and state.read_failures == 0 and state.temperature_c == (40.0, 40.0)
            assert state.angle_rad == pytest.approx((0.5, 0.5 * math.pi + 0.25))
            assert state.velocity_rad_s == (2.0, -2.0) and state.torque_nm == (0.75, -0.75)
            assert arm.write_torque((-25.0, 3.0)) == (-20.0, 3.0)
            written = await state_when(arm, lambda state: (-20.0, -3.0) in made().written)
            assert written.written_s is not None
            with pytest.raises(ValueError, match="not finite"):
                arm.write_torque((math.nan, 0.0))

    asyncio.run(run())
    assert made().calls == ["open", "torque_off", "close"] and made().written[-1] == (0.0, 0.0)


async def test_a_torque_that_is_not_renewed_is_withdrawn() -> None:
    async with PluginArm(device("steady"), ARM, flight_clock()) as arm:
        arm.write_torque((1.0, 1.0))
        await state_when(arm, lambda state: (1.0, -1.0) in made().written)
        await state_when(arm, lambda state: made().written[-1] == (0.0, 0.0))


async def test_whole_turns_of_a_motor_do_not_matter() -> None:
    turned = [0.5 + 6.0 * math.pi, -0.25 - 2.0 * math.pi]
    async with PluginArm(device("steady", angles=turned), ARM, flight_clock()) as arm:
        state = arm.latest()
        assert state is not None and state.angle_rad == pytest.approx((0.5, 0.5 * math.pi + 0.25))


@pytest.mark.parametrize("name", ["raising", "nan", "short", "unwritable"])
async def test_an_arm_that_fails_in_the_air_counts_failed_cycles(name: str) -> None:
    async with PluginArm(device(name, after=60), ARM, flight_clock()) as arm:
        async with asyncio.timeout(LONG_S):
            while (state := await arm.read(1.0)) is None or state.read_failures < 5:
                arm.write_torque((0.0, 0.0))
        assert arm.problem


async def test_a_fault_of_a_motor_is_a_hardware_error() -> None:
    async with PluginArm(device("faulty", after=60), ARM, flight_clock()) as arm:
        state = await state_when(arm, lambda state: any(state.hardware_error))
        assert error_text(state.hardware_error) == "servo 1: fault of the motor"


async def test_an_odrive_turns_into_a_joint(monkeypatch: pytest.MonkeyPatch) -> None:
    with odrives(monkeypatch) as motors:
        async with PluginArm(odrive(), ODRIVE_ARM, flight_clock()) as arm:
            assert arm.statement == ArmStatement(
                "ODrive, firmware 0.6.10 and 0.6.10",
                "the ODrives' own watchdogs, as set with odrivetool (not read), after 100 ms",
            )
            state = arm.latest()
            assert state is not None and motors.states == {3: 8, 5: 8}
            assert state.angle_rad == pytest.approx((0.75 / 8 * 2 * math.pi, -1.25 / 8 * 2 * math.pi))
            assert state.velocity_rad_s == pytest.approx((math.pi / 8, -math.pi / 8))
            assert state.temperature_c == (42.0, 42.0)
            # Renewed, because a torque is withdrawn after 0.1 s.
            state = await state_when(arm, lambda state: arm.write_torque((4.0, 2.0)) and state.torque_nm[1] == 2.0)
            assert state.torque_nm == (4.0, 2.0)
            motors.errors[5] = 0x2000
            state = await state_when(arm, lambda state: any(state.hardware_error))
            assert error_text(state.hardware_error) == "servo 2: fault of the motor"


def test_an_odrive_that_is_silent_or_has_a_slow_watchdog_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    async def refused(here: ArmDevice) -> str:
        with pytest.raises(DeviceError) as error:
            await PluginArm(here, ODRIVE_ARM, flight_clock()).__aenter__()
        return str(error.value)

    with odrives(monkeypatch) as motors:
        slow = asyncio.run(refused(odrive(watchdog_timeout_s=0.2)))
        assert "'watchdog_ms' is 200, expected above 0 and at most devices.arm.watchdog_ms (100 ms)" in slow
        motors.silent = True
        monkeypatch.setattr("companion_odrive._START_TIMEOUT_S", 0.05)
        assert "no answer from nodes [3, 5] within 50 ms" in asyncio.run(refused(odrive()))


def test_a_late_answer_of_an_odrive_is_not_taken_for_the_answer_to_a_later_request(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import companion_odrive

    with odrives(monkeypatch) as motors:
        options = companion_odrive.ODriveOptions(watchdog_timeout_s=0.1, reply_timeout_s=0.3)
        arm = companion_odrive.ODriveArm(options, odrive(), ODRIVE_ARM.joints)
        motors.go_on.clear()
        with pytest.raises(TimeoutError, match=r"no answer from nodes \[3, 5\] within 300 ms"):
            arm.read()
        motors.go_on.set()
        while motors.answers < 2 * 4:  # angle, torque, errors and temperature of each
            time.sleep(0.001)
        for nm in (1.0, 2.0, 3.0):
            arm.write_torque((nm, nm))
            assert [state.torque_nm for state in arm.read()] == [nm, nm]
        arm.close()


# -- preflight, tools, lists and logs ------------------------------------------------------------------------------------------


def plugin_vehicle(tmp_path: Path) -> Vehicle:
    return load_vehicle(vehicle_file(tmp_path, "type: steady"))


def test_the_preflight_shows_what_the_arm_states(tmp_path: Path) -> None:
    state = ArmState(
        stamp_s=0.0, angle_rad=(1.5, 0.5), velocity_rad_s=(0.0, 0.0), torque_nm=(0.0, 0.0), hardware_error=(0, 0),
        temperature_c=(40.0, 0.0), read_failures=0,
    )  # fmt: skip
    seen = Observations(
        start_s=0.0, duration_s=1.0, arm=(state,), arm_statement=ArmStatement("Steady 1.0", "a relay after 0.1 s")
    )
    found = {row.id: row for row in rows(seen, plugin_vehicle(tmp_path))}
    assert found["arm.device"].read == "steady: Steady 1.0"
    assert found["arm.watchdog"].ok and found["arm.watchdog"].read == "as steady states: a relay after 0.1 s"
    assert not found["arm.temperature"].ok and found["arm.temperature"].read == "not reported by every motor"
    assert "arm.usb_latency" not in found and "arm.model" not in found


@pytest.mark.parametrize("tool", ["scan", "setup", "zero", "friction"])
def test_the_tools_for_servos_refuse_another_arm(tool: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = vehicle_file(tmp_path, "type: steady")
    assert main(["arm", tool, "--vehicle", str(path)]) == EXIT_BAD_INPUT
    expected = f"companion arm {tool}: works with dynamixel servos only; devices.arm.type is steady"
    assert expected in capsys.readouterr().err


def test_the_list_of_plug_ins_names_each_arm(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins"]) == EXIT_BAD_INPUT
    lines = {line.split("  ")[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "companion-aerial-manipulation" in lines["dynamixel"] and "Dynamixel servos on a U2D2" in lines["dynamixel"]
    assert "companion-odrive" in lines["odrive"] and "ODrive motor controllers on CAN" in lines["odrive"]
    assert "cannot be used: its attribute 'options' is not a subclass" in lines["nooptions"]


def test_a_log_is_read_without_the_arm(tmp_path: Path) -> None:
    path = vehicle_file(tmp_path, "type: moteus")
    logged = load_flight("hover", path)
    assert logged_flight(logged.model_dump_json()).vehicle.arm_device.type == "moteus"
    with pytest.raises(ConfigError, match="'moteus': is not installed"):
        load_flight("hover", path, overrides=["vehicle.devices.mocap.interface=10.0.0.1"], hardware=True)


# -- simulated world -----------------------------------------------------------------------------------------------------------


def test_the_simulated_world_has_servos_with_the_torque_of_the_motors(tmp_path: Path) -> None:
    vehicle = load_flight("hover", vehicle_file(tmp_path, "type: moteus")).vehicle
    messages: list[WorldMessage] = []
    server = Sitl(
        [
            MachineWires(
                vehicle, load_sitl("hover").world, start_of((0.0, 0.0), 0.0, (0.0, 0.0)), Ports(), messages.append
            )
        ]
    )

    async def served() -> None:
        async with server.wires() as (devices,):
            assert devices["arm"].items() >= {"type": "dynamixel", "options": {}}.items()

    asyncio.run(served())
    assert messages == [
        WorldProgress("devices.arm.type: the simulated world has a dynamixel, which is used in place of moteus")
    ]


async def test_an_arm_of_strong_motors_opens_in_the_simulated_world() -> None:
    async with servos_of(ODRIVE_ARM) as bus, open_arm(on_bus(bus), ODRIVE_ARM, flight_clock()) as arm:
        assert arm.write_torque((20.0, -0.5)) == pytest.approx((20.0, -0.5), abs=0.02)


def test_a_vehicle_with_another_arm_catches_in_the_fast_loop(tmp_path: Path) -> None:
    config = load_sitl(SHORT_CATCH, vehicle_file(tmp_path, "type: moteus"))
    result = FastFlight(config).run(until=after("catch", 0.5))
    assert result.caught and not result.crashed and result.outputs[-1].action is SafetyAction.NOMINAL
