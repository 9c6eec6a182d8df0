"""Packets on the channel from the flight process to the recorder. The guardian and the telemetry process also send `LogLine` on it."""

from __future__ import annotations

from companion.model.codec import Record, from_packet
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, OperatorCommand, SafetyAction, Severity


class Tick(Record, frozen=True, kw_only=True, tag=True):
    """One control tick."""

    number: int
    """Number of this packet, counted from 0 by the flight process; from gaps, the recorder learns how many packets were dropped."""
    inputs: Inputs
    outputs: Outputs
    sent: Sent


class LogLine(Record, frozen=True, kw_only=True, tag=True):
    """A line for the log's `/log` channel."""

    number: int | None = None
    """Number of this packet, as in `Tick`; None if another process sent it, because only the flight process counts packets."""
    t_s: float
    severity: Severity
    source: str
    text: str


class Metadata(Record, frozen=True, tag=True):
    """A metadata record of the log."""

    number: int
    name: str
    values: dict[str, str]


class CommandAnswer(Record, frozen=True, kw_only=True, tag=True):
    """Result of a command from the ground."""

    number: int
    nonce: str
    operator: str
    """Name of the operator who signed the command."""
    command: OperatorCommand
    accepted: bool
    """Whether the command took effect or the requested state had already been reached."""
    text: str
    """Effect of the command, or the reason why it was refused."""
    t_s: float
    """Flight clock of the tick that answered; `phase` and `action` are from that tick's `Outputs`."""
    phase: str
    action: SafetyAction


class Close(Record, frozen=True, tag=True):
    """Last packet of a flight that ends normally."""

    number: int
    """Number of packets that the flight process has sent or dropped before this one."""


Packet = Tick | LogLine | Metadata | CommandAnswer | Close


def read_packet(data: bytes) -> Packet:
    """Decode the bytes of `companion.model.codec.to_packet` into a packet.

    Raises:
        RecordError: the bytes are corrupt or are not a packet.
    """
    packet: Packet = from_packet(Packet, data)
    return packet
