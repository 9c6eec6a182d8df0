"""`companion latency` over real wires: the simulated machine is held and tapped; NatNet on one side, MAVLink on the other."""

from __future__ import annotations

from typing import Any

import pytest

from companion.model.exit_codes import EXIT_OK
from tests.commissioning.test_mocap_wires import VEHICLE, bad, document
from tests.support import Ended, Sandbox, World

TAPPED = ("world.handling=true", "world.handling_t_s=2", "world.handling_taps=60", "world.payload_kg=0")
FEWEST = ("--taps", 5)
"""As few as the tool accepts."""
STEP_MS = 1.0
"""The world sends a frame in the next of its steps of 2 ms, and is held up now and then."""


def measured(sandbox: Sandbox, *knobs: str, options: tuple[object, ...] = ()) -> Ended:
    """In a process of its own, which has real-time priority as in flight."""
    with World(sandbox, overrides=[*TAPPED, *knobs]) as world:
        return sandbox.run("latency", "--json", "--vehicle", VEHICLE, *options, *world.addresses())


def near(found: dict[str, Any], wanted_ms: float) -> None:
    assert found["ev_delay_ms"] == pytest.approx(wanted_ms, abs=STEP_MS + 4.0 * found["standard_error_ms"]), found
    assert found["standard_error_ms"] < 1.5


def test_the_delay_of_the_simulated_mocap_is_found(sandbox: Sandbox) -> None:
    ended = measured(sandbox, options=FEWEST)
    found = document(ended)
    assert ended.code == EXIT_OK
    near(found, 6.0)
    assert found["px4_ms"] == 5.0
    assert sum(tap["problem"] is None for tap in found["taps"]) >= 5
    assert found["mocap_latency_ms"] == pytest.approx(6.0, abs=1.5)
    assert "tap 1 of 5" in ended.err


def test_more_latency_is_found_and_written(sandbox: Sandbox) -> None:
    """What was written is what PX4 reads back."""
    ended = measured(sandbox, "world.mocap_latency_s=0.020", options=("--write", "--yes", *FEWEST))
    found = document(ended)
    near(found, 20.0)
    assert set(bad(found)) == {"latency.delay"}
    assert found["px4_ms"] == 5.0
    assert found["written_ms"] == pytest.approx(found["parameter"]["EKF2_EV_DELAY"], abs=1e-4)
