"""Nested data by names: the one way in which configurations, rows of campaigns and records of a log become columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any


def flat(
    tree: Any, expands: Callable[[list[Any] | tuple[Any, ...]], bool] = lambda _: False, name: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield the values of nested data under their keys joined by dots, such as `mocap.position_world_m[0]`.

    Args:
        expands: returns whether the elements of a list have names of their own; if not, the list is one value.
        name: name of `tree` itself.
    """
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            yield from flat(value, expands, f"{name}.{key}" if name else key)
    elif isinstance(tree, list | tuple) and expands(tree):
        for index, value in enumerate(tree):
            yield from flat(value, expands, f"{name}[{index}]")
    else:
        yield name, tree
