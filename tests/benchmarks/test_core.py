"""The parts of a tick are measured, and no part takes longer than the whole."""

from __future__ import annotations

from pathlib import Path

from benchmarks.measuring.core import measure
from tests.support import HOVER


def test_the_parts_of_a_tick_take_less_than_the_tick(tmp_path: Path) -> None:
    """On a hop of a second."""
    hop = tmp_path / "hop.yaml"
    text = HOVER.read_text(encoding="utf-8").replace("../vehicles/", f"{HOVER.parents[1]}/vehicles/")
    hop.write_text(
        text.replace("height_m: 1.0", "height_m: 0.4")
        .replace("duration_s: 3.0", "duration_s: 1.5")
        .replace("duration_s: 5.0", "duration_s: 1.0"),
        encoding="utf-8",
    )
    found = measure(lambda text: None, 1, hop)
    assert 0.0 < found["raw_step_us"] < found["raw_tick_us"] < found["tick_us"]
    assert 0.0 < found["law_us"] < found["tick_us"]
    assert 0.0 < found["law_without_loads_us"] < found["tick_us"]
    assert found["core_ms"]["p50"] > 0.0
