"""What `benchmarks.catches` counts."""

from __future__ import annotations

import pytest

from benchmarks.catches import counts_of, table
from companion.core.transition import event_of
from companion.safety import notices

CAUGHT_S = 9.5


@pytest.mark.parametrize(
    ("caught_t_s", "catch_s", "left", "false", "undetected"),
    [
        (CAUGHT_S, (9.51,), False, 0, 0),
        (CAUGHT_S, (), False, 0, 1),
        (CAUGHT_S, (8.0,), False, 1, 1),
        (CAUGHT_S, (8.0, 9.51), False, 1, 0),
        (CAUGHT_S, (9.51,), True, 0, 1),
        (None, (), False, 0, 0),
        (None, (9.51,), True, 1, 0),
    ],
)
def test_a_catch_counts_by_the_truth(
    caught_t_s: float | None, catch_s: tuple[float, ...], left: bool, false: int, undetected: int
) -> None:
    events = [event_of(notices.CATCH, t_s, "") for t_s in catch_s]
    events += [event_of(notices.PAYLOAD_LEFT, 12.0, "")] if left else []
    count = counts_of(events, caught_t_s)
    assert (count["false"], count["undetected"], count["caught"]) == (false, undetected, caught_t_s is not None)
    assert table({0.2: count}).splitlines()[-1].startswith("| 0.2 kg | 1 |")
