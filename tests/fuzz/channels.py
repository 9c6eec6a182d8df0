"""Channels between the companion's processes: the guardian's heartbeat, and messages from recorder to flight process."""

from __future__ import annotations

import math
import socket
from random import Random
from typing import ClassVar, Self

from companion.guardian import heartbeat
from companion.guardian.heartbeat import Heartbeat
from companion.model.types import OperatorCommand
from companion.recorder.client import RecorderClient
from tests.analysis.synthetic_flight import synthetic_flight
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, one_line

_SIZE_MAX_BYTES = 4000
_TICK = next(iter(synthetic_flight()))
_BEAT = Heartbeat(
    tick=7, t_s=1.5, origin_s=100.0, mission_t_s=0.5, lifting=True, pilot=False, goodbye=False, mocap_refused=False,
    autopilot_system=1, own_system=1, own_component=191, local_port=14540, pose_stamp_s=1.49, position_world_m=(1.0, 2.0, 3.0),
    back_world_m=(-0.3, 0.0, 0.0),
)  # fmt: skip


class ChannelsTarget(Target):
    """The first byte of an input is 0 for a heartbeat or 1 for a recorder message; the rest is the datagram."""

    name: ClassVar[str] = "channels"

    def __init__(self) -> None:
        self._beats = [
            heartbeat.pack(_BEAT),
            heartbeat.READY,
            heartbeat.PROBLEM + b"no mocap",
            heartbeat.RECORDER_CHANNEL,
        ]
        self._tidings = [
            b'{"error": "recorder: log.mcap: No space left on device"}',
            b'{"samples": 1}',
            b'{"command": "hold", "operator": "anna", "nonce": "0123456789abcdef", "hold": 1}',
            b'{"ground": "connected to mqtt://127.0.0.1:1883"}',
            b"[1]",
            b"null",
        ]

    def __enter__(self) -> Self:
        ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._client = RecorderClient(ours)
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()
        self._theirs.close()

    def make(self, rng: Random) -> bytes:
        kind = rng.randrange(2)
        return bytes((kind,)) + mutated(rng, (self._beats, self._tidings)[kind], _SIZE_MAX_BYTES)

    def feed(self, data: bytes) -> None:
        if data[:1] == b"\0":
            beat = heartbeat.unpack(data[1:])
            if beat is not None and not all(map(math.isfinite, (beat.t_s, beat.origin_s, *beat.position_world_m))):
                raise Wrong(f"a beat that is not finite: {beat}")
            if heartbeat.unpack(heartbeat.pack(_BEAT)) != _BEAT:
                raise Wrong("a valid beat behind it is not understood")
        elif len(data) > 1:
            self._hear(data[1:])
            self._client.take_commands()
            self._client.error = None
            self._hear(b'{"error": "disk full"}')
            one_line(self._client.error or "", "the recorder's word")
            self._hear(b'{"command": "land", "operator": "anna", "nonce": "00", "hold": 0, "t_s": 1.5}')
            if [asked.command for asked in self._client.take_commands()] != [OperatorCommand.LAND]:
                raise Wrong("a valid command behind it is not heard")

    def _hear(self, data: bytes) -> None:
        """Send a recorder message; the flight reads it in its next tick."""
        self._theirs.send(data)
        self._client.record(*_TICK)
        self._theirs.recv(2**20)
