"""The NatNet server's datagrams, read by the companion's parser, and the parser against everything else."""

from __future__ import annotations

import asyncio
import math
import socket
import struct
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.io.mocap import natnet
from companion.io.mocap.definitions import BodyDefinition, parse_model_definitions
from companion.io.mocap.frames import Frame, parse_frame
from companion.io.mocap.natnet import Malformed, Message
from companion.model.types import Quat
from sitl.natnet import CLOCK_FREQUENCY_HZ, BodyPose, NatNetServer, encode_frame, encode_model_definitions
from tests.io.natnet_bytes import LATER, VERSIONS, full_frame, numbers
from tests.support import DEADLINE_S

NAMES = {1: "quad", 5: "ball"}
TURNED: Quat = (0.5, -0.5, 0.5, 0.5)
POSES = (
    BodyPose(5, (4.0, 5.0, 6.0), (1.0, 0.0, 0.0, 0.0), valid=False, error_m=0.003),
    BodyPose(1, (-1.25, 0.5, 1.0), TURNED, error_m=0.00025),
)
versions = pytest.mark.parametrize("version", VERSIONS)


def frame_of(version: str, poses: Sequence[BodyPose] = POSES, exposure_t_s: float | None = 2.0) -> bytes:
    return encode_frame(version, 77, 2.005, poses, exposure_t_s, NAMES)


def parse(datagram: bytes, version: str, body_id: int = 1) -> Frame | Malformed:
    return parse_frame(datagram, numbers(version), body_id, CLOCK_FREQUENCY_HZ)


def good(result: Frame | Malformed) -> Frame:
    assert isinstance(result, Frame), result
    return result


@versions
def test_frame_round_trip(version: str) -> None:
    frame = good(parse(frame_of(version), version))
    assert frame.number == 77
    assert frame.timestamp_s == 2.005
    assert frame.latency_s == pytest.approx(0.005, abs=1e-6)
    assert frame.body_ids == (5, 1)
    assert frame.body is not None
    assert frame.body.id == 1
    assert frame.body.position_m == (-1.25, 0.5, 1.0)
    assert frame.body.quat_wxyz == TURNED
    assert frame.body.error_m == pytest.approx(0.00025)
    assert frame.body.tracking_valid


@versions
def test_other_body_untracked_and_missing_body(version: str) -> None:
    other = good(parse(frame_of(version), version, 5)).body
    assert other is not None
    assert other.position_m == (4.0, 5.0, 6.0)
    assert not other.tracking_valid
    missing = good(parse(frame_of(version), version, 9))
    assert missing.body is None
    assert missing.body_ids == (5, 1)
    assert good(parse(frame_of(version, ()), version)).body_ids == ()


@versions
def test_no_exposure_stamp_or_clock_means_no_latency(version: str) -> None:
    assert good(parse(frame_of(version, exposure_t_s=None), version)).latency_s is None
    assert good(parse_frame(frame_of(version), numbers(version), 1, None)).latency_s is None


def test_frame_of_the_other_version_is_rejected() -> None:
    for actual, assumed in (("3.0", "4.1"), ("4.1", "3.0")):
        result = parse(frame_of(actual), assumed)
        assert isinstance(result, Malformed) or result.body is None


@versions
@pytest.mark.parametrize("bad", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)])
def test_bad_quaternion(version: str, bad: Quat) -> None:
    assert isinstance(parse(frame_of(version, [BodyPose(1, (0.0, 0.0, 0.0), bad)]), version), Malformed)
    lost = good(parse(frame_of(version, [BodyPose(1, (0.0, 0.0, 0.0), bad, valid=False)]), version)).body
    assert lost is not None
    assert not lost.tracking_valid
    assert lost.quat_wxyz == (1.0, 0.0, 0.0, 0.0)


def test_position_that_is_not_finite() -> None:
    assert isinstance(parse(frame_of("4.1", [BodyPose(1, (math.inf, 0.0, 0.0), TURNED)]), "4.1"), Malformed)


@versions
def test_model_definitions(version: str) -> None:
    payload = encode_model_definitions(version, [(1, "quad"), (12, "Bälle")])
    found = parse_model_definitions(natnet.encode_message(Message.MODELDEF, payload), numbers(version))
    assert found == (BodyDefinition(1, "quad"), BodyDefinition(12, "Bälle"))


def test_numbers_follow_wrap_and_restart() -> None:
    assert natnet.is_newer(5, None, 0.0)
    assert natnet.is_newer(6, 5, 0.0)
    assert not natnet.is_newer(5, 5, 0.0)
    assert not natnet.is_newer(5, 5, 10.0)
    assert not natnet.is_newer(4, 5, 0.0)
    assert natnet.is_newer(0, 0xFFFFFFFF, 0.0)
    assert not natnet.is_newer(0xFFFFFFFF, 0, 0.0)
    assert natnet.is_newer(1, 50_000, 0.0)
    assert natnet.is_newer(1, 50, 0.6)


# -- fuzz ----------------------------------------------------------------------------------------------------------------------


def believable(result: Frame | Malformed) -> None:
    if isinstance(result, Frame) and result.body is not None:
        assert math.isclose(math.hypot(*result.body.quat_wxyz), 1.0, rel_tol=1e-9)
        assert all(map(math.isfinite, result.body.position_m))


@versions
def test_every_truncation_is_refused(version: str) -> None:
    for whole in (frame_of(version), full_frame(version)):
        for size in range(len(whole)):
            assert isinstance(parse(whole[:size], version), Malformed)
        tail = 2 + 4 + (8 if numbers(version) >= (4, 1) else 0)  # behind the last field that is read
        if version == LATER:  # what follows its rigid bodies is unknown
            continue
        for size in range(4, len(whole) - tail):
            honest = struct.pack("<HH", Message.FRAME, size - 4) + whole[4:size]
            assert isinstance(parse(honest, version), Malformed)


@given(
    version=st.sampled_from(VERSIONS),
    rich=st.booleans(),
    flips=st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 7)), min_size=1, max_size=12),
)
def test_flipped_bits(version: str, rich: bool, flips: list[tuple[int, int]]) -> None:
    datagram = bytearray(full_frame(version) if rich else frame_of(version))
    for position, bit in flips:
        datagram[position % len(datagram)] ^= 1 << bit
    believable(parse(bytes(datagram), version))


@given(version=st.sampled_from(VERSIONS), payload=st.binary(max_size=400), lead=st.integers(0, 200))
def test_random_payloads(version: str, payload: bytes, lead: int) -> None:
    believable(parse(payload, version))
    believable(parse(natnet.encode_message(Message.FRAME, frame_of(version)[4 : 4 + lead] + payload), version))
    for message, parser in (
        (Message.MODELDEF, lambda datagram: parse_model_definitions(datagram, numbers(version))),
        (Message.SERVER_INFO, natnet.parse_server_info),
    ):
        parser(payload)
        parser(natnet.encode_message(message, payload))
        parser(natnet.encode_message(message, encode_model_definitions(version, NAMES.items())[:lead] + payload))  # type: ignore[arg-type]


# -- the server on a socket ----------------------------------------------------------------------------------------------------


class Client:
    """A plain UDP client."""

    def __init__(self, server: NatNetServer) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._server = ("127.0.0.1", server.command_port)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._socket.getsockname()
        return host, port

    def send(self, datagram: bytes) -> None:
        self._socket.sendto(datagram, self._server)

    async def receive(self, expected: Message) -> bytes:
        datagram = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(self._socket, 65535), DEADLINE_S)
        assert natnet.message_id(datagram) == expected
        return datagram

    async def connect(self) -> bytes:
        """Connect and return the answer, which comes after those to everything sent before."""
        self.send(natnet.encode_connect())
        return await self.receive(Message.SERVER_INFO)


@versions
def test_server_answers(version: str) -> None:
    async def run() -> None:
        async with NatNetServer(version, bodies=[(1, "quad")]) as server:
            with Client(server) as client:
                info = natnet.parse_server_info(await client.connect())
                assert isinstance(info, natnet.ServerInfo)
                assert (info.application, info.version) == ("Motive", version)
                assert info.clock_frequency_hz == CLOCK_FREQUENCY_HZ
                assert (info.data_port, info.multicast) == (server.data_port, False)

                client.send(natnet.encode_request(Message.REQUEST_MODELDEF))
                definitions = parse_model_definitions(await client.receive(Message.MODELDEF), numbers(version))
                assert definitions == (BodyDefinition(1, "quad"),)

                server.publish(1.0, POSES, 0.99)
                assert good(parse(await client.receive(Message.FRAME), version)).body is not None

                client.send(natnet.encode_message(Message.DISCONNECT))
                client.send(natnet.encode_request(Message.REQUEST))
                await client.receive(Message.UNRECOGNIZED_REQUEST)  # answered after the datagram before it
                assert server.unicast_clients == ()

    asyncio.run(run())


def test_multicast_server_sends_unicast_to_keep_alive_only() -> None:
    async def run() -> None:
        async with NatNetServer("4.1", multicast_group="239.255.42.99") as server:
            with Client(server) as client:
                await client.connect()
                assert server.unicast_clients == ()
                client.send(natnet.encode_request(Message.KEEP_ALIVE))
                await client.connect()
                assert list(server.unicast_clients) == [client.address]

    asyncio.run(run())


def test_port_in_use_is_named() -> None:
    async def run() -> None:
        async with NatNetServer() as first:
            with pytest.raises(OSError, match=f"cannot bind UDP 127.0.0.1:{first.command_port}"):
                async with NatNetServer(command_port=first.command_port):
                    pass

    asyncio.run(run())
