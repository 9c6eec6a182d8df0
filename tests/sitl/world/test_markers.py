"""The single markers of motion capture: the balls as cameras see them, and what only looks like a ball."""

from __future__ import annotations

import itertools
import math

import pytest

from companion.config.vehicle import Vehicle
from companion.model.types import Vec3
from companion.sitl_config.effects.markers import Markers
from companion.sitl_config.faults import Fault
from companion.sitl_config.loader import load_sitl
from companion.sitl_config.world import World
from sitl.world.ball_markers import BallMarkers
from sitl.world.scene import Scene
from sitl.world.start import MachineSpec, start_of
from tests.support import SHORT_CATCH

VEHICLE: Vehicle = load_sitl(SHORT_CATCH).vehicle
FLOOR: Vec3 = (2.0, -2.0, 0.03)
QUIET = {"noise_m": 0.0, "lost_share": 0.0, "stray_per_s": 0.0}
PERIOD_S = 0.005
AWAY: Vec3 = (1.2, 0.4, 1.1)


def cameras(balls: tuple[Vec3, ...] = (AWAY,), seed: int = 1, noise_m: float = 0.0, **markers: object) -> BallMarkers:
    """Cameras that look at the vehicle on its feet at the origin, and at balls in the air."""
    faults = (Fault(kind="payload_double", size=0.2, t_s=0.0),) if len(balls) > 1 else ()
    effect = Markers.model_validate(QUIET | {"on": True} | markers)
    world = World(seed=seed, mocap_noise_m=noise_m, markers=effect, faults=faults)
    scene = Scene([MachineSpec(VEHICLE, world, start_of((0.0, 0.0), 0.0, (0.0, 0.0)))])
    for name, at in zip(("payload", "payload2"), balls, strict=False):
        scene.data.joint(name).qpos[:3] = at
    return BallMarkers(world, scene)


def frames(seen: BallMarkers, count: int = 400, *, body: bool = False) -> list[tuple[Vec3, ...]]:
    return [seen.frame(number * PERIOD_S, 0.0, ball_is_body=body) for number in range(count)]


def test_a_ball_in_the_air_is_seen_where_it_was_at_the_exposure() -> None:
    seen = cameras()
    seen._at[0][1][:] = (-2.0, 0.0, 1.0)
    (found,) = seen.frame(0.0, 0.001, ball_is_body=False)
    assert found == pytest.approx((1.202, 0.4, 1.099))


@pytest.mark.parametrize("part", ["net", "base"])
def test_net_and_airframe_hide_the_ball(part: str) -> None:
    seen = cameras()
    at = {"net": seen._net, "base": seen._base}[part]
    seen._at[0][0][:] = (at[0], at[1], at[2] + 0.1)
    assert frames(seen, 1) == [()]
    seen._at[0][0][:] = (at[0], at[1], at[2] + 0.6)
    assert len(frames(seen, 1)[0]) == 1


def test_a_ball_drops_out_for_several_frames_and_comes_back() -> None:
    runs = [
        (found, len(list(group)))
        for found, group in itertools.groupby(map(bool, frames(cameras(lost_share=0.1), 20000)))
    ]
    lost = [length for found, length in runs if not found]
    assert sum(lost) == pytest.approx(2000, rel=0.25)
    assert max(lost) >= 3


def test_reflections_come_and_go_and_do_not_move() -> None:
    seen = [point for frame in frames(cameras((), stray_per_s=5.0, stray_s=0.04), 4000) for point in frame]
    places = set(seen)
    assert len(places) == pytest.approx(100, rel=0.3)
    assert len(seen) / len(places) == pytest.approx(8, rel=0.3)
    assert max(abs(x) for x, _, _ in places) <= 1.5


def test_a_ball_with_a_body_of_its_own_is_never_mistaken_for_a_reflection() -> None:
    assert set(frames(cameras((AWAY, (0.9, 0.0, 1.5)), fixed_m=(FLOOR,), stray_per_s=50.0), body=True)) == {(AWAY,)}


def test_a_swung_wand_moves_without_falling() -> None:
    turn = [frame[0] for frame in frames(cameras((), wand_at_m=(1.0, 0.0, 1.0)), 200)]
    assert all(math.dist(point, (1.0, 0.0, 1.0)) == pytest.approx(0.4) for point in turn)
    assert max(z for _, _, z in turn) == pytest.approx(1.4, abs=0.01)
