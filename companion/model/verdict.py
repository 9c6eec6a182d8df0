"""The verdict on an operator's command, which `FlightCore.step` publishes."""

from __future__ import annotations

from enum import Enum

from companion.model.codec import Record


class Answer(Enum):
    """What becomes of a command."""

    TAKING_OFF = "taking_off"
    ALREADY_TAKING_OFF = "already_taking_off"
    WAITS_FOR_START = "waits_for_start"
    CANCELLED = "cancelled"
    CANCELLED_WHILE_ARMING = "cancelled_while_arming"
    SPOOLING_DOWN = "spooling_down"
    HOLDING = "holding"
    ALREADY_HOLDING = "already_holding"
    TOO_LOW_TO_HOLD = "too_low_to_hold"
    CONTINUING = "continuing"
    CONTINUING_TOGETHER = "continuing_together"
    LANDING_CONTINUES = "landing_continues"
    LANDING = "landing"
    ABORTED = "aborted"
    ALREADY_LANDING = "already_landing"
    RECORDED = "recorded"
    ALREADY_DOWN = "already_down"

    PILOT_FLIES = "pilot_flies"
    FLIGHT_IS_OVER = "flight_is_over"
    PX4_LANDS = "px4_lands"
    RETURNS = "returns"
    LANDS = "lands"
    ON_THE_GROUND = "on_the_ground"
    NOT_HOLDING = "not_holding"
    RULE_HOLDS = "rule_holds"
    NOT_READY = "not_ready"
    START_CANCELLED = "start_cancelled"
    IN_THE_AIR = "in_the_air"


class Verdict(Record, frozen=True, kw_only=True):
    """The verdict on a command."""

    accepted: bool
    """The command is carried out, or what it asks for is so already."""
    answer: Answer
    reason: str | None = None
    """With RULE_HOLDS the message of the rule, with NOT_READY what is missing."""
