"""Removes the sign of rounded negative zeros from displayed text, so that it shows `0.00` instead of `-0.00`."""

from __future__ import annotations

import re

_NEGATIVE_ZERO = re.compile(
    r"(^|  |[\s(\[,=]|\x1b\[[\d;]*m)"  # a number begins here: after a space, a bracket, or a terminal's colour code
    r"-(0(?:\.0+)?)"
    r"(?!\.?\w|[-/])",
    re.MULTILINE,
)


def without_negative_zero(text: str) -> str:
    """Return the text without the sign of every negative zero (`-0`, `-0.0`, `-0.00` and so on).

    After two spaces, as in a table column, a space replaces the sign. Names that contain `-0` are not changed.
    """
    return _NEGATIVE_ZERO.sub(_unsigned, text) if "-0" in text else text


def _unsigned(found: re.Match[str]) -> str:
    before, zero = found.groups()
    return f"{before} {zero}" if before == "  " else f"{before}{zero}"
