"""One stream of frame numbers, or two."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.safety.stream_watch import REORDERED_MAX, WINDOW_S, StreamWatch

PERIOD_S = 0.005
Frame = tuple[int, object]
"""Number and content."""


def judged(frames: Iterable[Frame], period_s: float = PERIOD_S) -> bool:
    """Whether any frame made it two streams."""
    watch = StreamWatch()
    return any(watch.update(number & 0xFFFFFFFF, content, k * period_s) for k, (number, content) in enumerate(frames))


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 1000), min_size=2, max_size=50))
def test_one_stream_with_any_gaps_is_one(start: int, gaps: list[int]) -> None:
    numbers = [start]
    for gap in gaps:
        numbers.append(numbers[-1] + gap)
    assert not judged((number, number) for number in numbers)


def disturbed(reordered: float, seed: int, frames: int) -> list[Frame]:
    """One stream: a share of the frames arrives up to three places late, and 1 % twice, the second time up to three places late.

    Args:
        reordered: share.
        seed: of the draw.
        frames: how many are sent.
    """
    draw = random.Random(seed)
    placed: list[tuple[float, Frame]] = []
    for k in range(frames):
        frame: Frame = (k + 2**32 - 1000, ("body", k))
        placed.append((k + (draw.randint(1, 3) + 0.5 if draw.random() < reordered else 0.0), frame))
        if draw.random() < 0.01:
            placed.append((k + draw.randint(0, 3) + 0.6, frame))
    return [frame for _, frame in sorted(placed)]


@pytest.mark.parametrize("reordered", [0.0, 0.05])
@pytest.mark.parametrize("rate_hz", [100, 1000])
def test_a_minute_of_reordered_and_duplicated_datagrams_is_one_stream(reordered: float, rate_hz: int) -> None:
    assert not judged(disturbed(reordered, 1, 60 * rate_hz), 1.0 / rate_hz)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**31), st.integers(1, 3))
def test_two_streams_are_two_soon_after_the_second_one_begins(start: int, apart: int, every: int) -> None:
    """The first stream repeats the second one's numbers once it has come that far."""
    frames: list[Frame] = []
    for k in range(REORDERED_MAX + 4 * every):
        frames.append((start + k, "first"))
        if k % every == 0:
            frames.append((start + apart + k, "second"))
    assert judged(frames)


@pytest.mark.parametrize("apart", range(-5, 6))
def test_two_disturbed_streams_a_few_frames_apart_are_two(apart: int) -> None:
    """Interleaved, and both reordered and duplicated by the network."""
    first = disturbed(0.05, 1, 60)
    second = [(number + apart, ("other", content)) for number, content in disturbed(0.05, 2, 60)]
    assert judged(frame for both in zip(first, second, strict=False) for frame in both)


def test_a_server_that_is_restarted_twice_is_one() -> None:
    numbers = [*range(9000, 9020), *range(20), *range(20)]
    assert not judged((number, k) for k, number in enumerate(numbers))


def test_it_is_over_when_the_other_stream_has_been_gone_for_the_window() -> None:
    watch = StreamWatch()
    assert [watch.update(number, number, 0.0) for number in (9000, 1, 9001, 2, 9002, 3)][-1]
    assert watch.two(WINDOW_S)
    assert not watch.two(WINDOW_S + 0.01)
