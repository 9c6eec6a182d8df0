"""STATUSTEXT into lines, without a wire."""

from __future__ import annotations

from typing import Any

import pytest

from companion.io.px4.texts import CHUNK_PATIENCE_S, SAME_TEXT_S, Texts

LONG = "Arming denied: Resolve system health failures first"
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6


def statustext(text: str, identity: int = 0, chunk: int = 0, severity: int = CRITICAL) -> dict[str, Any]:
    return {"severity": severity, "text": text, "id": identity, "chunk_seq": chunk}


def test_a_short_text_is_reported_at_once_and_without_its_tab() -> None:
    assert Texts().take(statustext("no heading reference\t"), 0.0) == ["critical: no heading reference"]


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("Preflight Fail: Yaw estimate error\t", "PX4 does not arm while this holds"),
        ("Failsafe activated\t", "a warning as long as PX4 stays in OFFBOARD; if it leaves it, an event follows"),
    ],
)
def test_a_text_that_looks_worse_than_it_is_is_explained_beside_it(text: str, meaning: str) -> None:
    assert Texts().take(statustext(text), 0.0) == [f"critical: {text.strip()} ({meaning})"]


@pytest.mark.parametrize("identity", [0, 1, 65535])
def test_chunks_are_one_line(identity: int) -> None:
    texts = Texts()
    assert texts.take(statustext(LONG[:50], identity, 0), 0.0) == []
    assert texts.take(statustext(LONG[50:] + "\t", identity, 1), 0.01) == [f"critical: {LONG}"]
    assert texts.overdue(10.0) == []


def test_a_text_of_exactly_one_chunk_is_reported_after_a_while() -> None:
    texts = Texts()
    assert texts.take(statustext(LONG[:50], 3), 1.0) == []
    assert texts.overdue(1.0 + CHUNK_PATIENCE_S - 0.01) == []
    assert texts.overdue(1.0 + CHUNK_PATIENCE_S) == [f"critical: {LONG[:50]}"]
    assert texts.overdue(10.0) == []


def test_another_text_ends_one_that_was_cut_off() -> None:
    texts = Texts()
    assert texts.take(statustext(LONG[:50], 3), 0.0) == []
    assert texts.take(statustext("and so on\t", 4), 0.1) == [f"critical: {LONG[:50]}", "critical: and so on"]


def test_a_chunk_that_does_not_follow_is_no_part_of_the_text() -> None:
    texts = Texts()
    assert texts.take(statustext(LONG[:50], 3, 0), 0.0) == []
    assert texts.take(statustext("third", 3, 2), 0.1) == [f"critical: {LONG[:50]}", "critical: third"]


def test_the_same_text_is_reported_again_only_after_a_while() -> None:
    texts = Texts()
    assert len(texts.take(statustext("again\t"), 0.0)) == 1
    assert [texts.take(statustext("again"), t_s) for t_s in (0.5, 5.0, SAME_TEXT_S - 0.01)] == [[]] * 3
    assert len(texts.take(statustext("another"), 5.0)) == 1
    assert texts.take(statustext("again\t"), SAME_TEXT_S) == ["critical: again"]


def test_information_is_not_reported_and_whatever_is_in_a_text_it_is_one_line() -> None:
    texts = Texts()
    assert texts.take(statustext("Takeoff detected\t", severity=INFO), 0.0) == []
    assert texts.take(statustext("no MAV_SEVERITY", severity=200), 0.0) == []
    assert texts.take(statustext("\t"), 0.0) == []
    assert texts.take(statustext("a\n b\x1b[31m", severity=NOTICE), 0.0) == ["notice: a b?[31m"]
    assert texts.take(statustext("low battery", severity=WARNING), 0.0) == ["warning: low battery"]
