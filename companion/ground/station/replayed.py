"""A log as the page gets it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Replayed:
    """One log, ready to be sent."""

    name: str
    """For people; unique among the logs of one page."""
    gzip_json: bytes
    """``{"state", "scene", "preflight", "events", "streams": [...]}``: records of `companion.ground.messages`."""
