"""`mocap_dragged` and `tether_snagged` in the fast loop, with the vibration of rotors on the accelerometer."""

from __future__ import annotations

import json
import math

import pytest

from companion.config.safety import Safety
from companion.model.types import Outcome, SafetyAction
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.support import SHORT_CATCH

pytestmark = pytest.mark.usefixtures("short_start")

LIMIT_M = Safety().mocap_inertial_m
ONLY_VIBRATION = {
    "on": True,
    "accel_bias_m_s2": [0.0, 0.0, 0.0],
    "accel_drift_m_s2": 0.0,
    "gyro_bias_deg_s": [0.0, 0.0, 0.0],
    "gyro_drift_deg_s": 0.0,
    "mount_rpy_deg": [0.0, 0.0, 0.0],
    "gyro_vibration_deg_s": 0.0,
    "rectification_m_s2": [0.0, 0.0, 0.0],
}


def flown(amplitude_m_s2: float, hz: float, *faults: str) -> tuple[FastFlight, FastResult]:
    config = load_sitl(
        SHORT_CATCH,
        overrides=[
            "world.imu=" + json.dumps({**ONLY_VIBRATION, "vibration_m_s2": amplitude_m_s2, "vibration_hz": hz}),
            f"world.faults=[{', '.join(faults)}]",
        ],
    )
    flight = FastFlight(config)
    return flight, flight.run()


def test_vibration_is_neither_drag_nor_snag() -> None:
    """A whole flight with a catch stays below a third of the limit. At 100 and 150 Hz samples of 200 Hz alias to nearly 0 Hz in
    hover, at 200 Hz those along the rotor axes do."""
    _, result = flown(10.0, 100.2)
    judged = [outputs.mocap_innovation_m for outputs in result.outputs if outputs.mocap_innovation_m]
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert "tether_snagged" not in {event.id for outputs in result.outputs for event in outputs.events}
    assert len(judged) > 900
    assert max(judged) < LIMIT_M / 3.0


def test_dragged_poses_are_found_through_vibration_and_px4_lands_without_them() -> None:
    """PX4 fuses the dragged poses, so its position agrees with them; the IMU does not."""
    flight, result = flown(10.0, 149.7, "{kind: mocap_drag, phase: line, size: 0.6}")
    begun_s = flight.faults.begun_s
    assert begun_s is not None
    first, *more = [event for outputs in result.outputs for event in outputs.events if event.t_s >= begun_s]
    assert (first.id, first.action) == ("mocap_dragged", SafetyAction.AUTOPILOT_LAND)
    assert first.t_s - begun_s < 0.2 and "mocap_dragged" not in {event.id for event in more}
    assert not any(outputs.mocap_trusted for outputs in result.outputs if outputs.t_s >= first.t_s)
    at_fault = next(truth for truth in result.truth if truth.t_s >= begun_s)
    assert math.dist(at_fault.position_world_m[:2], result.truth[-1].position_world_m[:2]) < 0.6
    assert not result.crashed and not result.armed
