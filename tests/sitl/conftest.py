"""What tests of the simulated world share."""

from __future__ import annotations

import pytest


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wait of a flight before its take-off is short: nothing but noise happens meanwhile."""
    monkeypatch.setattr("companion.model.flight_stage.TARE_S", 0.1)
    monkeypatch.setattr("companion.mission.settled.SETTLED_S", 0.1)
