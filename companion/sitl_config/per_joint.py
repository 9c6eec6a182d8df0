"""World settings that have one value for each joint of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, TypeVar

from pydantic import Field

from companion.config.base import JOINTS_MAX, RelativeError
from companion.config.document import Data, Document

T = TypeVar("T")

RelativeErrors = Annotated[tuple[RelativeError, ...], Field(min_length=1, max_length=JOINTS_MAX)]
"""One relative error for each joint, from the shoulder outwards. The last one also holds for further joints; surplus ones are
ignored.
"""
LengthError = Annotated[float, Field(ge=-0.05, le=0.05)]
LengthErrors = Annotated[tuple[LengthError, ...], Field(min_length=1, max_length=JOINTS_MAX)]
"""One length error for each joint, like `RelativeErrors`."""

SETTINGS: tuple[tuple[str, ...], ...] = (
    ("link_mass_error",),
    ("machine", "link_length_error_m"),
    ("machine", "link_com_error_m"),
    ("servo_mechanics", "torque_per_amp_error"),
)
"""Locations in the world of the settings with one value for each joint."""


def of_joints(values: Sequence[T], count: int) -> tuple[T, ...]:
    """Return one value for each of `count` joints: the last value is repeated for further joints, and surplus values are left out."""
    return tuple(values[min(joint, len(values) - 1)] for joint in range(count))


def repeat_for_joints(document: Document, count: int) -> None:
    """Repeat the last value of each of `SETTINGS` in a world's document for an arm of `count` joints.

    A repeated distribution is then drawn separately for each joint.
    """
    for location in SETTINGS:
        node: Data = document.data
        for key in location:
            node = node.get(key) if isinstance(node, dict) else None
        if isinstance(node, list) and node:
            node.extend(node[-1:] * (count - len(node)))
