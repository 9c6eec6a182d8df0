"""The companion's own messages to a MAVLink ground station: STATUSTEXT and NAMED_VALUE_FLOAT. Pure: no socket, no clock.

They come from component 191 (MAV_COMP_ID_ONBOARD_COMPUTER) of the vehicle and go to the ground only; PX4 does not receive them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.model.outputs import Outputs
from companion.model.types import Event, Inputs, Outcome, SafetyAction, Severity
from companion.runtime.token_bucket import TokenBucket

COMPONENT = int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
TEXT_BYTES = 50
TEXT_MAX_BYTES = 4 * TEXT_BYTES
TEXT_RATE_HZ = 5.0
TEXT_BURST = 10
TEXTS_WAITING_MAX = 20

_CRITICAL, _WARNING, _NOTICE, _INFO = 2, 4, 5, 6
_SEVERITIES = {Severity.INFO: _INFO, Severity.WARNING: _WARNING, Severity.CRITICAL: _CRITICAL}
_OUTCOMES = {Outcome.COMPLETED: _NOTICE, Outcome.REFUSED: _WARNING, Outcome.ABORTED: _WARNING}

FLOAT32_MAX = 3.4e38
Text = tuple[int, str]


def event_text(event: Event) -> Text:
    """Return the text of an event, which starts with the action if there is one."""
    done = event.action.rank >= SafetyAction.HOLD.rank
    text = f"{event.action.value.replace('_', ' ').upper()}: {event.text}" if done else event.text
    return _SEVERITIES[event.severity], text


def phase_text(phase: str) -> Text:
    """Return the text for the start of a phase."""
    return _INFO, f"phase {phase}"


def outcome_text(outcome: Outcome) -> Text:
    """Return the text for the end of the flight."""
    return _OUTCOMES.get(outcome, _CRITICAL), f"flight {outcome.value}"


def values(inputs: Inputs, outputs: Outputs) -> dict[str, float]:
    """Return the known values by their names for NAMED_VALUE_FLOAT, of 10 characters at most.

    The tether's slack, the slack at the stopping position and the position error are in m, the angle between attitude and setpoint in
    deg, masses in kg, progress from 0 to 1; rho is that of the control law.
    """
    found = {"progress": outputs.progress}
    if (tether := outputs.tether) is not None:
        found["slack_m"], found["stop_slk_m"] = tether.slack_m, tether.stop_slack_m
    if (control := outputs.control) is not None:
        found["e_p_m"], found["rho"] = math.hypot(*control.error[0:3]), control.rho
        if control.payload_estimate_kg is not None:
            found["payload_kg"] = control.payload_estimate_kg
    if inputs.vehicle is not None and outputs.attitude is not None:
        pairs = zip(inputs.vehicle.attitude_wxyz, outputs.attitude.attitude_wxyz, strict=True)
        found["e_q_deg"] = math.degrees(2.0 * math.acos(min(1.0, abs(sum(a * b for a, b in pairs)))))
    return found


class Texts:
    """STATUSTEXTs at a rate for slow links: bursts of 10, then 5 per second, most severe first; dropped ones are counted."""

    def __init__(self) -> None:
        self._waiting: deque[Text] = deque()
        self._bucket = TokenBucket(TEXT_RATE_HZ, TEXT_BURST)
        self._left_out = 0
        self._number = 0

    def say(self, severity: int, text: str) -> None:
        """Queue a text. If the queue is full, drop the oldest of the least severe texts."""
        self._waiting.append((severity, text))
        if len(self._waiting) > TEXTS_WAITING_MAX:
            self._waiting.remove(max(self._waiting, key=lambda one: one[0]))
            self._left_out += 1

    def due(self, now_s: float) -> list[Any]:
        """Return the STATUSTEXT messages to send now."""
        messages: list[Any] = []
        while self._waiting and self._bucket.take(now_s):
            severity, text = min(self._waiting, key=lambda one: one[0])
            self._waiting.remove((severity, text))
            messages += self._chunks(severity, text)
        if self._left_out and not self._waiting and self._bucket.take(now_s):
            messages += self._chunks(_NOTICE, f"{self._left_out} messages dropped; see the log")
            self._left_out = 0
        return messages

    def _chunks(self, severity: int, text: str) -> list[Any]:
        """Return one message, or several with a common id other than 0; a text that fills its last chunk gets an empty one."""
        data = "".join(c if c.isascii() and c.isprintable() else "?" for c in " ".join(text.split())).encode()
        if len(data) > TEXT_MAX_BYTES:
            data = data[: TEXT_MAX_BYTES - 3] + b"..."
        if len(data) <= TEXT_BYTES:
            return [mavlink.MAVLink_statustext_message(severity, data)]
        self._number = self._number % 0xFFFF + 1
        parts = [data[at : at + TEXT_BYTES] for at in range(0, len(data), TEXT_BYTES)]
        if len(parts[-1]) == TEXT_BYTES:
            parts.append(b"")
        return [mavlink.MAVLink_statustext_message(severity, part, self._number, i) for i, part in enumerate(parts)]


def value_messages(time_boot_ms: int, named: Mapping[str, float]) -> list[Any]:
    """Return a NAMED_VALUE_FLOAT for each value that fits into 32 bits."""
    return [
        mavlink.MAVLink_named_value_float_message(time_boot_ms & 0xFFFFFFFF, name.encode(), value)
        for name, value in named.items()
        if abs(value) <= FLOAT32_MAX  # also false for NaN
    ]


def heartbeat_message() -> Any:
    """Return a HEARTBEAT of an onboard controller that is no autopilot, so that ground stations show no second vehicle."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
