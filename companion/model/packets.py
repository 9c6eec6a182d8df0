"""Packets on the channel from the flight process to the recorder. The guardian and the telemetry send `LogLine` on it as well."""

from __future__ import annotations

from companion.model.codec import Record, from_packet
from companion.model.types import Inputs, OperatorCommand, Outputs, SafetyAction, Sent, Severity


class Tick(Record, frozen=True, kw_only=True, tag=True):
    """One control tick."""

    number: int
    """Of this packet, counted by the flight process from 0: a gap tells the recorder how many packets were dropped."""
    inputs: Inputs
    outputs: Outputs
    sent: Sent


class LogLine(Record, frozen=True, kw_only=True, tag=True):
    """A line for the log's `/log` channel."""

    number: int | None = None
    """As in `Tick`; None from a process other than the flight process, which counts nothing."""
    t_s: float
    """Flight clock."""
    severity: Severity
    source: str
    text: str


class Metadata(Record, frozen=True, tag=True):
    """A metadata record of the log."""

    number: int
    name: str
    values: dict[str, str]


class CommandAnswer(Record, frozen=True, kw_only=True, tag=True):
    """What became of a command from the ground."""

    number: int
    nonce: str
    """Of the command, and its operator's name."""
    operator: str
    command: OperatorCommand
    accepted: bool
    """It took effect, or what it asks for is done already."""
    text: str
    """What was done, or why nothing was."""
    t_s: float
    """Flight clock of the tick that judged it; phase and action are those of that tick's `Outputs`."""
    phase: str
    action: SafetyAction


class Close(Record, frozen=True, tag=True):
    """The last packet of a flight that ends in order."""

    number: int
    """How many packets the flight process has offered before this one."""


Packet = Tick | LogLine | Metadata | CommandAnswer | Close


def read_packet(data: bytes) -> Packet:
    """Return the packet that `companion.model.codec.to_packet` made the bytes of.

    Raises:
        RecordError: the bytes are damaged or hold something else.
    """
    packet: Packet = from_packet(Packet, data)
    return packet
