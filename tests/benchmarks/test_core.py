"""The parts of a tick are measured."""

from __future__ import annotations

from pathlib import Path

from benchmarks.measuring.core import measure
from tests.support import HOVER


def test_every_part_of_a_tick_is_measured(tmp_path: Path) -> None:
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
    for part in ("raw_step_us", "raw_tick_us", "law_us", "law_without_loads_us", "tick_us"):
        assert found[part] > 0.0, part
    assert found["core_ms"]["p50"] > 0.0
