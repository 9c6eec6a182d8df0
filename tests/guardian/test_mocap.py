"""The guardian's client of a plug-in: what the plug-in returns or raises, the landing goes on."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from companion import plugins
from companion.guardian.mocap import GuardianMocap
from companion.io.mocap.system import MocapSettings
from companion.model.types import MocapPose
from tests.safety.healthy import healthy

SETTINGS = MocapSettings(
    server="10.0.0.1",
    interface="",
    transport="unicast",
    multicast_group="",
    command_port=0,
    data_port=0,
    rigid_body_id=1,
    up_axis="z",
    type="theirs",
)


class Theirs:
    """A plug-in's client that returns what the test puts there."""

    def __init__(self, _: MocapSettings) -> None:
        self.found: list[MocapPose] = []
        self.problem = ""
        self.server_name = "theirs"
        self.broken = False
        self.calls: list[str] = []

    def poses(self, _: float) -> list[MocapPose]:
        if self.broken:
            raise OSError("gone")
        return self.found

    def keep_connected(self, _: float) -> None:
        self.calls.append("keep_connected")

    def close(self) -> None:
        self.calls.append("close")


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> tuple[GuardianMocap, Theirs]:
    theirs = Theirs(SETTINGS)
    monkeypatch.setattr(plugins, "find", lambda *_: SimpleNamespace(load=lambda: lambda settings: theirs))
    return GuardianMocap(SETTINGS, lambda: 100.0), theirs


def seen(stamp_s: float, *, tracked: bool = True, x_m: float = 0.0) -> MocapPose:
    pose = healthy().mocap
    assert pose is not None
    return replace(pose, stamp_s=stamp_s, tracking_valid=tracked, position_world_m=(x_m, 0.0, 1.0))


def test_valid_poses_come_on_the_flight_clock_and_only_a_tracked_body_counts(
    pair: tuple[GuardianMocap, Theirs],
) -> None:
    client, theirs = pair
    assert (client.where, client.problem, client.tracked_s) == ("mocap theirs 10.0.0.1", None, -math.inf)
    theirs.found = [seen(99.99, tracked=False)]
    assert [pose.stamp_s for pose in client.poses(90.0)] == [pytest.approx(9.99)]
    assert client.tracked_s == -math.inf
    theirs.found = [seen(99.98, tracked=False), seen(99.99)]
    assert [pose.stamp_s for pose in client.poses()] == [99.98, 99.99]
    assert client.tracked_s == 100.0
    client.keep_connected()
    client.close()
    assert theirs.calls == ["keep_connected", "close"]


def test_an_invalid_pose_is_left_out_and_named_and_an_exception_is_contained(
    pair: tuple[GuardianMocap, Theirs],
) -> None:
    client, theirs = pair
    theirs.problem = "no server"
    client.poses()
    assert client.problem == "no server"
    theirs.found = [seen(99.99, x_m=math.nan), seen(99.99)]
    assert len(client.poses()) == 1
    assert client.problem not in (None, "no server")
    theirs.broken = True
    client.poses()
    assert client.problem is not None and "gone" in client.problem
