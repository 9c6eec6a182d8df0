"""What flight process and guardian tell each other, as bytes: datagrams on a SOCK_SEQPACKET pair. Pure.

Flight to guardian: a `Beat` per control tick, and once the recorder's channel (`ADOPT`, a descriptor rides along). Guardian to
flight: `READY`, or `PROBLEM` and a line for people, ten times a second.
"""

from __future__ import annotations

import math
import socket
import struct
from dataclasses import dataclass

from companion.model.types import Vec3

BEAT, ADOPT, READY, PROBLEM = b"B", b"A", b"R", b"P"
"""First byte of a datagram."""
READY_PERIOD_S = 0.1
HANGS = "the flight process hangs"
"""How the text of `guardian_took_over` begins when it did not die by itself."""
MAX_BYTES = 1024

_LIFTING, _PILOT, _GOODBYE, _MOCAP_REFUSED = 1, 2, 4, 8
_BEAT = struct.Struct("<cBBBBH4sHIddddddd")
_NO_PEER = (bytes(4), 0)


@dataclass(frozen=True, slots=True)
class Beat:
    """One control tick, as far as the guardian must know it."""

    tick: int
    t_s: float
    """On the flight clock."""
    origin_s: float
    """`time.monotonic` at zero of the flight clock: the time base of the poses that go to PX4."""
    mission_t_s: float
    """Seconds since take-off was commanded; 0 before."""
    lifting: bool
    """The rotors turn, or may."""
    pilot: bool
    """A pilot took over."""
    goodbye: bool
    """The last one: the flight ends as it should."""
    mocap_refused: bool
    """The flight process does not believe motion capture and lands for that: its poses are neither for PX4 nor to judge by."""
    autopilot_system: int
    """MAVLink system id of PX4."""
    own_system: int
    own_component: int
    """MAVLink ids that the companion speaks with."""
    local_port: int
    """UDP port that the companion speaks from; 0: not known, or no UDP."""
    pose_stamp_s: float
    """Of the last motion-capture pose with the body in view that was believed, on the flight clock; -inf: none yet."""
    position_world_m: Vec3
    """Of that pose."""
    peer: tuple[str, int] | None = None
    """IPv4 address and UDP port of PX4, proved by the flight process; None: not UDP."""


def pack(beat: Beat) -> bytes:
    """A beat as a datagram."""
    flags = _LIFTING * beat.lifting | _PILOT * beat.pilot | _GOODBYE * beat.goodbye
    flags |= _MOCAP_REFUSED * beat.mocap_refused
    host, port = _NO_PEER if beat.peer is None else (socket.inet_aton(beat.peer[0]), beat.peer[1])
    return _BEAT.pack(
        BEAT,
        flags,
        beat.autopilot_system,
        beat.own_system,
        beat.own_component,
        beat.local_port,
        host,
        port,
        beat.tick & 0xFFFFFFFF,
        beat.t_s,
        beat.origin_s,
        beat.mission_t_s,
        beat.pose_stamp_s,
        *beat.position_world_m,
    )


def unpack(datagram: bytes) -> Beat | None:
    """The beat in a datagram; None if it is none, or not a sane one."""
    if len(datagram) != _BEAT.size or datagram[:1] != BEAT:
        return None
    _, flags, autopilot, system, component, local_port, host, port, tick, *times, x, y, z = _BEAT.unpack(datagram)
    t_s, origin_s, mission_t_s, pose_stamp_s = times
    if not all(map(math.isfinite, (t_s, origin_s, mission_t_s, x, y, z))) or math.isnan(pose_stamp_s):
        return None
    return Beat(
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
