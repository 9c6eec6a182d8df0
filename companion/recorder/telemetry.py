"""Telemetry's thread in the recorder process: copies of the flight's packets in, nothing that ever waits or grows.

The thread imports what it needs by itself (asyncio, aiomqtt, the configuration's models): a recorder without a broker in its vehicle
file never loads them, and one with it is ready before they are. What runs in it: `companion.recorder.telemetry_link`.
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

if TYPE_CHECKING:
    from companion.recorder.telemetry_link import Counts, FlightSide

PACKETS_MAX = 8192
"""Copies that wait for the thread: 40 s of flight. Beyond that they are counted and left out, the log has them all the same."""


def wanted(config_json: str) -> bool:
    """The configuration names a broker."""
    try:
        return bool(json.loads(config_json)["vehicle"]["ground"]["mqtt"])
    except (ValueError, LookupError, TypeError):
        return False


class Telemetry:
    """The thread and its inbox.

    Args:
        config_json: effective configuration of the flight.
        simulated: the devices are those of the simulated world.
        flight: the way to the flight process and into the log.
        recorder_state: records lost, and why the recorder records no more; called from the thread.
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
        """Of this flight: commands name it."""
        self.left_out = 0
        """Packets that it never saw."""
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
        """Begin."""
        self._thread.start()

    def offer(self, packet: bytes) -> None:
        """A packet of the flight; from any thread, never waits."""
        if self._done:
            return
        if len(self._packets) < PACKETS_MAX:
            self._packets.append((time.monotonic(), packet))
        else:
            self.left_out += 1

    def end(self, *, in_order: bool) -> None:
        """No more packets come; say so to the ground. Does not wait.

        Args:
            in_order: the flight said that it is over; else it died.
        """
        self._ending = in_order

    def ended(self, within_s: float) -> bool:
        """Wait until everything is said, or nobody is there; False: it takes longer."""
        self._thread.join(within_s)
        return not self._thread.is_alive()

    @property
    def counts(self) -> dict[str, str]:
        """For the log's metadata."""
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
        """Whatever happens in here, the log is written all the same."""
        try:
            from companion.config.document import ConfigError
            from companion.recorder import telemetry_link

            self._counts = telemetry_link.Counts()
            try:
                telemetry_link.run(
                    self._config_json,
                    self.session,
                    self._simulated,
                    self._flight,
                    self._packets,
                    self._recorder_state,
                    lambda: self._ending,
                    self._counts,
                )
            except ConfigError as error:
                self._tell(f"no telemetry: {error.lines[0]}")
        except Exception as error:
            self._tell(f"no telemetry any more: {type(error).__name__}: {error}")
            if not isinstance(error, ImportError):
                sys.excepthook(type(error), error, error.__traceback__)
        finally:
            self._done = True
            self._packets.clear()

    def _tell(self, text: str) -> None:
        from companion.model.codec import pack_plain
        from companion.runtime.packets import TEXT, UNNUMBERED

        self._flight.say({"ground": text})
        self._flight.inject(pack_plain((TEXT, UNNUMBERED, 0.0, "warning", "ground", text)))
