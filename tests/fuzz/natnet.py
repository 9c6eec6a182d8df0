"""NatNet: datagrams through a real UDP socket into the client that the flight, the guardian and the tools share."""

from __future__ import annotations

import math
import select
import socket
import struct
from random import Random
from typing import ClassVar, Self

from companion.config.devices import MocapDevice
from companion.io.mocap import natnet
from companion.io.mocap.driver import settings_of
from companion.io.mocap.natnet import Message
from companion.io.mocap.optitrack import OptiTrack
from companion.io.px4.messages import vision_ned
from companion.model.types import MocapPose
from sitl.natnet import BodyPose, encode_frame, encode_model_definitions
from tests.fuzz.mutate import mutated
from tests.fuzz.target import Target, Wrong, one_line
from tests.io.natnet_bytes import LATER, all_definitions, full_frame, numbers
from tests.support import DEADLINE_S

VERSIONS = ("3.0", "4.1", "4.0", "4.2", LATER)
"""One version of each layout. Kept inputs name them by their place."""
_BODY_ID = 1
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_DATAGRAM_MAX_BYTES = 60_000
_FRESH = 0x80
"""Bit of an input's first byte: the client knows no server yet. The lower bits select the version."""


def _version(mode: int) -> str:
    return VERSIONS[(mode & ~_FRESH) % len(VERSIONS)]


class NatNetTarget(Target):
    """The first byte of an input is the version and the state of the client; the rest is the datagram."""

    name: ClassVar[str] = "natnet"

    def __init__(self) -> None:
        self._rigs: dict[str, _Rig] = {}
        self._corpus = {version: _corpus(version) for version in VERSIONS}

    def __enter__(self) -> Self:
        self._rigs = {version: _Rig(version) for version in VERSIONS}
        return self

    def __exit__(self, *_: object) -> None:
        for rig in self._rigs.values():
            rig.close()

    def make(self, rng: Random) -> bytes:
        mode = rng.randrange(len(VERSIONS)) | (_FRESH if rng.random() < 0.1 else 0)
        data = mutated(rng, self._corpus[_version(mode)], _DATAGRAM_MAX_BYTES)
        if len(data) >= 4 and rng.random() < 0.7:  # else the header's size gives most of them away
            data = data[:2] + struct.pack("<H", len(data) - 4) + data[4:]
        return bytes((mode,)) + data

    def feed(self, data: bytes) -> None:
        if data:
            self._rigs[_version(data[0])].feed(data[1:], fresh=bool(data[0] & _FRESH))


class _Rig:
    """Motive's client, and a socket in place of its server's."""

    def __init__(self, version: str) -> None:
        fields = {
            "server": "127.0.0.1",
            "interface": "127.0.0.1",
            "transport": "unicast",
            "rigid_body_id": _BODY_ID,
            "up_axis": "y" if version == "3.0" else "z",
            "ball": {"kind": "marker"},
            "bar_id": 7,
        }
        self.version, self.t_s = version, 0.0
        self.system = OptiTrack(settings_of(MocapDevice.model_validate(fields)))
        self.client, self.socket = self.system.protocol, self.system.sockets[0]
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sender.bind(("127.0.0.1", 0))
        self._send(_server_info(version))
        self._receive()
        self.info = self.client.info
        assert self.info is not None

    def close(self) -> None:
        self.system.close()
        self.sender.close()

    def feed(self, datagram: bytes, *, fresh: bool) -> None:
        if fresh:
            self.client.info = self.client.version = None
        self.t_s += 1.0
        self._send(datagram)
        self._receive()
        if fresh and (refusal := self.system.refusal()) is not None:
            one_line(refusal, "the refusal of a server")
        self._check_state()
        self._check_that_it_goes_on()

    def _check_state(self) -> None:
        markers = self.system.markers()
        for position_m in [] if markers is None else [one.position_world_m for one in markers.markers]:
            if not all(map(math.isfinite, position_m)):
                raise Wrong(f"a marker that is not finite: {markers}")
        for number, name in self.client.names.items():
            one_line(self.system._label(number), "the label of a rigid body")
            if len(name) > natnet.MAX_NAME_BYTES:
                raise Wrong(f"a name of {len(name)} characters")
        if self.system.problem is not None:
            one_line(self.system.problem, "the reason for a malformed datagram")

    def _check_that_it_goes_on(self) -> None:
        client = self.client
        client.info, client.version, client.names = self.info, numbers(self.version), {}
        self.t_s += 1.0  # as after the loss of some frames
        number = ((client._last_number or 0) + 1) & 0xFFFFFFFF
        x_m = float(number & 0x1FF)
        body = BodyPose(_BODY_ID, (x_m, 0.0, 0.0), _UPRIGHT)
        self._send(encode_frame(self.version, number, 1.0, [body], 0.99, {_BODY_ID: "b"}))
        poses = self._receive()
        if not poses or (poses[-1].frame_number, poses[-1].position_world_m[0]) != (number, x_m):
            raise Wrong(f"a valid frame behind it is not understood: {self.system.problem}, {self.system.counts()}")

    def _send(self, datagram: bytes) -> None:
        self.sender.sendto(datagram, self.socket.getsockname())

    def _receive(self) -> list[MocapPose]:
        """Return the poses of the datagram that was sent, after what the flight does with them."""
        if not select.select([self.socket], [], [], DEADLINE_S)[0]:
            raise TimeoutError("the datagram was not delivered")
        poses = self.system.poses(self.t_s)
        for pose in poses:
            vision_ned(pose)
            if not all(map(math.isfinite, (*pose.position_world_m, pose.marker_error_m, pose.latency_s or 0.0))):
                raise Wrong(f"a pose that is not finite: {pose}")
            if abs(math.hypot(*pose.attitude_wxyz) - 1.0) > 1e-9:
                raise Wrong(f"an attitude that is not of unit norm: {pose}")
        return poses


def _server_info(version: str) -> bytes:
    sender = struct.pack("<256s4s4s", b"Motive", bytes((3, 1, 0, 0)), bytes((*numbers(version), 0, 0)))
    connection = struct.pack("<QH?4s", 10_000_000, 1511, True, bytes((239, 255, 42, 99)))
    return natnet.encode_message(Message.SERVER_INFO, sender + connection)


def _corpus(version: str) -> list[bytes]:
    """Return every kind of datagram of a server and of a client."""
    names = {1: "quad", 7: "net"}
    bodies = [BodyPose(7, (3.0, 2.0, 0.1), (0.5, 0.5, 0.5, 0.5)), BodyPose(_BODY_ID, (1.0, -2.0, 1.5), _UPRIGHT)]
    lost = [BodyPose(_BODY_ID, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), valid=False)]
    crowd = [BodyPose(k, (float(k), 0.0, 0.0), _UPRIGHT) for k in range(40)]
    single = [(1.0, 2.0, 0.5), (0.5, 0.25, 1.0)]
    frames = [
        encode_frame(version, number, 12.5, poses, exposure_t_s, names, single)
        for number, poses, exposure_t_s in ((900, bodies, 12.49), (901, lost, None), (902, [], 1.0), (903, crowd, 12.4))
    ]
    definitions = encode_model_definitions(version, list(names.items()))
    server_info = _server_info(version)
    others = [
        natnet.encode_message(message, b"Bitstream,4.1\0") for message in Message if message is not Message.SERVER_INFO
    ]
    return [
        *frames * 4,
        full_frame(version),
        full_frame(version),
        full_frame(version, (b"unknown", b"another")),
        *[natnet.encode_message(Message.MODELDEF, definitions)] * 3,
        all_definitions(version),
        *[server_info] * 3,
        natnet.encode_message(Message.SERVER_INFO, server_info[4 : 4 + 264]),
        natnet.encode_connect(),
        b"",
        *others,
    ]
