"""The example for Qualisys: the real client with Qualisys' own package, against a server that speaks QTM's protocol."""

from __future__ import annotations

import math
import random
import socket
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.config.device_plugins import device_class
from companion.config.devices import MocapDevice
from companion.io.mocap.system import MocapSettings
from companion.model.frames import quat_from_euler_zyx, rotation_matrix
from companion.model.types import MocapPose
from companion.plugins import MOCAP_SYSTEMS
from companion.testing import check_mocap
from tests.plugins.installed import on_path, write_distribution
from tests.plugins.qtm_server import Body, frame, streaming
from tests.support import DEADLINE_S, ROOT

pytest.importorskip("qtm_rt", reason="qtm-rt is not installed")
EXAMPLE = ROOT / "examples/mocap_qualisys"
ATTITUDE = quat_from_euler_zyx(0.1, 0.2, 0.3)


@pytest.fixture(autouse=True)
def installed(tmp_path: Path) -> Iterator[None]:
    (tmp_path / "companion_qualisys.py").write_text((EXAMPLE / "companion_qualisys.py").read_text())
    announced = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]["entry-points"][MOCAP_SYSTEMS]
    write_distribution(tmp_path, "companion-qualisys", "0.1.0", announced, MOCAP_SYSTEMS)
    with on_path(tmp_path):
        yield


def body(name: str, x_mm: float = -1250.0, attitude: tuple[float, float, float, float] = ATTITUDE) -> Body:
    rows = rotation_matrix(attitude)
    return name, (x_mm, 500.0, 1000.0, *(row[column] for column in range(3) for row in rows), 0.4)


WAND, QUAD = body("wand", 3000.0), body("quad")
LOST: Body = ("quad", (math.nan,) * 13)


def device(port: int, name: str = "quad", **changes: Any) -> MocapDevice:
    options = {"body_name": name, "port": port}
    fields = {
        "type": "qualisys",
        "server": "127.0.0.1",
        "interface": "127.0.0.1",
        "rigid_body_id": 1,
        "options": options,
    }
    return MocapDevice(**{**fields, **changes})


def settings(port: int, name: str = "quad") -> MocapSettings:
    given = device(port, name)
    return MocapSettings(**{key: getattr(given, key) for key in MocapSettings.__slots__})


def until(tracker: Any, holds: Callable[[list[MocapPose]], bool]) -> list[MocapPose]:
    """Call the client as the flight does until the condition holds; return the newest poses."""
    deadline_s = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline_s:
        now_s = time.monotonic()
        tracker.keep_connected(now_s)
        poses: list[MocapPose] = tracker.poses(now_s)
        if holds(poses):
            return poses
        time.sleep(0.001)
    raise AssertionError(f"not within {DEADLINE_S:g} s; problem: {tracker.problem}")


@pytest.mark.parametrize("server", ["127.0.0.1", "localhost"])
def test_it_keeps_the_contract(server: str) -> None:
    with streaming(WAND, QUAD) as qtm:
        check_mocap(device(qtm.port, server=server), duration_s=0.3)
    assert any(command.startswith("StreamFrames AllFrames UDP:") for command in qtm.commands)


def test_position_attitude_and_time_are_those_of_the_named_body() -> None:
    with streaming(WAND, QUAD) as qtm:
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(qtm.port))
        pose = until(tracker, bool)[-1]
        tracker.close()
    assert pose.tracking_valid
    assert pose.position_world_m == pytest.approx((-1.25, 0.5, 1.0))
    assert pose.attitude_wxyz == pytest.approx(ATTITUDE, abs=1e-6)
    assert pose.marker_error_m == pytest.approx(4e-4)
    assert pose.exposure_server_s == pytest.approx(0.005 * pose.frame_number)


@pytest.mark.parametrize("seed", range(20))
def test_any_attitude_is_decoded(seed: int) -> None:
    draw = random.Random(seed)
    attitude = quat_from_euler_zyx(draw.uniform(-3, 3), draw.uniform(-1.5, 1.5), draw.uniform(-3, 3))
    tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(1))
    tracker._bodies = ["quad"]
    pose = tracker._pose(frame(1, [body("quad", attitude=attitude)[1]]), 0.0)
    tracker.close()
    sign = math.copysign(1.0, sum(a * b for a, b in zip(pose.attitude_wxyz, attitude, strict=True)))
    assert tuple(sign * value for value in pose.attitude_wxyz) == pytest.approx(attitude, abs=1e-3)


def test_a_body_that_is_not_tracked_is_reported_and_comes_back() -> None:
    with streaming(WAND, LOST) as qtm:
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(qtm.port))
        assert not until(tracker, bool)[-1].tracking_valid
        qtm.bodies[1] = QUAD
        until(tracker, lambda poses: bool(poses) and poses[-1].tracking_valid)
        tracker.close()


def test_a_body_that_qtm_does_not_have_is_named_with_those_that_it_has() -> None:
    with streaming(WAND) as qtm:
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(qtm.port))
        until(tracker, lambda _: tracker.problem is not None)
        tracker.close()
    assert tracker.problem == "QTM has no 6DOF body 'quad'; it has: wand"


def test_a_body_that_is_added_in_front_is_not_taken_for_the_vehicle() -> None:
    with streaming(QUAD) as qtm:
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(qtm.port))
        until(tracker, bool)
        qtm.bodies.insert(0, WAND)
        until(tracker, lambda _: tracker.problem is not None)
        assert "2 bodies, but QTM has named 1" in tracker.problem
        poses = until(tracker, bool)  # the names are requested again
        assert all(pose.position_world_m[0] == pytest.approx(-1.25) for pose in poses)
        tracker.close()


def test_the_stream_is_requested_again_after_qtm_has_hung_up() -> None:
    with streaming(QUAD) as qtm:
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(qtm.port))
        until(tracker, bool)
        qtm.hang_up()
        until(tracker, lambda _: tracker.problem is not None)
        assert "has closed the connection" in tracker.problem
        until(tracker, bool)
        tracker.close()
    assert sum(command.startswith("StreamFrames") for command in qtm.commands) >= 2


def test_without_qtm_the_problem_says_so() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(unused.getsockname()[1]))
        until(tracker, lambda _: tracker.problem is not None)
        tracker.close()
    assert "no connection (is QTM running" in tracker.problem


def test_damaged_datagrams_are_rejected() -> None:
    tracker = device_class(MOCAP_SYSTEMS, "qualisys")(settings(1))
    tracker._bodies = ["wand", "quad"]
    whole = frame(7, [WAND[1], QUAD[1]])
    draw = random.Random(1)
    damaged = [whole[:size] for size in range(len(whole))]
    for _ in range(500):
        changed = bytearray(whole)
        changed[draw.randrange(40)] = draw.randrange(256)
        damaged.append(bytes(changed))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in damaged:
            sender.sendto(data, tracker._frames.getsockname())
            for pose in tracker.poses(0.0):
                assert pose.position_world_m == pytest.approx((-1.25, 0.5, 1.0)), "at most number and time are others"
    assert tracker.problem is not None and tracker.problem.startswith("datagram of ")
    tracker.close()


def test_y_up_is_refused() -> None:
    given = device(1, up_axis="y")
    with pytest.raises(ValueError, match="z axis must point up"):
        device_class(MOCAP_SYSTEMS, "qualisys")(
            MocapSettings(**{key: getattr(given, key) for key in MocapSettings.__slots__})
        )
