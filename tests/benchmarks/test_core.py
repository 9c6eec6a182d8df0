"""The parts of a tick are measured, and no part takes longer than the whole."""

from __future__ import annotations

from benchmarks.measuring.core import measure
from tests.support import SHORT_CATCH


def test_the_parts_of_a_tick_take_less_than_the_tick() -> None:
    found = measure(lambda text: None, 1, SHORT_CATCH)
    assert 0.0 < found["raw_step_us"] < found["raw_tick_us"] < found["tick_us"]
    assert 0.0 < found["law_us"] < found["tick_us"]
    assert 0.0 < found["law_without_loads_us"] < found["tick_us"]
    assert found["core_ms"]["p50"] > 0.0
