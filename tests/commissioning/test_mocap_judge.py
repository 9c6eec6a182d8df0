"""A watched stream of motion capture: its timing, which body it is, and what is proposed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest

from companion.commissioning.mocap import judge as mocap_judge
from companion.commissioning.mocap.judge import FrameSeen, Route, Timing, Watched
from companion.config.base import Location
from companion.config.document import Data
from companion.config.loader import load_vehicle
from companion.io.mocap.frames import RigidBody
from companion.io.mocap.natnet import ServerInfo
from companion.model.check_row import Level, Row
from companion.model.markers import Marker, MarkerFrame
from companion.model.types import IDENTITY_QUAT, Vec3
from tests.support import ROOT

VEHICLE = load_vehicle(ROOT / "configs/vehicles/tarot650_2r.yaml")
INFO = ServerInfo(
    application="Motive",
    application_version=(3, 0, 0, 0),
    natnet_version=(4, 1, 0, 0),
    clock_frequency_hz=10_000_000,
    data_port=1511,
    multicast=True,
    multicast_group="239.255.42.99",
)
BALL, FLOOR = (Marker(position_world_m=place) for place in ((1.0, 0.0, 1.0), (9.0, 0.0, 0.0)))
CABLE = Route("unicast", "10.0.0.2", "eth0", False)
NAMES = {1: "quad", 5: "wand"}

Judged = tuple[list[Row], dict[Location, Data]]
Place = Callable[[float], Vec3]


def still(t_s: float) -> Vec3:
    return (1e-5 * math.sin(700.0 * t_s), 0.0, 0.3)


def carried(t_s: float) -> Vec3:
    return (0.3 * math.sin(t_s), 0.0, 0.3)


def frames(
    rate_hz: float = 200.0,
    seconds: float = 4.0,
    places: dict[int, Place] | None = None,
    latency_s: float | None = 0.005,
    lost: Callable[[int], bool] = lambda _: False,
    late_s: Callable[[int], float] = lambda _: 0.0,
) -> list[FrameSeen]:
    found = []
    for number in range(int(rate_hz * seconds)):
        t_s = number / rate_hz
        if lost(number):
            continue
        bodies = tuple(
            RigidBody(id=id_, position_m=place(t_s), quat_wxyz=IDENTITY_QUAT, error_m=0.0003, tracking_valid=True)
            for id_, place in (places or {1: still}).items()
        )
        found.append(
            FrameSeen(
                arrived_s=10.0 + t_s + late_s(number),
                number=number + 1000,
                timestamp_s=50.0 + t_s,
                latency_s=latency_s,
                bodies=bodies,
            )
        )
    return found


def judged(seen: Sequence[FrameSeen], *, moving: bool = False, route: Route = CABLE, info: ServerInfo = INFO) -> Judged:
    return mocap_judge.judge(
        Watched(frames=seen, names=NAMES, info=info, route=route, duration_s=4.0, moving=moving), VEHICLE
    )


def bad(found: Judged) -> set[str]:
    return {row.id for row in found[0] if not row.ok}


def timing_of(seen: Sequence[FrameSeen]) -> Timing:
    t = mocap_judge.timing(seen)
    assert t is not None
    return t


def test_no_row_fails_for_a_sound_stream() -> None:
    found = judged(frames())
    assert bad(found) == set()
    assert found[1] == {}


def test_a_version_that_no_sdk_describes_is_reported() -> None:
    later = judged(frames(), info=replace(INFO, natnet_version=(4, 9, 0, 0)))
    assert bad(later) == {"mocap.server"} and "NatNet 4.4" in later[0][0].wanted
    assert later[0][0].level is Level.WARN


def test_two_bodies_with_one_streaming_id_are_reported() -> None:
    found = judged([replace(frame, bodies=frame.bodies * 2) for frame in frames()])
    (row,) = [row for row in found[0] if row.id == "mocap.own"]
    assert not row.ok and row.read == 'two rigid bodies with id 1 "quad"'


def test_lost_frames_are_counted_by_their_numbers() -> None:
    t = timing_of(frames(lost=lambda number: number % 10 == 3))
    assert t.lost == 80
    assert t.server_rate_hz == pytest.approx(200.0)
    assert t.rate_hz == pytest.approx(180.0, rel=0.01)


def test_jitter_is_reported_and_drawn() -> None:
    seen = frames(late_s=lambda number: 0.004 if number % 20 == 0 else 0.0)
    t = timing_of(seen)
    assert t.percentile_off_s(0.5) == pytest.approx(0.0, abs=2e-4)
    assert t.off_s[-1] == pytest.approx(0.004, abs=2e-4)
    lines = mocap_judge.histogram(t)
    assert sum(float(line.split("%")[0].split()[-1]) for line in lines) == pytest.approx(100.0, abs=0.5)
    assert lines[0].count("#") > 10 * lines[-1].count("#") > 0
    assert "mocap.steady" in bad(judged(seen))


def test_a_camera_at_half_the_rate_is_reported_from_frames_that_are_lost() -> None:
    slow, holes = judged(frames(rate_hz=100.0)), judged(frames(lost=lambda number: number % 2 == 1))
    assert slow[1] == {("devices", "mocap", "rate_hz"): 100.0}
    assert "mocap.rate" in bad(slow) and "mocap.lost" not in bad(slow)
    assert {"mocap.rate", "mocap.lost"} <= bad(holes)
    assert holes[1] == {}


def test_more_latency_than_px4_has_configured_is_reported() -> None:
    assert "mocap.delay" in bad(judged(frames(latency_s=0.035)))
    assert "mocap.delay" not in bad(judged(frames(latency_s=0.006)))
    assert "mocap.latency" in bad(judged(frames(latency_s=None)))


@pytest.mark.parametrize(
    ("places", "moving", "proposed", "fine"),
    [
        ({5: still}, False, 5, False),
        ({5: still, 6: still}, False, None, False),
        ({1: still, 5: carried}, True, 5, False),
        ({1: carried, 5: still}, True, None, True),
        ({1: carried, 5: carried}, True, None, False),
        ({1: still, 5: still}, True, None, False),
        ({1: still, 5: still}, False, None, True),
    ],
)
def test_the_body_that_moves_is_the_vehicle(
    places: dict[int, Place], moving: bool, proposed: int | None, fine: bool
) -> None:
    found = judged(frames(places=places), moving=moving)
    assert ("mocap.own" not in bad(found)) == fine
    assert found[1].get(("devices", "mocap", "rigid_body_id")) == proposed


def test_wifi_is_reported() -> None:
    assert "mocap.network" in bad(judged(frames(), route=Route("unicast", "10.0.0.2", "wlan0", True)))


def test_too_few_frames_are_not_judged() -> None:
    found = judged(frames(seconds=0.02))
    assert {row.id for row in found[0]} == {"mocap.server", "mocap.network", "mocap.own"}


def test_single_markers_are_counted_and_judged_for_a_vehicle_that_follows_a_ball() -> None:
    seen = [
        replace(
            frame,
            markers=MarkerFrame(
                stamp_s=frame.arrived_s,
                exposed_s=frame.arrived_s,
                frame_number=frame.number,
                markers=(FLOOR, BALL)[: 1 + frame.number % 2],
            ),
        )
        for frame in frames()
    ]
    watched = Watched(seen, NAMES, INFO, CABLE, 4.0, False)
    assert mocap_judge.as_json(watched)["single_markers"] == (1, 2)
    assert "single markers per frame: 1 to 2" in mocap_judge.text(watched)
    with_ball = load_vehicle(ROOT / "configs/vehicles/tarot650_2r.yaml", ["vehicle.devices.mocap.ball={kind: marker}"])
    for vehicle, expected in ((VEHICLE, []), (with_ball, ["1 to 2 single markers, 0 to 1 of them in the room"])):
        rows, _ = mocap_judge.judge(watched, vehicle)
        assert [row.read for row in rows if row.id == "mocap.ball"] == expected
