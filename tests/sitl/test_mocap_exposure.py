"""Cameras expose when they are due, also between two physics steps."""

from __future__ import annotations

import pytest

from companion.model.frames import quat_conjugate, quat_multiply
from companion.model.types import Quat, Vec3
from sitl.mocap import MocapFrame
from tests.preflight.hand_rig import world
from tests.sitl.plants import plant_of

CLIMBS_AND_TUMBLES = (1.0, 0.9, 1.0, 0.95)


def flight(between_steps: bool, rate_hz: float = 200.0) -> tuple[list[MocapFrame], dict[float, tuple[Vec3, Quat]]]:
    """Frames of the first 0.4 s of a flight without noise, and the truth after every step."""
    config = world("mocap_noise_m=0", "mocap_noise_deg=0", "handling=false", f"mocap_rate_hz={rate_hz:g}")
    plant = plant_of(config, CLIMBS_AND_TUMBLES, between_steps=between_steps)
    frames, truth = [], {}
    while plant.t_s < 0.4:
        plant.step(True)
        truth[round(plant.t_s, 6)] = (plant.truth.position_world_m, plant.truth.attitude_wxyz)
        frames += plant.mocap.take()
    return frames, truth


@pytest.mark.parametrize("rate_hz", [200.0, 120.0])
def test_exposures_are_as_even_as_the_cameras(rate_hz: float) -> None:
    frames, _ = flight(True, rate_hz)
    assert [frame.exposure_t_s for frame in frames[1:]] == pytest.approx(
        [n / rate_hz for n in range(1, len(frames))], abs=1e-9
    )
    coarse, _ = flight(False, rate_hz)
    steps = [frame.exposure_t_s / 0.002 for frame in coarse]
    assert steps == pytest.approx([round(step) for step in steps])


def test_a_frame_between_two_steps_shows_what_is_between_them() -> None:
    frames, truth = flight(True)
    moved = 0
    for frame in frames:
        before, after = (truth.get(round(frame.exposure_t_s + side_s, 6)) for side_s in (-0.001, 0.001))
        if before is None or after is None:
            continue
        middle = [(a + b) / 2.0 for a, b in zip(before[0], after[0], strict=True)]
        step_m = max(abs(a - b) for a, b in zip(before[0], after[0], strict=True))
        off_m = max(abs(a - b) for a, b in zip(frame.position_world_m, middle, strict=True))
        assert off_m < 0.05 * step_m + 3e-5
        half = quat_multiply(quat_conjugate(before[1]), frame.attitude_wxyz)
        other_half = quat_multiply(quat_conjugate(frame.attitude_wxyz), after[1])
        assert half[1:] == pytest.approx(other_half[1:], abs=3e-4)
        moved += step_m > 1e-3 and max(map(abs, half[1:])) > 5e-4
    assert moved > 10


def test_frames_are_handed_out_with_the_time_at_which_they_leave() -> None:
    config = world("mocap_latency_s=0.005", "handling=false")
    plant = plant_of(config, between_steps=True)
    leave_s = []
    while plant.t_s < 0.1:
        plant.step(False)
        for at_s, frame in plant.mocap.take_until(plant.t_s + 0.0019):
            assert at_s == pytest.approx(frame.exposure_t_s + 0.005)
            assert plant.t_s - 0.002 < at_s < plant.t_s + 0.002
            leave_s.append(at_s)
    assert leave_s[1:] == pytest.approx([0.005 + 0.005 * n for n in range(1, len(leave_s))])
