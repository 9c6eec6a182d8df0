"""PX4's STATUSTEXT messages: assembled from chunks, cleaned, each line reported once. Pure: time is an argument, nothing is sent.

PX4 sends a long text in chunks of 50 characters (`id`, `chunk_seq`), ends most texts with a tab, which shows a ground station that the
same text was sent as an event too, and repeats a complaint for as long as it holds. Its first text after boot has id 0, which by the
message's definition means a text without chunks; it may have chunks nevertheless (measured on 1.16.1 and 1.18).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

CHUNK_CHARACTERS = 50
"""Size of STATUSTEXT.text: a full chunk may have a successor, a shorter one is the last."""
CHUNK_PATIENCE_S = 0.5
"""Timeout for the successor of a full chunk; PX4 sends them together."""
SAME_TEXT_S = 10.0
"""Time during which a repeated line is not reported again."""
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_LEAST_SEVERE = _SEVERITIES.index("notice")
_MEANINGS = {
    "Preflight Fail": "PX4 does not arm while this holds",
    "Failsafe activated": "a warning as long as PX4 stays in OFFBOARD; if it leaves it, an event follows",
}
"""Texts of PX4 that look worse than they are, by their beginning."""


@dataclass(slots=True)
class _Parts:
    identity: int
    severity: int
    text: str
    next_chunk: int
    stamp_s: float


class Texts:
    """STATUSTEXTs of one autopilot in their order of arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._parts: _Parts | None = None
        self._told_s: dict[str, float] = {}

    def take(self, fields: Mapping[str, Any], now_s: float) -> list[str]:
        """Add one STATUSTEXT and return the lines that can be reported, such as `critical: Preflight Fail: no vision`.

        Information and debug texts are dropped: the status reports their content (armed, landed, log files) better.

        Args:
            fields: fields of the message: `severity` (MAV_SEVERITY), `text`, `id`, `chunk_seq`.
        """
        identity, chunk, text = int(fields["id"]), int(fields["chunk_seq"]), str(fields["text"])
        parts = self._parts
        if parts is not None and (parts.identity, parts.next_chunk) == (identity, chunk) and chunk:
            parts.text += text
            parts.next_chunk += 1
            parts.stamp_s = now_s
            lines = []
        else:
            lines = self._finish(now_s)
            self._parts = _Parts(
                identity=identity, severity=int(fields["severity"]), text=text, next_chunk=chunk + 1, stamp_s=now_s
            )
        if len(text) < CHUNK_CHARACTERS:
            lines += self._finish(now_s)
        return lines

    def overdue(self, now_s: float) -> list[str]:
        """Return the lines whose next chunk has not arrived within the timeout."""
        parts = self._parts
        return self._finish(now_s) if parts is not None and now_s - parts.stamp_s >= CHUNK_PATIENCE_S else []

    def once(self, line: str, now_s: float) -> list[str]:
        """Return the line unless it was reported a moment ago."""
        self._told_s = {told: at_s for told, at_s in self._told_s.items() if now_s - at_s < SAME_TEXT_S}
        if line in self._told_s:
            return []
        self._told_s[line] = now_s
        return [line]

    def _finish(self, now_s: float) -> list[str]:
        parts, self._parts = self._parts, None
        if parts is None or parts.severity > _LEAST_SEVERE:
            return []
        text = "".join(c if c.isprintable() else "?" for c in " ".join(parts.text.split()))
        meaning = next((f" ({meaning})" for start, meaning in _MEANINGS.items() if text.startswith(start)), "")
        return self.once(f"{_SEVERITIES[parts.severity]}: {text}{meaning}", now_s) if text else []
