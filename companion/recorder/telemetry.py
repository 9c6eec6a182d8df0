"""The recorder's telemetry thread: receives copies of the flight's packets through a bounded queue, and never delays the log.

The thread imports what it needs by itself (asyncio, aiomqtt, the configuration's models): a recorder without a broker in its vehicle
file never loads them, and one with a broker is ready before they are loaded. The thread runs `companion.recorder.telemetry_link`.
"""

from __future__ import annotations

import json
import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from companion.model.codec import to_packet
from companion.model.packets import LogLine
from companion.model.types import Severity

if TYPE_CHECKING:
    from companion.recorder.telemetry_link import Counts, FlightSide

PACKETS_MAX = 8192
"""Maximum number of packets that wait for the thread: 40 s of flight. Further ones are counted and skipped; the log still has them."""


def broker_configured(config_json: str) -> bool:
    """Whether the configuration names a broker."""
    try:
        return bool(json.loads(config_json)["vehicle"]["ground"]["mqtt"])
    except (ValueError, LookupError, TypeError):
        return False


class TelemetryThread:
    """The thread and its packet queue.

    Args:
        flight: connection to the flight process and to the log.
        recorder_state: returns the number of lost records, and why recording stopped; called from the thread.
    """

    def __init__(
        self,
        config_json: str,
        *,
        simulated: bool,
        flight: FlightSide,
        recorder_state: Callable[[], tuple[int, str | None]],
    ) -> None:
        self.session = secrets.token_hex(8)
        """Session id of this flight, which commands must name."""
        self.dropped = 0
        """Number of packets that the queue had no room for."""
        self._config_json = config_json
        self._simulated = simulated
        self._flight = flight
        self._recorder_state = recorder_state
        self._packets: deque[tuple[float, bytes]] = deque()
        self._ending: bool | None = None
        self._done = False
        self._counts: Counts | None = None
        self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def offer(self, packet: bytes) -> None:
        """Queue a packet of the flight; callable from any thread, never waits."""
        if self._done:
            return
        if len(self._packets) < PACKETS_MAX:
            self._packets.append((time.monotonic(), packet))
        else:
            self.dropped += 1

    def end(self, *, normally: bool) -> None:
        """End the session after the last packet, without waiting.

        Args:
            normally: True if the flight ended normally, False if its process died.
        """
        self._ending = normally

    def join(self, within_s: float) -> bool:
        """Wait up to `within_s` for the thread's end, after its last message or without a broker; return whether it ended."""
        self._thread.join(within_s)
        return not self._thread.is_alive()

    @property
    def counts(self) -> dict[str, str]:
        """Counts for the log's metadata."""
        counts = self._counts
        if counts is None:
            return {}
        return {
            "session": self.session,
            "broker_connections": str(counts.connections),
            "stream_sent": str(counts.stream_sent),
            "stream_dropped": str(counts.stream_dropped),
            "commands": str(counts.commands),
            "commands_refused": str(counts.refused),
        }

    def _run(self) -> None:
        """Run the event loop. No failure here affects the log."""
        try:
            from companion.config.document import ConfigError
            from companion.recorder import telemetry_link

            self._counts = telemetry_link.Counts()
            recorder = telemetry_link.RecorderSide(
                flight=self._flight,
                packets=self._packets,
                state=self._recorder_state,
                ending=lambda: self._ending,
                counts=self._counts,
            )
            try:
                telemetry_link.run(self._config_json, self.session, self._simulated, recorder)
            except ConfigError as error:
                self._report(f"no telemetry: {error.lines[0]}")
        except Exception as error:
            self._report(f"telemetry failed: {type(error).__name__}: {error}")
            if not isinstance(error, ImportError):
                sys.excepthook(type(error), error, error.__traceback__)
        finally:
            self._done = True
            self._packets.clear()

    def _report(self, text: str) -> None:
        self._flight.send({"ground": text})
        line = LogLine(t_s=0.0, severity=Severity.WARNING, source="ground", text=text)
        self._flight.inject(to_packet(line))
