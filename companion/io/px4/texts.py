"""What PX4 says in words: STATUSTEXT put together, cleaned, and each line told once. Pure: time is an argument, nothing goes out.

PX4 sends a long text in chunks of 50 characters (`id`, `chunk_seq`), ends most texts with a tab, which tells a ground station that the
same came as an event too, and repeats a complaint for as long as it holds. Its first text after boot has the id 0, which by the
message's definition is one without chunks; it may have some all the same (measured on 1.16.1 and 1.18).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

CHUNK_CHARACTERS = 50
"""Of STATUSTEXT.text: a full chunk may have a successor, a shorter one is the last."""
CHUNK_PATIENCE_S = 0.5
"""So long a full chunk waits for its successor; PX4 sends them together."""
SAME_TEXT_S = 10.0
"""A line is not told again so soon after it was told."""
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_LEAST_SEVERE = _SEVERITIES.index("notice")


@dataclass(slots=True)
class _Parts:
    identity: int
    severity: int
    text: str
    next_chunk: int
    stamp_s: float


class Texts:
    """STATUSTEXTs of one autopilot, in the order of their arrival. Not safe for two threads at once."""

    def __init__(self) -> None:
        self._parts: _Parts | None = None
        self._told_s: dict[str, float] = {}

    def take(self, fields: Mapping[str, Any], now_s: float) -> list[str]:
        """What can be told after one more STATUSTEXT, each one line, such as `critical: Preflight Fail: no vision`.

        Information and debug texts are not told: what they say (armed, landed, log files) the status says better.

        Args:
            fields: of the message: `severity` (MAV_SEVERITY), `text`, `id`, `chunk_seq`.
            now_s: flight clock.
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
            self._parts = _Parts(identity, int(fields["severity"]), text, chunk + 1, now_s)
        if len(text) < CHUNK_CHARACTERS:
            lines += self._finish(now_s)
        return lines

    def overdue(self, now_s: float) -> list[str]:
        """What is told because its next chunk has not come in time: perhaps there is none."""
        parts = self._parts
        return self._finish(now_s) if parts is not None and now_s - parts.stamp_s >= CHUNK_PATIENCE_S else []

    def once(self, line: str, now_s: float) -> list[str]:
        """The line, unless it was told a moment ago."""
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
        return self.once(f"{_SEVERITIES[parts.severity]}: {text}", now_s) if text else []
