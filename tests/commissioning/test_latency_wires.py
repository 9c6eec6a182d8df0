"""`companion latency` over real wires: the simulated machine is held and tapped; NatNet on one side, MAVLink on the other."""

from __future__ import annotations

from typing import Any

import pytest

from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_OK, EXIT_REFUSED
from tests.commissioning.test_mocap_wires import VEHICLE, bad, document
from tests.support import Ended, Sandbox, World, run_here

TAPPED = ("world.hand=true", "world.hand_t_s=2", "world.hand_taps=60", "world.payload_kg=0")
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


def test_the_stubs_5_ms_are_found(sandbox: Sandbox) -> None:
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


def test_without_px4_it_says_so(sandbox: Sandbox) -> None:
    with World(sandbox) as world:
        address = {"address": "serial:///dev/ttyNONE:921600"}
        ended = run_here("latency", "--vehicle", VEHICLE, *world.addresses(autopilot=address))
    assert ended.code == EXIT_REFUSED
    assert "the serial port /dev/ttyNONE, found No such file" in ended.out
    assert "Traceback" not in ended.err


@pytest.mark.parametrize("options", [("--taps", "2"), ("--seconds", "nan"), ("--taps", "many")])
def test_bad_input_opens_nothing(options: tuple[str, ...]) -> None:
    ended = run_here("latency", "--vehicle", VEHICLE, *options)
    assert ended.code == EXIT_BAD_INPUT
    assert len(ended.err_lines) == 1
