"""`mocap_dragged` and `tether_snagged` in the fast loop, with the vibration of rotors on the accelerometer."""

from __future__ import annotations

import json

import pytest

from companion.config.safety import Safety
from companion.model.types import Outcome
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.support import SHORT_CATCH

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


def flown(amplitude_m_s2: float, hz: float, *faults: str) -> tuple[SitlConfig, FastFlight, FastResult]:
    config = load_sitl(
        SHORT_CATCH,
        overrides=[
            "world.imu=" + json.dumps({**ONLY_VIBRATION, "vibration_m_s2": amplitude_m_s2, "vibration_hz": hz}),
            f"world.faults=[{', '.join(faults)}]",
        ],
    )
    flight = FastFlight(config)
    return config, flight, flight.run()


@pytest.mark.parametrize(("amplitude_m_s2", "hz"), [(10.0, 100.2), (10.0, 149.7)])
def test_vibration_is_neither_drag_nor_snag(amplitude_m_s2: float, hz: float) -> None:
    """A whole flight with a catch stays below a third of the limit. At 100 and 150 Hz samples of 200 Hz alias to nearly 0 Hz in
    hover, at 200 Hz those along the rotor axes do."""
    _, _, result = flown(amplitude_m_s2, hz)
    judged = [outputs.mocap_innovation_m for outputs in result.outputs if outputs.mocap_innovation_m]
    assert result.outputs[-1].outcome is Outcome.COMPLETED
    assert "tether_snagged" not in {event.id for outputs in result.outputs for event in outputs.events}
    assert len(judged) > 900
    assert max(judged) < LIMIT_M / 3.0


def test_a_drag_is_found_through_vibration() -> None:
    _, flight, result = flown(10.0, 149.7, "{kind: mocap_drag, phase: line, size: 0.6}")
    begun_s = flight.faults.begun_s
    assert begun_s is not None
    found_s = [event.t_s for outputs in result.outputs for event in outputs.events if event.id == "mocap_dragged"]
    assert len(found_s) == 1 and 0.0 < found_s[0] - begun_s < 0.2
    assert not result.crashed and not result.armed
