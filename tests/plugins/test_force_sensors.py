"""A force sensor of another package: its contract, its settings, its samples in a flight, and its failures."""

from __future__ import annotations

import asyncio
import math
import socket
import struct
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from pydantic import JsonValue

from companion.cli.main import main
from companion.config.devices import ForceDevice
from companion.config.document import ConfigError
from companion.config.loader import load_flight, load_vehicle
from companion.flight.main import plugins_of_others
from companion.io.force_torque.plugin_driver import PluginForceTorque, open_force
from companion.io.protocols import DeviceError
from companion.model.exit_codes import EXIT_BAD_INPUT
from companion.model.launcher_messages import WorldMessage, WorldProgress
from companion.plugins import FORCE_SENSORS
from companion.runtime.clock import flight_clock
from companion.sitl_config.world import World
from companion.testing import check_force_sensor
from sitl.force_torque import ForceTorqueServer
from sitl.server import Sitl
from sitl.wires import MachineWires, Ports
from sitl.world.start import start_of
from tests.plugins.installed import on_path, write_distribution
from tests.support import ROOT

EXAMPLE = ROOT / "examples/force_ati"
VEHICLE = (ROOT / "configs/vehicles/tarot650_2r.yaml").read_text(encoding="utf-8")
SCRIPTED = '''
import math, time
from companion.config.base import Model
from companion.io.force_torque.sensor import Reading

class Options(Model):
    """For tests."""
    after: int = 0
    force: list[float] = [0.0, 0.0, 0.0]

class Steady:
    options, product_name = Options, "Steady 1.0"
    def __init__(self, options, device):
        self.left, self.force, self.period_s = options.after, options.force, 1.0 / device.rate_hz
    def open(self): pass
    def read(self):
        time.sleep(self.period_s)
        self.left -= 1
        return self.later() if self.left < 0 else self.reading()
    def reading(self):
        x, y, z = self.force
        return Reading((x, y, z + 1e-3 * (self.left % 7)), (0.0, 0.0, 0.0))
    later = reading
    def close(self): pass
class Raising(Steady):
    def later(self): raise OSError("unplugged\\nby hand")
class Nan(Steady):
    def later(self): return Reading((0.0, math.nan, 0.0), (0.0, 0.0, 0.0))
class Gaps(Steady):
    def later(self): return Nan.later(self) if self.left % 3 == 0 else self.reading()
class Short(Steady):
    def later(self): return Reading((0.0, 0.0), (0.0, 0.0, 0.0))
class Wrong(Steady):
    def later(self): return (1.0, 2.0, 3.0, 0.0, 0.0, 0.0)
class Silent(Steady):
    def later(self): return None
class Hanging(Steady):
    def close(self): time.sleep(3.0)
class Same(Steady):
    def reading(self): return Reading((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    later = reading
class Restless(Steady):
    def read(self):
        self.left -= 1
        return self.reading()
class Absent(Steady):
    def open(self): raise ConnectionError("no sensor\\nat this address")
class Unmade(Steady):
    def __init__(self): pass
class NoRead:
    options, product_name = Options, "Half 1.0"
    def __init__(self, options, device): pass
    def open(self): pass
    def close(self): pass
class NoOptions(Steady):
    options = None
class Lively:
    def close(self): raise RuntimeError("no close")
class Unclosed(Lively, Steady): pass
'''
NAMES = ("Steady", "Raising", "Nan", "Gaps", "Short", "Wrong", "Silent", "Hanging", "Same", "Restless", "Absent", "Unmade", "NoRead",
         "NoOptions", "Unclosed")  # fmt: skip


@pytest.fixture(autouse=True)
def installed(tmp_path: Path) -> Iterator[None]:
    """Install the example, and a package whose sensors fail."""
    (tmp_path / "companion_ati.py").write_text((EXAMPLE / "companion_ati.py").read_text())
    (tmp_path / "lab_force.py").write_text(SCRIPTED)
    announced = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"][FORCE_SENSORS]
    write_distribution(tmp_path, "companion-ati", "0.1.0", announced, FORCE_SENSORS)
    write_distribution(
        tmp_path, "lab-force", "1.0", {name.lower(): f"lab_force:{name}" for name in NAMES}, FORCE_SENSORS
    )
    with on_path(tmp_path):
        yield


def sensor(name: str, rate_hz: int = 200, **options: JsonValue) -> ForceDevice:
    return ForceDevice(type=name, rate_hz=rate_hz, options=options)


class NetFt:
    """A Net F/T box on the loopback interface: streams records from its start to its stop."""

    def __init__(self) -> None:
        self.requests: list[tuple[int, int, int]] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.002)
        self.port = self._socket.getsockname()[1]
        self.sequence = 2**32 - 20
        """The counter overflows in the stream."""
        self.status = 0
        self.broken = b""
        """Bytes sent in place of the records."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> NetFt:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        peer = None
        while not self._ended.is_set():
            try:
                request, sender = self._socket.recvfrom(64)
                self.requests.append(struct.unpack(">HHI", request))
                peer = sender if self.requests[-1][1] == 2 else None
            except TimeoutError:
                pass
            if peer is not None:
                self.sequence = (self.sequence + 1) % 2**32
                counts = (1_500_000, -250_000, 10_000 * (self.sequence % 7), 2000, -3000, 0)
                record = struct.pack(">3I6i", self.sequence, 0, self.status, *counts)
                self._socket.sendto(self.broken or record, peer)


def ati(port: int) -> ForceDevice:
    options: dict[str, JsonValue] = {"host": "127.0.0.1", "port": port, "counts_per_nm": 1000.0}
    return ForceDevice(type="ati", rate_hz=500, options=options)


def ati_sensor(port: int) -> Any:
    """Return the example's sensor, opened without the driver."""
    import companion_ati

    sensor = companion_ati.AtiNetFt(companion_ati.AtiOptions.model_validate(ati(port).options), ati(port))
    sensor.open()
    return sensor


@contextmanager
def rft60() -> Iterator[ForceDevice]:
    """The simulated world's sensor with noise, in a thread with an event loop of its own."""
    ready, ended, ports = threading.Event(), threading.Event(), list[str]()

    async def run() -> None:
        async with ForceTorqueServer() as server:
            ports.append(server.port)
            ready.set()
            loop = asyncio.get_running_loop()
            while not ended.is_set():
                server.set_wrench((0.0, 0.0, 0.1 * math.sin(50.0 * loop.time())), (0.0, 0.0, 0.0))
                server.tick(loop.time())
                await asyncio.sleep(0.002)

    thread = threading.Thread(target=asyncio.run, args=(run(),))
    thread.start()
    ready.wait()
    try:
        yield ForceDevice(port=ports[0])
    finally:
        ended.set()
        thread.join()


# -- contract ------------------------------------------------------------------------------------------------------------------


def test_the_built_in_sensor_keeps_the_contract() -> None:
    with rft60() as device:
        check_force_sensor(device, absent=ForceDevice(port="/dev/does-not-exist"))


def test_the_example_keeps_the_contract() -> None:
    with NetFt() as box:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
            nobody.bind(("127.0.0.1", 0))
            check_force_sensor(ati(box.port), absent=ati(nobody.getsockname()[1]), duration_s=0.2)
        assert box.requests[0] == (0x1234, 2, 0) and box.requests[-1] == (0x1234, 0, 0)


def test_a_steady_sensor_keeps_the_contract() -> None:
    check_force_sensor(sensor("steady"), duration_s=0.1)


@pytest.mark.parametrize(
    ("device", "found"),
    [
        (sensor("gaps", after=9), "readings were invalid"),
        (sensor("same"), r"all 20 samples are equal: \(\(1.0, 2.0, 3.0\)"),
        (sensor("restless", rate_hz=10), r"samples per second, expected 10; does read\(\) wait"),
        (sensor("steady", force=[0.0, 250.0, 0.0]), "samples are overloaded, with nothing on the sensor"),
        (sensor("hanging"), r"still running after the sensor was closed: force hanging"),
        (sensor("steady", afer=1), "Extra inputs are not permitted"),
    ],
)
def test_a_sensor_that_breaks_the_contract_is_told_how(device: ForceDevice, found: str) -> None:
    with pytest.raises(AssertionError, match=found):
        check_force_sensor(device, duration_s=20 / device.rate_hz)


def test_a_sensor_where_there_is_none_breaks_the_contract() -> None:
    with pytest.raises(AssertionError, match="although nothing is at this address"):
        check_force_sensor(sensor("steady"), absent=sensor("steady"), duration_s=0.1)


# -- before a take-off ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("absent", r"force sensor 'absent' \(lab-force 1.0\): cannot be opened: ConnectionError: no sensor$"),
        ("unmade", r"force sensor 'unmade' \(lab-force 1.0\): cannot be opened: TypeError: .*takes 1 positional argument"),
        ("noread", r"force sensor 'noread' \(lab-force 1.0\): its class has no method read\(\)"),
        ("raising", r"\(lab-force 1.0\): 0 of 5 samples .*; read\(\) raised OSError: unplugged$"),
        ("nan", r"0 of 5 samples .*; ValueError: force \(0.0, nan, 0.0\) N, .* expected finite values"),
        ("short", r"0 of 5 samples .*; ValueError: not enough values"),
        ("wrong", r"0 of 5 samples .*; TypeError: read\(\) returned \(1.0, .*, expected a Reading or None"),
        ("silent", r"0 of 5 samples .*; read\(\) returned none"),
        ("nowhere", r"force sensor 'nowhere': is not installed; installed: rft60, absent, ati, "),
    ],
)  # fmt: skip
def test_a_sensor_that_cannot_be_used_refuses_the_flight_with_its_name(name: str, expected: str) -> None:
    async def run() -> None:
        driver = PluginForceTorque(sensor(name), flight_clock(), first_timeout_s=0.2)
        with pytest.raises(DeviceError, match=expected):
            await driver.__aenter__()

    asyncio.run(run())
    assert not [thread for thread in threading.enumerate() if thread.name == f"force {name}"]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("type: ati\n    options: {host: 3}", "devices.force.options.host: Input should be a valid string"),
        ("type: ati\n    options: {}", "devices.force.options.host: Field required"),
        ("type: bota", "devices.force.type: force sensor 'bota': is not installed; installed: rft60, absent, ati"),
        ("type: nooptions", "(lab-force 1.0): its attribute 'options' is not a subclass"),
        ("options: {a: 1}", "devices.force.options.a: Extra inputs are not permitted"),
        ("rate_hz: 250", "devices.force.rate_hz: expected one of 200, 333, got 250"),
    ],
)  # fmt: skip
def test_settings_are_checked_with_the_vehicle_file(tmp_path: Path, lines: str, expected: str) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE.replace("  force:\n", f"  force:\n    {lines}\n", 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"vehicle\.yaml:\d+:\d+: devices\.force") as refused:
        load_vehicle(path)
    assert expected in str(refused.value)


def test_the_built_in_sensor_needs_a_port(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(
        VEHICLE.replace("    port: /dev/serial/by-id/usb-FTDI_USB-RS485_Cable_FT3RFT60-if00-port0\n", ""),
        encoding="utf-8",
    )
    with pytest.raises(ConfigError, match=r"devices.force.port: missing; the serial port of the sensor"):
        load_vehicle(path)


# -- in a flight ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "lost"), [("raising", "read() raised OSError: unplugged"), ("silent", None), ("nan", None)]
)
async def test_a_sensor_that_fails_in_the_air_leaves_its_last_sample(name: str, lost: str | None) -> None:
    async with open_force(sensor(name, after=8), flight_clock()) as driver:
        with pytest.raises(DeviceError, match="none in the last 1 s"):
            await driver.tare_samples(1.0)
        assert driver.latest() is not None
        assert driver.counts().samples == 8 and driver.counts().lost == lost


async def test_a_force_beyond_its_range_counts_as_an_overload() -> None:
    async with open_force(sensor("steady", force=[0.0, -201.0, 0.0]), flight_clock()) as driver:
        sample = driver.latest()
        assert sample is not None and sample.overload and sample.force_sensor_n[:2] == (0.0, -201.0)


async def test_a_sensor_that_raises_when_it_is_closed_is_closed() -> None:
    async with open_force(sensor("unclosed"), flight_clock()):
        pass


async def test_records_of_a_net_ft_box_become_newtons() -> None:
    with NetFt() as box:
        async with open_force(ati(box.port), flight_clock()) as driver:
            samples = await driver.tare_samples(0.05)
            assert {sample.force_sensor_n[:2] for sample in samples} == {(1.5, -0.25)}
            assert samples[-1].torque_sensor_nm == (2.0, -3.0, 0.0) and not samples[-1].overload
            box.status = 0x80000000
            while not (await driver.tare_samples(0.002))[0].overload:
                pass
            box.sequence -= 100  # records out of order are ignored
            assert driver.counts().bad_sums == 0


def test_of_records_that_wait_the_newest_is_read() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(("127.0.0.1", 0))
        sensor = ati_sensor(box.getsockname()[1])
        _, peer = box.recvfrom(64)
        for number in range(100):
            box.sendto(struct.pack(">3I6i", number, 0, 0, number * 1_000_000, 0, 0, 0, 0, 0), peer)
        assert sensor.read().force_n[0] == 99.0
        sensor.close()


def test_a_box_that_was_restarted_is_read_again() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(("127.0.0.1", 0))
        address = box.getsockname()
        sensor = ati_sensor(address[1])
    for _ in range(30):  # nobody listens at its port: the kernel refuses what is sent
        assert sensor.read() is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as box:
        box.bind(address)
        box.setblocking(False)
        peer = None
        while peer is None:
            assert sensor.read() is None
            with suppress(BlockingIOError):
                _, peer = box.recvfrom(64)
        box.sendto(struct.pack(">3I6i", 0, 0, 0, 1_000_000, 0, 0, 0, 0, 0), peer)
        assert sensor.read().force_n[0] == 1.0
        sensor.close()


async def test_a_record_of_the_wrong_size_ends_the_stream() -> None:
    with NetFt() as box:
        async with open_force(ati(box.port), flight_clock()) as driver:
            box.broken = b"short"
            with pytest.raises(DeviceError, match=r"read\(\) raised error: unpack requires"):
                await driver.tare_samples(60.0)


# -- lists and logs ------------------------------------------------------------------------------------------------------------


def test_only_the_built_in_sensor_has_a_zero_to_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "vehicle.yaml"
    options = "type: steady\n    options: {}"
    path.write_text(VEHICLE.replace("  force:\n", f"  force:\n    {options}\n", 1), encoding="utf-8")
    assert main(["ft", "tare", "--sensor", "--yes", "--vehicle", str(path)]) == EXIT_BAD_INPUT
    assert (
        "--sensor: only the rft60 has a zero of its own to set; devices.force.type is steady" in capsys.readouterr().err
    )


def test_the_simulated_world_has_the_built_in_devices_and_says_so() -> None:
    settings = [
        "vehicle.devices.mocap.type=vicon",
        "vehicle.devices.force.type=ati",
        "vehicle.devices.force.rate_hz=500",
    ]
    vehicle = load_flight("hover", overrides=settings).vehicle
    messages: list[WorldMessage] = []
    server = Sitl([MachineWires(vehicle, World(), start_of((0.0, 0.0), 0.0, (0.0, 0.0)), Ports(), messages.append)])

    async def served() -> dict[str, dict[str, Any]]:
        async with server.wires() as (devices,):
            return devices

    devices = asyncio.run(served())
    assert devices["force"].items() >= {"type": "rft60", "options": {}, "rate_hz": 200}.items()
    assert devices["mocap"]["type"] == "natnet"
    assert messages == [
        WorldProgress("devices.mocap.type: the simulated world has a natnet, which is used in place of vicon"),
        WorldProgress("devices.force.type: the simulated world has a rft60, which is used in place of ati"),
    ]


def test_a_log_names_the_plug_ins_that_flew() -> None:
    flight = load_flight("hover", overrides=["vehicle.devices.force.type=ati"])
    assert plugins_of_others(flight) == {"device_plugins": "force sensor 'ati' (companion-ati 0.1.0)"}
    assert plugins_of_others(load_flight("hover")) == {}
