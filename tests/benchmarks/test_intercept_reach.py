"""The bounds of `benchmarks.intercept_reach`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from benchmarks.intercept_reach import ARM, BEST, BOX, LATE, LEVELS, PLANNER, TIMES_S, bounds_of, judged, main
from companion.config.controller import law_class
from companion.control.arm_model import manipulator_of
from companion.mission.plan import Plan
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import Reference, Vec3
from companion.phases.intercept.net import net_m
from companion.phases.line import Line
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight

WAITING_POINT = "to the waiting point"
RESTS_S = 1.5
"""Time at the waiting point after which the vehicle tilts."""
FLIES_S = 0.5
"""Time for which the balls of these tests fly."""


@pytest.fixture(scope="module")
def config() -> SitlConfig:
    return load_sitl("intercept", overrides=["world.payload_kg=0"], world="ideal")


@pytest.fixture(scope="module")
def home(config: SitlConfig) -> Reference:
    (at_m,) = [phase.to_m for phase in config.mission.phases if isinstance(phase, Line) and phase.name == WAITING_POINT]
    plan = Plan.build(config.mission, config.vehicle)
    course = [plan.reference(0.1 * n) for n in range(int(10.0 * plan.duration_s))]
    (found, *_) = [r for r in course if math.dist(r.position_world_m, at_m) < 1e-3 and not any(r.velocity_world_m_s)]
    return found


class FullTilt:
    """The configured law until the vehicle waits; then full tilt to the left, and after `switch_s` to the right, at one height."""

    def __init__(self, home_m: Vec3, switch_s: float, *args: Any) -> None:
        self.home_m, self.switch_s, (settings, self.vehicle, _) = home_m, switch_s, args
        self.law = law_class(settings.law)(*args)
        self.hover_thrust, self.rests_s, self.collective_n = args[2], 0.0, 0.0

    def step(self, dt_s: float, state: Any, reference: Reference, vertical_scale: float) -> Any:
        self.law.hover_thrust = self.hover_thrust
        wrench = self.law.step(dt_s, state, reference, vertical_scale)
        if math.dist(reference.position_world_m, self.home_m) < 1e-3 and not any(reference.velocity_world_m_s):
            self.rests_s += dt_s
        if self.rests_s <= RESTS_S:
            self.collective_n = wrench.collective_n
            return wrench
        left = self.rests_s - RESTS_S <= self.switch_s
        tilt_rad = math.radians(self.vehicle.airframe.tilt_max_deg) * (-1.0 if left else 1.0)
        upright = quat_rotate(state.attitude_wxyz, (0.0, 0.0, 1.0))[2]
        tilted = quat_from_euler_zyx(tilt_rad, 0.0, 0.0)
        return replace(wrench, attitude_wxyz=tilted, collective_n=self.collective_n / upright)


def test_a_vehicle_that_tilts_fully_both_ways_gets_no_farther_than_the_bounds(
    config: SitlConfig, home: Reference
) -> None:
    laws, places = [], []

    def make_law(*args: Any) -> Any:
        laws.append(FullTilt(home.position_world_m, 0.25, *args))
        return laws[-1]

    flight = FastFlight(config, make_law=make_law)
    scene = flight.plant.scene
    net = scene.data.xpos[scene.model.body("net").id]

    def watch(_: Any) -> bool:
        if laws[-1].rests_s >= RESTS_S:
            places.append(net.tolist())
        return len(places) > 120

    flight.run(until=watch)
    moved = np.array(places[2::2])[: len(TIMES_S)] - places[0]
    asked = np.concatenate([moved, np.zeros((len(TIMES_S) - len(moved), 3))])
    best, late, _, _ = bounds_of(config, {"home": home})
    for reachable in (best, late):
        assert reachable.distance_m(asked)[: len(moved)].max() < 0.015
    at = round(FLIES_S / 0.01) - 1
    assert moved[at, 1] > 0.3
    assert late.distance_m(2.0 * asked)[at] > 0.02
    assert best.sideways_m()[at] > late.sideways_m()[at]


def throw_past(config: SitlConfig, home: Reference, beside_m: Vec3, flies_s: float = FLIES_S) -> dict[str, Any]:
    """Return a throw from ahead whose ball passes the waiting net at `beside_m` from it, `flies_s` after it is seen."""
    x, y, z = (p + n for p, n in zip(home.position_world_m, net_m(manipulator_of(config.vehicle), home), strict=True))
    vx, vz = -4.0, 0.5 * GRAVITY_M_S2 * flies_s - 1.0
    ball_m = (
        x + beside_m[0] - vx * flies_s,
        y + beside_m[1],
        z + beside_m[2] - vz * flies_s + 0.5 * GRAVITY_M_S2 * flies_s**2,
    )
    return {
        "t_s": 10.0, "seen_s": 10.0, "ball_m": ball_m, "ball_m_s": (vx, 0.0, vz), "net_m": (x, y, z), "home": home, "drag_per_m": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("beside_m", "flies_s", "levels"),
    [
        ((0.0, 0.0, 0.0), FLIES_S, LEVELS),
        ((0.0, 0.3, 0.0), FLIES_S, LEVELS),
        ((0.0, 0.5, 0.0), 0.45, (BEST, ARM, LATE, BOX, PLANNER)),
        ((0.0, 0.7, 0.0), 0.45, (BEST, ARM)),
        ((0.0, 1.15, 0.0), 0.8, (BEST, ARM, LATE)),
        ((0.0, 1.0, 0.0), 0.3, ()),
        ((0.0, 3.0, 0.0), 1.0, ()),
    ],
)
def test_a_ball_is_within_the_bounds_by_its_distance_and_its_time(
    config: SitlConfig, home: Reference, beside_m: Vec3, flies_s: float, levels: tuple[str, ...]
) -> None:
    row = judged(config, throw_past(config, home, beside_m, flies_s))
    assert [level for level in LEVELS if row[level]] == list(levels), row["least_m"]
    assert row["left_s"] == pytest.approx(flies_s, abs=0.2)


@pytest.mark.usefixtures("undrawn")
def test_the_command_writes_each_throw_with_its_flight_and_both_pictures(tmp_path: Path) -> None:
    assert main(["--draws", "1", "--scatter", "1", "--out", str(tmp_path)]) == 0
    ((row,),) = json.loads((tmp_path / "intercept_reach.json").read_text()).values()
    assert row["caught"] and row["miss_m"] < 0.09 and all(row[level] for level in LEVELS)
    assert 0.2 < row["left_s"] < 1.2 and any("ball_seen" in event for event in row["events"])
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".svg", ".png"}
