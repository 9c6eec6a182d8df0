"""No negative zero where the operator reads numbers: rows of the preflight, events, terminal, report."""

from __future__ import annotations

import io
import math

import pytest

from companion.analysis.report import _number
from companion.config.loader import load_vehicle
from companion.model.negative_zero import without_negative_zero
from companion.preflight.checks import Check
from companion.runtime.console import console_on
from tests.safety.healthy import after_a_moment, put, standing, watched

SMALL = -1e-4
"""Rounds to zero in every text below."""


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("-0 deg", "0 deg"),
        ("at (-0.00, -0.0, 0.31) m", "at (0.00, 0.0, 0.31) m"),
        ("yaw -0 deg, z=-0.00 m.", "yaw 0 deg, z=0.00 m."),
        ("[-0,-0.0]", "[0,0.0]"),
        ("\x1b[1;36m-0.00\x1b[0m m", "\x1b[1;36m0.00\x1b[0m m"),
        ("x     -0.00  y", "x      0.00  y"),
        ("first\n-0.0", "first\n0.0"),
    ],
)
def test_a_negative_zero_loses_its_sign(text: str, plain: str) -> None:
    assert without_negative_zero(text) == plain


@pytest.mark.parametrize(
    "text",
    [
        "-0.001 m",
        "-0.50",
        "-10.0",
        "1e-0",
        "px4 -i 0",
        "run-0",
        "2026-01-02",
        "/dev/ttyUSB-0.0",
        "-0x1f",
        "10-0",
        "- 0",
    ],
)
def test_everything_else_stays_as_it_is(text: str) -> None:
    assert without_negative_zero(text) == text


def test_no_row_of_the_preflight_reads_negative_zero() -> None:
    check = Check("frames.test", "test", "", "")
    read = f"{SMALL:.0f} deg, ({SMALL:.2f}, {SMALL:.2f}) m"
    for row in (check.good(read, read), check.bad(read, read, read), check.doubtful(read, read, read)):
        assert "-0" not in row.line()
        assert row.read == "0 deg, (0.00, 0.00) m"


def test_no_event_reads_negative_zero() -> None:
    beyond = put("arm", angle_rad=(math.radians(180.0), SMALL))
    [event] = watched(
        load_vehicle("configs/vehicles/tarot650_2r.yaml"), after_a_moment(beyond, 50, sound=0), standing()
    )
    assert event.text.startswith("joints at 180, 0 deg")


def test_no_line_in_the_terminal_reads_negative_zero() -> None:
    out = io.StringIO()
    console_on(out).print(f"joint 1 {SMALL:+.1f} deg")
    assert out.getvalue() == "joint 1 0.0 deg\n"


def test_no_number_of_the_report_reads_negative_zero() -> None:
    assert _number(SMALL, 2, " m") == "0.00 m"
