"""A limit that one instant of a plan exceeds."""

from __future__ import annotations

from dataclasses import dataclass

TOLERANCE = 1e-6
"""Relative tolerance, so that a mission may use its limits fully."""


@dataclass(frozen=True, slots=True)
class Violation:
    """A limit that one sample exceeds. `excess` orders violations of the same limit."""

    limit: str
    excess: float
    what: str
    detail: str
    advice: str
