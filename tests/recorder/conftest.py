from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.model.types import OperatorCommand
from companion.sitl_config.loader import load_sitl
from sitl.fast.loop import FastFlight
from tests.recorder.flights import flight_of, record
from tests.recorder.viewers import Viewed, view
from tests.support import SHORT_CATCH


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a flight of the fast loop with a catch and a commanded landing, written by the recorder."""
    config = load_sitl(SHORT_CATCH)
    result = FastFlight(config, {8.7: OperatorCommand.LAND}).run()
    assert result.caught
    path = [o.reference.position_world_m for o in result.outputs if o.reference is not None][::40]
    return record(
        tmp_path_factory.mktemp("flown") / "flight.mcap",
        flight_of(result),
        config_json=config.flight.model_dump_json(),
        plan_json=json.dumps(path),
    )


@pytest.fixture(scope="session")
def viewed(flown: Path) -> Viewed:
    return view(flown)
