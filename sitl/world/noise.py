"""Repeatable noise of the simulated world: one sequence per source and seed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from companion.model.types import Vec3

_BLOCK: Final = 4096


def noise(seed: int, source: int) -> Iterator[Vec3]:
    """Yield triples of standard normal numbers, drawn in blocks for speed."""
    rng = np.random.default_rng((seed, source))
    while True:
        values = iter(rng.standard_normal(_BLOCK).tolist()[::-1])
        yield from zip(values, values, values, strict=False)
