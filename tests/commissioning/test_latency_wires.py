"""`companion latency` over real wires: the simulated machine is held and tapped; NatNet on one side, MAVLink on the other."""

from __future__ import annotations

import pytest

from tests.commissioning.test_mocap_wires import VEHICLE, bad, document
from tests.support import Sandbox, World

TAPPED = (
    "world.handling=true",
    "world.handling_t_s=2",
    "world.handling_taps=60",
    "world.payload_kg=0",
    "world.mocap_latency_s=0.020",
)
STEP_MS = 1.0
"""The world sends a frame in the next of its steps of 2 ms, and is held up now and then."""


def test_the_delay_of_the_simulated_mocap_is_found_and_written(sandbox: Sandbox) -> None:
    """In a process of its own, which has real-time priority as in flight. What was written is what PX4 reads back."""
    with World(sandbox, overrides=TAPPED) as world:
        options = (
            "--vehicle",
            VEHICLE,
            "--write",
            "--yes",
            "--taps",
            5,
            *world.addresses(),
        )  # as few as the tool accepts
        ended = sandbox.run("latency", "--json", *options)
    found = document(ended)
    assert found["ev_delay_ms"] == pytest.approx(20.0, abs=STEP_MS + 4.0 * found["standard_error_ms"]), found
    assert found["standard_error_ms"] < 1.5
    assert set(bad(found)) == {"latency.delay"}
    assert found["px4_ms"] == 5.0
    assert found["written_ms"] == pytest.approx(found["parameter"]["EKF2_EV_DELAY"], abs=1e-4)
    assert sum(tap["problem"] is None for tap in found["taps"]) >= 5
    assert found["mocap_latency_ms"] == pytest.approx(20.0, abs=1.5)
    assert "tap 1 of 5" in ended.err
