"""Touchdown by two of three sources, each switched on and off; and thrust that is reduced while only one speaks."""

from __future__ import annotations

import math

import msgspec
import pytest

from companion.model.types import MocapPose, VehicleState
from companion.safety.touchdown import HeightEvidence, Sinking, Touchdown
from tests.safety.healthy import healthy

CLEARANCE_M, STEP_S, ABOVE_LOW_M = 0.3, 0.01, 0.13
replace = msgspec.structs.replace


def pose_at(t_s: float, height_m: float, *, tracked: bool = True) -> MocapPose:
    pose = healthy().mocap
    assert pose is not None
    return replace(pose, stamp_s=t_s, position_world_m=(0.0, 0.0, height_m), tracking_valid=tracked)


def vehicle_at(height_m: float, up_m_s: float = 0.0) -> VehicleState:
    vehicle = healthy().vehicle
    assert vehicle is not None
    return replace(vehicle, position_world_m=(0.0, 0.0, height_m), velocity_world_m_s=(0.0, 0.0, up_m_s))


def landed(
    *,
    px4_m: float = CLEARANCE_M + ABOVE_LOW_M,
    mocap_m: float | None = CLEARANCE_M,
    up_m_s: float = 0.0,
    sink_m_s: float = 0.0,
    below_m: float = 0.3,
    thrust_share: float = 1.0,
    px4_says: bool = False,
    seconds: float = 2.5,
) -> tuple[float | None, float]:
    """Time at which the touchdown is certain (None: never), and the thrust that is left; by default no source speaks."""
    evidence = Touchdown.begin(CLEARANCE_M)
    for k in range(round(seconds / STEP_S)):
        t_s = 20.0 + k * STEP_S
        pose = None if mocap_m is None else pose_at(t_s, mocap_m - sink_m_s * (t_s - 20.0))
        evidence = evidence.update(t_s, vehicle_at(px4_m, up_m_s), pose, px4_m - below_m, thrust_share, px4_says)
        if evidence.certain:
            return t_s - 20.0, evidence.relief
    return None, evidence.relief


LOW = {"px4_m": CLEARANCE_M + 0.11}
CARRIED = {"thrust_share": 0.7}
TOLD = {"px4_says": True}


@pytest.mark.parametrize(
    ("sources", "after_s"),
    [(LOW | CARRIED, 0.35), (LOW | TOLD, 0.35), (CARRIED | TOLD, 0.28), (LOW | CARRIED | TOLD, 0.28)],
)
def test_two_sources_that_agree_are_a_touchdown(sources: dict[str, float], after_s: float) -> None:
    assert landed(**sources)[0] == pytest.approx(after_s, abs=0.015)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "sources",
    [
        LOW,
        CARRIED,
        TOLD,
        LOW | CARRIED | {"mocap_m": None},
        CARRIED | TOLD | {"mocap_m": CLEARANCE_M + 0.52},
        CARRIED | TOLD | {"mocap_m": None},
        LOW | {"thrust_share": 0.8},
        LOW | CARRIED | {"up_m_s": 0.1, "sink_m_s": 0.1},
        LOW | CARRIED | {"below_m": 0.04, "sink_m_s": 0.1},
        CARRIED | TOLD | {"sink_m_s": 0.1},
    ],
    ids=[
        "PX4's height",
        "thrust",
        "PX4's detector",
        "thrust unseen",
        "high in motion capture",
        "unseen at all",
        "thrust that carries",
        "moving",
        "reference not below",
        "sinking",
    ],
)
def test_one_source_or_one_that_is_contradicted_is_no_touchdown(sources: dict[str, float]) -> None:
    assert landed(**sources)[0] is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sources", "relief"),
    [
        (LOW, 1.0 - 1.25),  # alone since 0.35 s: by its own word from then on for 0.4 s, then one second to zero
        (CARRIED, 1.0 - 1.32),
        (TOLD, 1.0),
        (LOW | {"sink_m_s": 0.16}, 1.0),
        (LOW | {"mocap_m": None}, 1.0),
        (LOW | {"mocap_m": CLEARANCE_M + 0.52}, 1.0),
    ],
)
def test_thrust_is_reduced_within_a_second_while_one_source_speaks_and_the_vehicle_does_not_sink(
    sources: dict[str, float], relief: float
) -> None:
    _, left = landed(**sources, seconds=2.0)  # type: ignore[arg-type]
    assert left == pytest.approx(max(0.0, relief), abs=0.03)
    halfway_s = 2.0 - 0.5 - max(0.0, -relief)
    if relief < 0.0:
        _, left = landed(**sources, seconds=halfway_s)  # type: ignore[arg-type]
        assert left == pytest.approx(0.5, abs=0.04)


def test_a_vehicle_that_sinks_again_gets_its_thrust_back_at_once() -> None:
    evidence = Touchdown.begin(CLEARANCE_M)
    for k in range(150):
        t_s = k * STEP_S
        sunk_m = 0.2 * max(0.0, t_s - 1.3)
        evidence = evidence.update(t_s, vehicle_at(0.4), pose_at(t_s, 0.4 - sunk_m), 0.0, 1.0, False)
        if t_s == pytest.approx(1.3):
            assert evidence.relief < 0.6
    assert evidence.relief == 1.0


def test_thrust_is_not_reduced_before_motion_capture_has_measured_the_descent() -> None:
    evidence = Touchdown.begin(CLEARANCE_M)
    for k in range(40):
        t_s = k * STEP_S
        pose = pose_at(t_s, CLEARANCE_M) if k == 39 else None
        evidence = evidence.update(t_s, vehicle_at(CLEARANCE_M), pose, 0.0, 1.0, False)
    assert evidence.height.stands(t_s) and evidence.alone_since_s is None


def test_the_descent_is_measured_over_the_last_0_15_s_of_poses() -> None:
    sinking = Sinking()
    for k in range(100):
        t_s = k * STEP_S
        sinking = sinking.update(t_s, pose_at(t_s, 2.0 - 0.4 * max(0.0, t_s - 0.5)))
        if t_s < 0.075 - 1e-9:
            assert sinking.speed_m_s is None, "too short to tell"
        elif t_s <= 0.5:
            assert sinking.speed_m_s == pytest.approx(0.0)
        elif t_s >= 0.66:
            assert sinking.speed_m_s == pytest.approx(0.4)
    assert len(sinking.seen) <= 18
    assert sinking.update(1.28, pose_at(0.99, 1.0)).seen, "fresh for 0.3 s"
    for gone in (None, pose_at(0.98, 1.0), pose_at(1.28, 1.0, tracked=False)):
        assert sinking.update(1.285, gone) == Sinking()


def test_the_descent_of_uneven_poses_is_measured_up_to_the_newest() -> None:
    sinking = Sinking()
    for t_s, height_m in ((0.0, 2.0), (0.105, 1.0), (0.25, 1.0), (0.26, 1.0)):
        sinking = sinking.update(t_s, pose_at(t_s, height_m))
    assert sinking.speed_m_s == 0.0


def test_height_counts_once_it_has_been_low_and_still_above_the_reference_for_0_35_s() -> None:
    for height_m, up_m_s, below_m, stands in (
        (0.41, 0.0, 0.06, True),
        (0.43, 0.0, 0.06, False),
        (0.41, 0.09, 0.06, False),
        (0.41, -0.09, 0.06, False),
        (0.41, 0.07, 0.06, True),
        (0.41, 0.0, 0.04, False),
    ):
        evidence = HeightEvidence(CLEARANCE_M + 0.12)
        first_s = math.inf
        for k in range(60):
            t_s = k * STEP_S
            evidence = evidence.update(t_s, height_m, up_m_s, height_m - below_m)
            if evidence.stands(t_s):
                first_s = min(first_s, t_s)
        assert first_s == (pytest.approx(0.35, abs=0.011) if stands else math.inf), (height_m, up_m_s, below_m)
