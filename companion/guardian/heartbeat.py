"""Datagrams between the flight process and the guardian, on a SOCK_SEQPACKET pair. Pure.

Flight to guardian: a `Heartbeat` per control tick, and once `RECORDER_CHANNEL` with the descriptor of the recorder's channel
attached. Guardian to flight, ten times a second: `READY`, or `PROBLEM` followed by one line of text.
"""

from __future__ import annotations

import math
import socket
import struct
from dataclasses import dataclass

from companion.model.types import Vec3

HEARTBEAT, RECORDER_CHANNEL, READY, PROBLEM = b"B", b"A", b"R", b"P"
"""Datagram types, given by the first byte."""
READY_PERIOD_S = 0.1
HANG_TEXT = "the flight process hangs"
"""First words of the `guardian_took_over` text when the flight process hung; other texts mean that it died."""
MAX_BYTES = 1024

_LIFTING, _PILOT, _GOODBYE, _MOCAP_REFUSED = 1, 2, 4, 8
_BEAT = struct.Struct("<cBBBBH4sHIddddddd")
_NO_PEER = (bytes(4), 0)


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """State of one control tick that the guardian needs to take over."""

    tick: int
    t_s: float
    """Flight clock."""
    origin_s: float
    """`time.monotonic` at zero of the flight clock: the time base of the poses sent to PX4."""
    mission_t_s: float
    """Time since take-off was commanded, 0 before."""
    lifting: bool
    """The rotors turn, or may be about to."""
    pilot: bool
    """A pilot has taken over."""
    goodbye: bool
    """This is the last heartbeat: the flight ends normally."""
    mocap_refused: bool
    """The flight process rejects motion capture and lands without it: its poses must neither go to PX4 nor judge the landing."""
    autopilot_system: int
    """MAVLink system id of PX4."""
    own_system: int
    own_component: int
    """MAVLink system and component id of the companion."""
    local_port: int
    """UDP port that the companion sends from; 0 if it is unknown or the link is not UDP."""
    pose_stamp_s: float
    """Flight clock of the newest accepted motion-capture pose; -inf if there was none."""
    position_world_m: Vec3
    """Position of that pose."""
    peer: tuple[str, int] | None = None
    """IPv4 address and UDP port of PX4, confirmed by the flight process; None if the link is not UDP."""


def pack(heartbeat: Heartbeat) -> bytes:
    """Encode a heartbeat as a datagram."""
    flags = _LIFTING * heartbeat.lifting | _PILOT * heartbeat.pilot | _GOODBYE * heartbeat.goodbye
    flags |= _MOCAP_REFUSED * heartbeat.mocap_refused
    host, port = _NO_PEER if heartbeat.peer is None else (socket.inet_aton(heartbeat.peer[0]), heartbeat.peer[1])
    return _BEAT.pack(
        HEARTBEAT,
        flags,
        heartbeat.autopilot_system,
        heartbeat.own_system,
        heartbeat.own_component,
        heartbeat.local_port,
        host,
        port,
        heartbeat.tick & 0xFFFFFFFF,
        heartbeat.t_s,
        heartbeat.origin_s,
        heartbeat.mission_t_s,
        heartbeat.pose_stamp_s,
        *heartbeat.position_world_m,
    )


def unpack(datagram: bytes) -> Heartbeat | None:
    """Decode a heartbeat; None if the datagram is another one or holds a value that is not finite."""
    if len(datagram) != _BEAT.size or datagram[:1] != HEARTBEAT:
        return None
    _, flags, autopilot, system, component, local_port, host, port, tick, *times, x, y, z = _BEAT.unpack(datagram)
    t_s, origin_s, mission_t_s, pose_stamp_s = times
    if not all(map(math.isfinite, (t_s, origin_s, mission_t_s, x, y, z))) or math.isnan(pose_stamp_s):
        return None
    return Heartbeat(
        tick=tick,
        t_s=t_s,
        origin_s=origin_s,
        mission_t_s=mission_t_s,
        lifting=bool(flags & _LIFTING),
        pilot=bool(flags & _PILOT),
        goodbye=bool(flags & _GOODBYE),
        mocap_refused=bool(flags & _MOCAP_REFUSED),
        autopilot_system=autopilot,
        own_system=system,
        own_component=component,
        local_port=local_port,
        pose_stamp_s=pose_stamp_s,
        position_world_m=(x, y, z),
        peer=None if (host, port) == _NO_PEER else (socket.inet_ntoa(host), port),
    )
