"""A motion-capture system of another package: its settings, its poses in the flight process and in the guardian, and its failures."""

from __future__ import annotations

import asyncio
import math
import re
import socket
import struct
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest
from pydantic import JsonValue

from companion.config.device_plugins import device_class
from companion.config.devices import MocapDevice
from companion.config.document import ConfigError
from companion.config.loader import load_vehicle
from companion.config.safety import Safety
from companion.guardian import process
from companion.guardian.mocap import GuardianMocap
from companion.io.mocap.contained import ContainedClient
from companion.io.mocap.driver import MocapDriver, settings_of
from companion.io.mocap.optitrack import OptiTrack
from companion.io.protocols import DeviceError
from companion.model.frames import quat_rotate
from companion.model.types import MocapPose
from companion.plugins import MOCAP_SYSTEMS
from companion.runtime import event_loop
from companion.runtime.clock import flight_clock, monotonic
from companion.safety.mocap import limits_of
from companion.testing import check_mocap
from tests.guardian.rig import Cameras
from tests.plugins.installed import on_path, write_distribution
from tests.plugins.mocap_systems import FAILING
from tests.support import DEADLINE_S, ROOT, free_udp_port

EXAMPLE = ROOT / "examples/mocap_vicon"
VEHICLE = (ROOT / "configs/vehicles/tarot650_2r.yaml").read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def installed(tmp_path: Path) -> Iterator[None]:
    """Install the example, and a package whose systems fail."""
    (tmp_path / "companion_vicon.py").write_text((EXAMPLE / "companion_vicon.py").read_text())
    (tmp_path / "lab_mocap.py").write_text(FAILING)
    announced = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"][MOCAP_SYSTEMS]
    write_distribution(tmp_path, "companion-vicon", "0.1.0", announced, MOCAP_SYSTEMS)
    failing = {name.lower(): f"lab_mocap:{name}" for name in re.findall(r"^class (?!Options)(\w+)", FAILING, re.M)}
    write_distribution(tmp_path, "lab-mocap", "1.0", failing, MOCAP_SYSTEMS)
    with on_path(tmp_path):
        yield


def vicon(port: int, server: str = "127.0.0.1") -> MocapDevice:
    options: dict[str, JsonValue] = {"object_name": "quad", "port": port}
    return MocapDevice(type="vicon", server=server, interface="127.0.0.1", rigid_body_id=1, options=options)


def datagram(number: int, *objects: tuple[str, tuple[float, ...]]) -> bytes:
    items = b"".join(struct.pack("<BH24s6d", 0, 72, name.encode(), *values) for name, values in objects)
    return struct.pack("<IB", number, len(objects)) + items + bytes(100)


STRANGER = ("wand", (1.0, 2.0, 3.0, 0.0, 0.0, 0.0))
QUAD = ("quad", (-1250.0, 500.0, 1000.0, 0.1, 0.2, 0.3))


@contextmanager
def broadcasting(port: int, *objects: tuple[str, tuple[float, ...]]) -> Iterator[None]:
    """Broadcast frames as Tracker does, 200 per second, on the loopback interface."""
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            sender.bind(("127.0.0.1", 0))
            for number in count(1):
                sender.sendto(datagram(number, *objects), ("127.255.255.255", port))
                if stop.wait(0.005):
                    return

    tracker = threading.Thread(target=send)
    tracker.start()
    try:
        yield
    finally:
        stop.set()
        tracker.join()


def check_pose(pose: MocapPose) -> None:
    """Check a pose against `QUAD`: the rotation matrix of Euler XYZ is Rx Ry Rz."""
    assert pose.position_world_m == pytest.approx((-1.25, 0.5, 1.0))
    cy, sy, cz = math.cos(0.2), math.sin(0.2), math.cos(0.3)
    cx, sx, sz = math.cos(0.1), math.sin(0.1), math.sin(0.3)
    assert quat_rotate(pose.attitude_wxyz, (0.0, 0.0, 1.0)) == pytest.approx((sy, -sx * cy, cx * cy))
    x_axis = (cy * cz, cx * sz + sx * sy * cz, sx * sz - cx * sy * cz)
    assert quat_rotate(pose.attitude_wxyz, (1.0, 0.0, 0.0)) == pytest.approx(x_axis)
    assert pose.tracking_valid


@pytest.mark.parametrize("server", ["127.0.0.1", "localhost"])
async def test_flight_and_guardian_receive_the_same_poses(server: str) -> None:
    port, clock = free_udp_port(), flight_clock()
    device = vicon(port, server)
    poses: list[MocapPose] = []
    client = GuardianMocap(settings_of(device), lambda: 100.0)
    with broadcasting(port, STRANGER, QUAD):
        async with MocapDriver(device, clock, poses.append) as driver:
            pose = driver.latest()
            assert pose is not None and pose is poses[-1] and 0.0 <= clock() - pose.stamp_s < 1.0
            check_pose(pose)
            assert driver.server is not None and driver.server.name == "Vicon Tracker, UDP object stream"
            assert driver.counts().malformed == 0
            client.keep_connected()
            seen = client.poses(origin_s=60.0)
            assert seen and client.tracked_s == 100.0 and 39.0 < seen[-1].stamp_s <= 40.0
            check_pose(seen[-1])
    client.close()


def test_the_example_and_a_system_that_answers_every_call_keep_the_contract() -> None:
    port = free_udp_port()
    with broadcasting(port, STRANGER, QUAD):
        check_mocap(vicon(port), duration_s=0.3)
    check_mocap(scripted(), duration_s=0.1)


def test_natnet_keeps_the_contract() -> None:
    with Cameras(1) as cameras:
        here = {"server": "127.0.0.1", "interface": "127.0.0.1", "transport": "unicast", "command_port": cameras.port}
        check_mocap(MocapDevice.model_validate(here | {"rigid_body_id": 1}), duration_s=0.3)


def test_a_wait_for_a_core_before_the_read_makes_no_frame_older() -> None:
    """Frames that arrived during the wait looked older than the read before it, and the server's clock was believed behind."""

    class Interrupted(OptiTrack):
        read_s = 0.0

        def poses(self, now_s: float) -> list[MocapPose]:
            time.sleep(0.03)
            self.read_s = monotonic()
            return super().poses(now_s)

    stamps: list[bool] = []
    with Cameras(1) as cameras:
        here = {"server": "127.0.0.1", "interface": "127.0.0.1", "transport": "unicast", "command_port": cameras.port}
        settings = settings_of(MocapDevice.model_validate(here | {"rigid_body_id": 1}))
        camera = Interrupted(settings)
        client = ContainedClient(camera, settings, monotonic)
        while len(stamps) < 20:
            client.keep_connected()
            before_s = camera.read_s
            stamps += [pose.stamp_s >= before_s for pose in client.poses()]
        client.close()
    assert sum(stamps) > len(stamps) / 2


def test_frame_numbers_that_do_not_increase_break_the_contract() -> None:
    stuck = MocapDevice(type="stuck", server="server", rigid_body_id=1)
    with pytest.raises(AssertionError, match="frame 7 follows frame 7 in the client of the flight"):
        check_mocap(stuck, duration_s=0.1)


def test_options_that_the_system_refuses_break_the_contract() -> None:
    with pytest.raises(AssertionError, match="object_name"):
        check_mocap(MocapDevice(type="vicon", server="server", rigid_body_id=1))


async def test_an_object_that_is_not_tracked_is_reported() -> None:
    port = free_udp_port()
    device = vicon(port)
    driver = MocapDriver(device, flight_clock(), lambda _: None, body_timeout_s=0.3)
    with (
        broadcasting(port, ("quad", (0.0,) * 6)),
        pytest.raises(DeviceError, match="rigid body 1 was not tracked within"),
    ):
        await driver.__aenter__()


def test_damaged_datagrams_are_rejected() -> None:
    port = free_udp_port()
    client = GuardianMocap(settings_of(vicon(port)))
    whole = datagram(7, STRANGER, QUAD)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for size in range(5 + 2 * 75):
            sender.sendto(whole[:size], ("127.0.0.1", port))
    assert client.poses() == []
    assert client.problem is not None and "unpack" in client.problem
    client.close()


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("at", [0, 4])
def test_a_vicon_object_that_is_not_finite_does_not_stop_the_others(value: float, at: int) -> None:
    port = free_udp_port()
    tracker = device_class(MOCAP_SYSTEMS, "vicon")(settings_of(vicon(port)))
    broken = list(QUAD[1])
    broken[at] = value
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for number, values in enumerate((tuple(broken), QUAD[1])):
            sender.sendto(datagram(number, ("quad", values)), ("127.0.0.1", port))
    (pose,) = tracker.poses(0.0)
    check_pose(pose)
    assert pose.frame_number == 1 and "are not finite" in tracker.problem
    tracker.close()


def scripted(**options: JsonValue) -> MocapDevice:
    return MocapDevice(type="scripted", server="server", rigid_body_id=1, options=options)


def seen_by_a_plug_in(**options: JsonValue) -> ContainedClient:
    """The client of a plug-in that sees markers, after two frames."""
    ball = {"kind": "marker"}
    device = MocapDevice(type="withmarkers", server="server", rigid_body_id=1, ball=ball, options=options)  # type: ignore[arg-type]
    settings = settings_of(device)
    client = ContainedClient(device_class(MOCAP_SYSTEMS, "withmarkers")(settings), settings, monotonic)
    for _ in range(2):
        assert len(client.poses()) == 1
        client.markers()
    return client


def test_a_plug_in_hands_on_markers() -> None:
    client = seen_by_a_plug_in(at=["1", "2", "0.5"])
    frame = client.markers()
    assert frame is not None and [marker.position_world_m for marker in frame.markers] == [(1.0, 2.0, 0.5)]
    assert (client.malformed, client.problem) == (0, None)


BAD_MARKERS: list[tuple[dict[str, JsonValue], str]] = [
    ({"at": ["nan", "0", "1"]}, "without a finite position"),
    ({"at": ["0", "1001", "1"]}, "without a finite position within 1000 m"),
    ({"at": ["0", "0", "1"], "count": 33}, "33 markers, expected at most 32"),
    ({"at": ["0", "0", "1"], "late_s": -1.5}, "markers stamped"),
    ({"at": ["0", "0", "1"], "late_s": 0.5}, "markers stamped"),
    ({"at": ["0", "1"]}, "ValidationError"),
    ({"at": ["0", "0", "1"], "count": 0}, "ValidationError"),
]


@pytest.mark.parametrize(("options", "why"), BAD_MARKERS)
def test_bad_markers_of_a_plug_in_are_counted_and_go_no_further(options: dict[str, JsonValue], why: str) -> None:
    client = seen_by_a_plug_in(**options)
    assert client.markers() is None
    assert client.malformed == 3 and client.problem is not None and why in client.problem


def test_a_system_without_markers_is_refused_for_a_vehicle_that_follows_a_ball(tmp_path: Path) -> None:
    vehicle, ball = tmp_path / "vehicle.yaml", "    ball: {kind: marker}"
    vehicle.write_text(
        VEHICLE.replace("  mocap:\n", f"  mocap:\n    type: vicon\n    options: {{object_name: quad}}\n{ball}\n", 1)
    )
    with pytest.raises(ConfigError) as caught:
        load_vehicle(vehicle)
    (line,) = caught.value.lines
    assert re.search(
        r"vehicle\.yaml:\d+:\d+: devices\.mocap\.ball: the motion-capture system vicon hands on no markers", line
    )


INVALID: list[tuple[dict[str, JsonValue], str]] = [
    ({"x_m": "nan"}, r"frame \d+: position \(nan, 0\.0, 1\.0\) m"),
    ({"x_m": "-inf"}, r"frame \d+: position \(-inf, "),
    ({"x_m": 1001.0}, "expected finite values, at most 1000 m"),
    ({"x_m": [1.0]}, "ValidationError: Expected `float`, got `array`"),
    ({"w": "nan"}, "quaternion of norm nan"),
    ({"w": 0.97}, "quaternion of norm 0.97, expected .* norm 1"),
    ({"stamped_after_now_s": "inf"}, "stamped inf s"),
    ({"stamped_after_now_s": "nan"}, "stamped nan s"),
    ({"stamped_after_now_s": 0.01}, "expected at most 1 s before now_s"),
    ({"stamped_after_now_s": -1.01}, "expected at most 1 s before now_s"),
]


@pytest.mark.parametrize(("options", "expected"), INVALID[:1])
async def test_the_flight_rejects_invalid_poses(options: dict[str, JsonValue], expected: str) -> None:
    delivered: list[MocapPose] = []
    driver = MocapDriver(scripted(**options), flight_clock(), delivered.append, body_timeout_s=0.01)
    with pytest.raises(DeviceError, match=f"rigid body 1 was never seen .* the newest problem: .*{expected}"):
        await driver.__aenter__()
    assert not delivered and driver.counts().malformed >= 1


@pytest.mark.parametrize(("options", "expected"), INVALID)
def test_the_guardian_rejects_invalid_poses(options: dict[str, JsonValue], expected: str) -> None:
    client = GuardianMocap(settings_of(scripted(**options)), lambda: 100.0)
    assert client.poses(origin_s=60.0) == [] and client.tracked_s < 0.0
    assert client.problem is not None and re.search(expected, client.problem)


def test_a_pose_that_is_not_tracked_may_have_any_values() -> None:
    device = scripted(tracking_valid=False, x_m="nan", w=0.0)
    (pose,) = GuardianMocap(settings_of(device)).poses()
    assert pose.position_world_m == (0.0, 0.0, 0.0) and pose.attitude_wxyz == (1.0, 0.0, 0.0, 0.0)
    assert not pose.tracking_valid
    (pose,) = GuardianMocap(settings_of(scripted(w=0.99))).poses()
    assert pose.attitude_wxyz == (1.0, 0.0, 0.0, 0.0) and pose.tracking_valid


def test_the_flight_receives_poses_while_a_client_replaces_its_socket() -> None:
    async def run() -> None:
        poses: asyncio.Queue[MocapPose] = asyncio.Queue()
        device = MocapDevice(type="reconnecting", server="server", rigid_body_id=1)
        async with MocapDriver(device, flight_clock(), poses.put_nowait) as driver, asyncio.timeout(DEADLINE_S):
            for _ in range(20):
                await poses.get()
            assert driver.counts().problem is not None and driver.counts().malformed

    event_loop.run(run())


def test_the_guardian_lands_while_a_client_replaces_its_socket(monkeypatch: pytest.MonkeyPatch) -> None:
    class Landing:
        """Has landed once it has taken 3 poses."""

        landed: bool | None = None
        pose = None
        overturned = False

        def __init__(self, *_: object, **__: object) -> None:
            self.poses = 0

        def take_poses(self, poses: list[MocapPose]) -> None:
            self.poses += len(poses)
            self.landed = True if self.poses >= 3 else None

        def take_messages(self, *_: object) -> None:
            pass

        def step(self, t_s: float) -> None:
            pass

    monkeypatch.setattr(process, "TakeoverLanding", Landing)
    link = Mock(poses_sent=0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire, socket.socket() as channel:
        link.wire.fileno, link.wire.lost = wire.fileno, False
        settings = Mock(autopilot_address="udpin://127.0.0.1:1", pose_limits=limits_of(Safety()))
        guardian = process.Guardian(settings, Mock(), channel, Mock())
        client = GuardianMocap(settings_of(MocapDevice(type="reconnecting", server="server", rigid_body_id=1)))
        client.close()
        guardian._mocap = client
        assert guardian._land(Mock(origin_s=0.0, position_world_m=(0.0, 0.0, 0.0)), link)
        client.close()


def test_a_client_without_a_name_refuses_the_flight_and_is_closed() -> None:
    driver = MocapDriver(MocapDevice(type="nameless", server="server", rigid_body_id=1), flight_clock(), lambda _: None)
    with pytest.raises(DeviceError, match="mocap nameless server: the client cannot be made: ValueError: no name"):
        asyncio.run(driver.__aenter__())
    assert device_class(MOCAP_SYSTEMS, "nameless").closed == 1


def test_a_problem_that_raises_is_reported_by_the_guardian() -> None:
    client = GuardianMocap(settings_of(MocapDevice(type="noproblem", server="server", rigid_body_id=1)))
    assert client.poses() == [] and client.problem == "ValueError: not connected"


async def test_a_call_that_waits_is_reported() -> None:
    times_s = count(step=0.02)
    driver = MocapDriver(scripted(), lambda: next(times_s), lambda _: None)
    async with driver:
        assert driver.counts().problem == "keep_connected() took 20 ms, limit 10 ms; no call of a client may wait"


@pytest.mark.parametrize(
    ("system", "expected"),
    [
        ("failing", "RuntimeError: no pose"),
        ("nonsense", r"TypeError: poses\(\) returned \['a pose'\], expected a list of MocapPose"),
    ],
)
async def test_exceptions_of_a_client_are_contained(system: str, expected: str) -> None:
    device = MocapDevice(type=system, server="server", rigid_body_id=1)
    client = GuardianMocap(settings_of(device))
    client.keep_connected()
    assert client.poses() == [] and client.tracked_s < 0.0
    client.close()
    assert client.problem is not None and re.match(expected, client.problem)
    driver = MocapDriver(device, flight_clock(), lambda _: None, body_timeout_s=0.1)
    with pytest.raises(DeviceError, match=f"rigid body 1 was never seen .* the newest problem: {expected}"):
        await driver.__aenter__()
    assert driver.counts().malformed >= 2


def test_a_client_that_cannot_be_made_refuses_the_flight() -> None:
    device = MocapDevice(type="absent", server="server", rigid_body_id=1)
    with pytest.raises(DeviceError, match="mocap absent server: the client cannot be made: OSError: no licence"):
        GuardianMocap(settings_of(device))
    with pytest.raises(DeviceError, match="mocap absent server: the client cannot be made: OSError: no licence"):
        asyncio.run(MocapDriver(device, flight_clock(), lambda _: None).__aenter__())


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ("type: vicon\n    options: {object_name: 3}", "options.object_name: Input should be a valid string"),
        ("type: vicon\n    options: {object_nam: quad}", "options.object_nam: Extra inputs are not permitted"),
        ("type: qualisys", "type: motion-capture system 'qualisys': is not installed; installed: natnet, absent, failing"),
        ("type: nooptions", "(lab-mocap 1.0): its attribute 'options' is not a subclass"),
        ("options: {a: 1}", "options.a: Extra inputs are not permitted"),
        ("type: external\n    options: {a: 1}", "options: Extra inputs are not permitted"),
        ("type: rft60", "type: motion-capture system 'rft60': is not installed; installed: natnet, absent"),
    ],
)  # fmt: skip
def test_settings_are_checked_with_the_vehicle_file(tmp_path: Path, lines: str, expected: str) -> None:
    path = tmp_path / "vehicle.yaml"
    path.write_text(VEHICLE.replace("  mocap:\n", f"  mocap:\n    {lines}\n", 1), encoding="utf-8")
    with pytest.raises(Exception, match=r"vehicle\.yaml:\d+:\d+: devices\.mocap") as refused:
        load_vehicle(path)
    assert expected in str(refused.value)
