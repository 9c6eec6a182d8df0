"""One stream of frame numbers, or two."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from companion.safety.stream_watch import WINDOW_S, StreamWatch

PERIOD_S = 0.005


def judged(numbers: list[int], period_s: float = PERIOD_S) -> bool:
    """Whether any frame made it two streams."""
    watch = StreamWatch()
    return any(watch.update(number & 0xFFFFFFFF, k * period_s) for k, number in enumerate(numbers))


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 1000), min_size=2, max_size=50))
def test_one_stream_with_any_gaps_is_one(start: int, gaps: list[int]) -> None:
    numbers = [start]
    for gap in gaps:
        numbers.append(numbers[-1] + gap)
    assert not judged(numbers)


@given(st.integers(0, 2**32 - 1), st.integers(1, 2**31), st.integers(1, 3))
def test_two_streams_are_two_within_a_few_frames_of_the_second_one(start: int, apart: int, every: int) -> None:
    numbers: list[int] = []
    for k in range(12):
        numbers.append(start + k)
        if k % every == 0:
            numbers.append(start + apart + k)
    assert judged(numbers)


def test_the_same_numbers_from_two_servers_are_two_streams() -> None:
    assert judged([7, 7, 8, 8, 9, 9])


def test_a_server_that_is_restarted_twice_is_one() -> None:
    assert not judged([*range(9000, 9020), *range(20), *range(20)])


def test_it_is_over_when_the_other_stream_has_been_gone_for_the_window() -> None:
    watch = StreamWatch()
    assert [watch.update(number, 0.0) for number in (9, 1, 10, 2, 11, 3)][-1]
    assert watch.two(WINDOW_S)
    assert not watch.two(WINDOW_S + 0.01)
