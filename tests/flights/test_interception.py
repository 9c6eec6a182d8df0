"""A thrown ball is met by a plan that is made in flight, and the log replays."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.model.exit_codes import EXIT_OK
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import log_of
from sitl.fast.loop import FastFlight
from tests.analysis.synthetic_flight import record_rows
from tests.flights.ends import flown_until
from tests.support import run_here

SOON = (
    "mission.phases[0].duration_s=2.0",
    "mission.phases[1].duration_s=0.1",
    "mission.phases[2]={type: line, to_m: [0.0, -0.15, 1.15], duration_s: 2.6, arm_deg: [65.0, 27.0]}",
)
"""The waiting point is reached in half of the time."""

pytestmark = pytest.mark.usefixtures("short_start")


def test_the_log_of_an_interception_replays_bit_for_bit(tmp_path: Path) -> None:
    """Balls and plans of the flight are part of the inputs and of the core's state."""
    flight = FastFlight(load_sitl("configs/missions/intercept.yaml", overrides=SOON, world="careless"))
    result = flown_until(flight, lambda outputs: outputs.phase == "stabilise")
    assert result.caught
    log, path = log_of(flight.config.flight, result, None), tmp_path / "flight.mcap"
    assert record_rows(path, log.rows(), log.config_json or "").dropped == 0
    replayed = run_here("replay", path)
    assert (replayed.code, replayed.err) == (EXIT_OK, "")
    found, _, end = replayed.out.partition("; ")
    assert found == f"{path}: {len(result.inputs)} ticks replayed, every output bit-identical"
    assert end.startswith("the log ends before the flight did"), "the flight was stopped here"
