from __future__ import annotations

import pytest

from companion.analysis.log import FlightLog
from tests.analysis.synthetic_flight import record_flight


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    report = record_flight(path)
    assert (report.dropped, report.error) == (0, None)
    return FlightLog.read(path)
