"""Texts for people without negative zeros: a small negative number that rounds to zero reads `0.00`, not `-0.00`."""

from __future__ import annotations

import re

_NEGATIVE_ZERO = re.compile(
    r"(^|  |[\s(\[,=]|\x1b\[[\d;]*m)"  # a number begins here: after a space, a bracket, or a terminal's colour code
    r"-(0(?:\.0+)?)"
    r"(?!\.?\w|[-/])",
    re.MULTILINE,
)


def without_negative_zero(text: str) -> str:
    """Return the text with every `-0`, `-0.0`, `-0.00` ... as zero without a sign.

    After two spaces, as in a column of a table, a third one takes the place of the sign. Names that contain `-0` stay as they are.
    """
    return _NEGATIVE_ZERO.sub(_unsigned, text) if "-0" in text else text


def _unsigned(found: re.Match[str]) -> str:
    before, zero = found.groups()
    return f"{before} {zero}" if before == "  " else f"{before}{zero}"
