"""Text of a sequence of numbers, such as the angles of all joints."""

from __future__ import annotations

from collections.abc import Iterable


def listed(values: Iterable[float], digits: str, between: str = ", ") -> str:
    """Return the numbers in the given format, such as `.1f`, with a separator between them."""
    return between.join([format(value, digits) for value in values])
