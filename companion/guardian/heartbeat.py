"""Datagrams between the flight process and the guardian, on a SOCK_SEQPACKET pair. Pure.

Flight to guardian: a `Heartbeat` per control tick, and once `RECORDER_CHANNEL` with the descriptor of the recorder's channel
attached. Guardian to flight, ten times a second: `READY`, or `PROBLEM` followed by one line of text.
"""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import Meta

from companion.model.codec import Record, RecordError, from_packet, to_packet
from companion.model.types import IDENTITY_QUAT, Quat, Vec3

HEARTBEAT, RECORDER_CHANNEL, READY, PROBLEM = b"B", b"A", b"R", b"P"
"""Datagram types, given by the first byte."""
READY_PERIOD_S = 0.1
MAX_BYTES = 1024

_Byte = Annotated[int, Meta(ge=0, le=255)]
_Port = Annotated[int, Meta(ge=0, le=65535)]
_Ipv4 = Annotated[str, Meta(pattern=r"^\d{1,3}(\.\d{1,3}){3}$")]


class Heartbeat(Record, frozen=True, kw_only=True):
    """State that the guardian needs to take over, sent in each control tick."""

    tick: int
    t_s: float
    """Flight clock."""
    origin_s: float
    """`companion.runtime.clock.monotonic` when the flight clock was zero: the time base of the poses sent to PX4."""
    mission_t_s: float
    """Time since take-off was commanded; 0 before that."""
    lifting: bool
    """The rotors are turning or may be about to turn; in the last heartbeat: PX4 may be armed."""
    pilot: bool
    """A pilot has taken over."""
    goodbye: bool
    """This is the last heartbeat: the flight has ended."""
    mocap_refused: bool
    """The flight process rejects motion capture and lands without it: poses must neither be sent to PX4 nor confirm the landing."""
    autopilot_system: _Byte
    """MAVLink system id of PX4."""
    own_system: _Byte
    own_component: _Byte
    """MAVLink system and component id of the companion."""
    local_port: _Port
    """UDP port that the companion sends from; 0 if it is unknown or the link is not UDP."""
    pose_stamp_s: float
    """Flight clock of the newest accepted motion-capture pose; -inf if there was none."""
    position_world_m: Vec3
    """Position of the newest accepted pose."""
    attitude_wxyz: Quat = IDENTITY_QUAT
    """Attitude of the newest accepted pose."""
    peer: tuple[_Ipv4, _Port] | None = None
    """IPv4 address and UDP port of PX4, confirmed by the flight process; None if the link is not UDP."""
    partner_session: Annotated[int, Meta(ge=0)] = 0
    """Session of the other vehicle of a team (`companion.io.team_link`); 0 for a vehicle that flies alone."""
    back_world_m: Vec3 | None = None
    """The way back from a surface that the tool touches or approaches, before a landing; None if there is none."""


def pack(heartbeat: Heartbeat) -> bytes:
    """Encode a heartbeat as a datagram."""
    return HEARTBEAT + to_packet(heartbeat)


def unpack(datagram: bytes) -> Heartbeat | None:
    """Decode a heartbeat; None if the datagram is not a heartbeat, is malformed, or contains a non-finite or out-of-range value."""
    if datagram[:1] != HEARTBEAT:
        return None
    try:
        heartbeat: Heartbeat = from_packet(Heartbeat, datagram[1:])
    except RecordError:
        return None
    times = heartbeat.t_s, heartbeat.origin_s, heartbeat.mission_t_s
    finite = all(
        map(
            math.isfinite,
            (*times, *heartbeat.position_world_m, *heartbeat.attitude_wxyz, *(heartbeat.back_world_m or ())),
        )
    )
    return heartbeat if finite and not math.isnan(heartbeat.pose_stamp_s) else None
