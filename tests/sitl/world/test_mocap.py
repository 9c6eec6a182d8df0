"""Errors of motion capture against their closed forms."""

from __future__ import annotations

import itertools
import math
import statistics
from typing import Any

import pytest

from companion.model.frames import euler_zyx_from_quat
from companion.model.types import IDENTITY_QUAT
from companion.sitl_config.effects.mocap import Mocap
from companion.sitl_config.loader import load_sitl
from sitl.world.effects.mocap import MocapErrors
from tests.sitl.plants import plant_of
from tests.support import CATCH

NOTHING: dict[str, Any] = {
    "pivot_offset_m": (0.0, 0.0, 0.0),
    "body_yaw_deg": 0.0,
    "body_tilt_deg": (0.0, 0.0),
    "lost_share": 0.0,
    "wobble_m": 0.0,
    "wobble_deg": 0.0,
    "delivery_jitter_s": 0.0,
}
ORIGIN = (0.0, 0.0, 0.0)


def errors(**settings: Any) -> MocapErrors:
    return MocapErrors(Mocap(on=True, **{**NOTHING, **settings}), 1)


def test_the_plant_streams_pivot_yaw_and_tilt() -> None:
    config = load_sitl(CATCH, overrides=["world.mocap_noise_m=0", "world.mocap_noise_deg=0"])
    settings = {**NOTHING, "pivot_offset_m": (0.01, 0.0, 0.0), "body_yaw_deg": 2.0, "body_tilt_deg": (0.5, -0.5)}
    world = config.world.model_copy(update={"mocap": Mocap(on=True, **settings)})
    plant = plant_of(config.model_copy(update={"world": world}))
    frames = []
    for _ in range(20):
        plant.step(False)
        frames += plant.mocap.take()
    (x, y, _), truth = frames[-1].position_world_m, plant.truth
    assert x - truth.position_world_m[0] == pytest.approx(0.01, abs=1e-4)
    assert y - truth.position_world_m[1] == pytest.approx(0.0, abs=1e-4)
    streamed, true = euler_zyx_from_quat(frames[-1].attitude_wxyz), euler_zyx_from_quat(truth.attitude_wxyz)
    off_deg = [math.degrees(a - b) for a, b in zip(streamed, true, strict=True)]
    assert off_deg == pytest.approx([0.5, -0.5, 2.0], abs=0.05)


def test_bursts_have_their_share_and_their_length() -> None:
    cameras, period_s = errors(lost_share=0.1, lost_burst_s=0.02), 0.002
    tracked = [cameras.pose(k * period_s, ORIGIN, IDENTITY_QUAT)[2] for k in range(200000)]
    lost = tracked.count(False)
    bursts = sum(a and not b for a, b in itertools.pairwise(tracked))
    assert lost / len(tracked) == pytest.approx(0.1, rel=0.1)
    # A burst shorter than a period may fall between two frames: those seen have exp(-period/mean) of a frame more at the end.
    assert lost * period_s / bursts == pytest.approx(period_s / -math.expm1(-period_s / 0.02), rel=0.1)


def test_jitter_delays_frames_and_keeps_their_order() -> None:
    even = errors(delivery_jitter_s=0.001)
    delays = [even.sent_s(k * 1.0) - k * 1.0 for k in range(10000)]
    assert min(delays) >= 0.0
    assert statistics.fmean(delays) == pytest.approx(0.001, rel=0.05)
    crowded = errors(delivery_jitter_s=0.02)
    sent = [crowded.sent_s(k * 0.005) for k in range(1000)]
    assert sent == sorted(sent)
