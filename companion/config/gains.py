"""Types of gains in a controller file: one value for each row of chi, for each joint, or for each axis."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from companion.config.base import JOINTS_MAX, NonNegative, OrElse, Positive


def _as_joints(given: Any) -> Any:
    """Return one number as the gain of all joints, and a list as the tuple that strict validation expects after this function."""
    if isinstance(given, int | float):
        return (given,)
    return tuple(given) if isinstance(given, list) else given


PositiveRows = Annotated[tuple[Positive, ...], Field(min_length=7, max_length=6 + JOINTS_MAX)]
"""One value for each of x, y, z, roll, pitch, yaw and for each joint. A vehicle with n joints uses the first 6 + n values; if there are
fewer, the last value applies to the remaining joints too. So one file of gains serves every arm.
"""
NonNegativeRows = Annotated[tuple[NonNegative, ...], Field(min_length=7, max_length=6 + JOINTS_MAX)]
PositiveJoints = Annotated[tuple[Positive, ...], Field(min_length=1, max_length=JOINTS_MAX)]
"""One value for each joint. A vehicle with n joints uses the first n values; if there are fewer, the last value applies to the
remaining joints too.
"""
NonNegativeJoints = Annotated[
    tuple[NonNegative, ...],
    Field(min_length=1, max_length=JOINTS_MAX),
    BeforeValidator(_as_joints),
    OrElse({"type": "number"}),
]
"""One value for each joint, as in `PositiveJoints`, or one number for all joints."""
NonNegative3 = tuple[NonNegative, NonNegative, NonNegative]
Positive4 = tuple[Positive, Positive, Positive, Positive]


def six_digits(value: float) -> float:
    """Return the value rounded to six significant digits, as a file of found gains states it."""
    return float(f"{value:.6g}")


def fitted(gains: tuple[float, ...], count: int) -> tuple[float, ...]:
    """Return the gains of the first `count` rows or joints; the last gain is repeated for those beyond the list."""
    return (*gains, *gains[-1:] * (count - len(gains)))[:count]
