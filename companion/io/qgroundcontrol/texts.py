"""What the companion itself says to a MAVLink ground station: STATUSTEXT and NAMED_VALUE_FLOAT. Pure: no socket, no clock.

It speaks as component 191 (MAV_COMP_ID_ONBOARD_COMPUTER) of the vehicle, and to the ground alone: PX4 never hears it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.io.qgroundcontrol.frames import Bucket
from companion.model.types import Event, Inputs, Outcome, Outputs, SafetyAction, Severity

COMPONENT = int(mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
TEXT_BYTES = 50
"""Of STATUSTEXT.text."""
TEXT_MAX_BYTES = 4 * TEXT_BYTES
TEXT_RATE_HZ = 5.0
TEXT_BURST = 10
TEXTS_WAITING_MAX = 20
VALUE_NAMES = ("slack_m", "stop_slk_m", "e_p_m", "e_q_deg", "rho", "payload_kg", "progress")
"""NAMED_VALUE_FLOAT.name, 10 characters at most."""

_EMERGENCY, _CRITICAL, _WARNING, _NOTICE, _INFO = 0, 2, 4, 5, 6
_SEVERITIES = {Severity.INFO: _INFO, Severity.WARNING: _WARNING, Severity.CRITICAL: _CRITICAL}
_OUTCOMES = {Outcome.COMPLETED: _NOTICE, Outcome.REFUSED: _WARNING, Outcome.ABORTED: _WARNING}

FLOAT32_MAX = 3.4e38
Text = tuple[int, str]
"""MAV_SEVERITY and the words."""


def event_text(event: Event) -> Text:
    """An event for people who look at the sky: what is done first, if anything is."""
    done = event.action.rank >= SafetyAction.HOLD.rank
    text = f"{event.action.value.replace('_', ' ').upper()}: {event.text}" if done else event.text
    return _SEVERITIES[event.severity], text


def phase_text(phase: str) -> Text:
    """A phase that has begun."""
    return _INFO, f"phase {phase}"


def outcome_text(outcome: Outcome) -> Text:
    """The end of the flight."""
    return _OUTCOMES.get(outcome, _CRITICAL), f"flight {outcome.value}"


def values(inputs: Inputs, outputs: Outputs) -> dict[str, float]:
    """By `VALUE_NAMES`; what is not known is left out.

    Metres for the tether's slack, the slack where the vehicle could stop, and the position error; degrees for the angle between
    attitude and setpoint; kg; rho of the control law; progress 0 to 1.
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
    """STATUSTEXTs, few enough for a slow link: 10 at once, then 5 a second, the gravest first; what is too much is counted and said."""

    def __init__(self) -> None:
        self._waiting: deque[Text] = deque()
        self._bucket = Bucket(TEXT_RATE_HZ, TEXT_BURST)
        self._left_out = 0
        self._number = 0

    def say(self, severity: int, text: str) -> None:
        """Put one in line; when the line is full the least grave one leaves it, the oldest of those."""
        self._waiting.append((severity, text))
        if len(self._waiting) > TEXTS_WAITING_MAX:
            self._waiting.remove(max(self._waiting, key=lambda one: one[0]))
            self._left_out += 1

    def due(self, now_s: float) -> list[Any]:
        """STATUSTEXT messages to send now."""
        messages: list[Any] = []
        while self._waiting and self._bucket.take(now_s):
            severity, text = min(self._waiting, key=lambda one: one[0])
            self._waiting.remove((severity, text))
            messages += self._chunks(severity, text)
        if self._left_out and not self._waiting and self._bucket.take(now_s):
            messages += self._chunks(_NOTICE, f"{self._left_out} messages left out, see the log")
            self._left_out = 0
        return messages

    def _chunks(self, severity: int, text: str) -> list[Any]:
        """One message, or several with a common id that is not 0; one that fills its last chunk is ended by an empty one."""
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
    """NAMED_VALUE_FLOAT of each; what is no number of 32 bits is left out."""
    return [
        mavlink.MAVLink_named_value_float_message(time_boot_ms & 0xFFFFFFFF, name.encode(), value)
        for name, value in named.items()
        if abs(value) <= FLOAT32_MAX  # not for NaN either
    ]


def heartbeat_message() -> Any:
    """MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID, MAV_STATE_ACTIVE: no ground station makes a vehicle of its own of it."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
    )
