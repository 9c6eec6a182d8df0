"""The NatNet client without sockets: which frames it accepts, what it makes of them, and what it sends when."""

from __future__ import annotations

import math
import random
import struct

import pytest

from companion.io.mocap import natnet
from companion.io.mocap.client import KEEP_ALIVE_PERIOD_S, RECONNECT_SILENCE_S, NatNetClient
from companion.io.mocap.natnet import Message
from companion.model.frames import quat_from_euler_zyx, quat_rotate
from companion.model.types import MocapPose, Quat, Vec3
from companion.safety.stream_watch import StreamWatch
from sitl.natnet import BodyPose, encode_frame

POSE = BodyPose(1, (-1.25, 0.5, 1.0), (0.5, -0.5, 0.5, 0.5), error_m=0.00025)
CONNECT = natnet.encode_connect("a test")
KEEP_ALIVE = natnet.encode_request(Message.KEEP_ALIVE)


def server_info(version: str = "4.1") -> bytes:
    number = bytes((int(version[0]), int(version[2]), 0, 0))
    return natnet.encode_message(Message.SERVER_INFO, struct.pack("<256s4s4s", b"Motive", bytes((3, 1, 0, 0)), number))


def client_of(transport: str = "unicast", up_axis: str = "z", version: str = "4.1") -> NatNetClient:
    """A client that the server has answered at 0 s."""
    client = NatNetClient(1, up_axis, transport, "a test")
    assert client.receive(server_info(version), 0.0) is None
    return client


def numbered(number: int, pose: BodyPose = POSE) -> bytes:
    return encode_frame("4.1", number, 1.0, [pose], None, {})


def accepted(client: NatNetClient, numbers: list[int]) -> list[int]:
    frames = [client.receive(numbered(number), k * 0.005) for k, number in enumerate(numbers)]
    return [frame.number for frame in frames if frame is not None]


def test_it_connects_until_the_server_answers_and_after_a_silence() -> None:
    client = NatNetClient(1, "z", "unicast", "a test")
    assert client.requests(0.0) == [CONNECT]
    client.receive(server_info(), 0.1)
    assert client.request_period_s == KEEP_ALIVE_PERIOD_S
    assert client.requests(0.6) == [KEEP_ALIVE]
    assert client.receive(numbered(1), 1.0) is not None
    assert client.requests(0.9 + RECONNECT_SILENCE_S) == [KEEP_ALIVE]
    assert client.requests(1.1 + RECONNECT_SILENCE_S) == [CONNECT, KEEP_ALIVE]
    assert client.farewell() == [natnet.encode_message(Message.DISCONNECT)]


def test_a_multicast_server_needs_no_keep_alive() -> None:
    client = client_of("multicast")
    assert client.requests(0.5) == client.farewell() == []


def test_frames_before_the_servers_answer_are_ignored() -> None:
    assert NatNetClient(1, "z", "unicast").receive(numbered(1), 0.0) is None


@pytest.mark.parametrize(
    ("first", "second", "problem"),
    [
        ("2.9", "2.9", "the server speaks NatNet 2.9, expected 3.0 or later"),
        ("4.1", "3.0", "the server was restarted with NatNet 3.0 instead of 4.1"),
    ],
)
def test_another_version_is_reported(first: str, second: str, problem: str) -> None:
    client = client_of(version=first)
    client.receive(server_info(second), 1.0)
    assert client.problem == problem


@pytest.mark.parametrize(
    ("numbers", "kept"),
    [
        ([100_000, 100_000, 99_998, 100_002], [100_000, 100_002]),
        ([100_000, 1, 2], [100_000, 1, 2]),
        ([0xFFFFFFFF, 0, 1], [0xFFFFFFFF, 0, 1]),
    ],
    ids=["repeated and late", "server restarted", "number wraps"],
)
def test_frames_are_accepted_in_order(numbers: list[int], kept: list[int]) -> None:
    client = client_of()
    assert accepted(client, numbers) == kept
    assert client.out_of_order == len(numbers) - len(kept) and client.problem is None


def test_reordered_and_duplicated_datagrams_displace_no_frame() -> None:
    """20 s at 240 Hz with 5 % of the frames up to three places late and 1 % twice: each late one is dropped, nothing else."""
    draw = random.Random(3)
    placed = [(k + (draw.randint(1, 3) + 0.5 if draw.random() < 0.05 else 0.0), k) for k in range(20 * 240)]
    placed += [(k + draw.randint(0, 3) + 0.6, k) for k in range(20 * 240) if draw.random() < 0.01]
    client, newest, in_order, taken = client_of(), -1, [], []
    for arrival, (_, k) in enumerate(sorted(placed)):
        body = BodyPose(1, (k * 1e-3, 0.0, 1.0), POSE.quat_wxyz)
        if client.receive(numbered(100_000 + k, body), arrival / 240) is not None:
            taken.append(k)
        if k > newest:
            newest = k
            in_order.append(k)
    assert taken == in_order
    assert not client.two_streams


@pytest.mark.parametrize("ahead", [0, 50, 1_000_000], ids=["the same numbers", "a little ahead", "far ahead"])
def test_a_second_stream_at_the_servers_address_does_not_displace_the_first_unseen(ahead: int) -> None:
    """What is delivered steps back again and again: `mocap_two_streams` is raised by that."""
    client, watch, forged = client_of(), StreamWatch(), BodyPose(1, (0.0, 0.5, 1.0), POSE.quat_wxyz)
    for k in range(200):
        t_s = k * 0.005
        for frame in (
            client.receive(numbered(100 + k), t_s),
            client.receive(numbered(100 + k + ahead, forged), t_s + 0.001),
        ):
            if frame is not None and watch.update(frame.number, frame.body, t_s):
                assert (
                    client.two_streams and client.problem is not None and "two servers at one address" in client.problem
                )
                return
    pytest.fail("two streams looked like one")


def test_malformed_datagrams_are_counted_and_the_next_frame_is_accepted() -> None:
    client = client_of()
    frame, info = struct.pack("<HH", Message.FRAME, 4), struct.pack("<HH", Message.SERVER_INFO, 4)
    for junk in (b"", b"\x07", bytes(2000), b"\xff" * 2000):  # no message of a server: not even counted
        assert client.receive(junk, 0.1) is None
    for malformed in (numbered(7)[:60], frame + b"\xff" * 4, info + b"\0" * 4):
        assert client.receive(malformed, 0.2) is None
    assert client.malformed == 3 and client.problem is not None
    assert client.receive(numbered(8), 0.3) is not None


def pose_of(body: BodyPose, up_axis: str = "z") -> MocapPose:
    client = client_of(up_axis=up_axis)
    frame = client.receive(numbered(1, body), 0.1)
    assert frame is not None
    pose = client.pose(frame, 5.0)
    assert pose is not None
    return pose


def test_an_untracked_body_is_a_pose_that_says_so() -> None:
    pose = pose_of(BodyPose(1, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), valid=False))
    assert (pose.tracking_valid, pose.stamp_s) == (False, 5.0)


def test_a_frame_without_the_body_is_no_pose() -> None:
    client = client_of()
    frame = client.receive(numbered(1, BodyPose(4, (3.0, 3.0, 0.0), (1.0, 0.0, 0.0, 0.0))), 0.1)
    assert frame is not None and client.pose(frame, 0.1) is None
    assert client.body_ids == (4,)
    other = client.other_body(numbered(1, BodyPose(4, (3.0, 3.0, 0.0), (1.0, 0.0, 0.0, 0.0))), 4)
    assert other is not None and other.position_m == (3.0, 3.0, 0.0)


@pytest.mark.parametrize("yaw_deg", [0, 45, 90, 180, -90])
def test_y_up_stream_at_compass_points(yaw_deg: int) -> None:
    yaw_rad = math.radians(yaw_deg)
    # Motive's own axes: y up, so z is to the right of x and a turn to the left is one about +y.
    y_up = BodyPose(1, (2.0, 1.5, -0.75), (math.cos(yaw_rad / 2), 0.0, math.sin(yaw_rad / 2), 0.0))
    pose = pose_of(y_up, up_axis="y")
    assert pose.position_world_m == (2.0, 0.75, 1.5)
    nose = quat_rotate(pose.attitude_wxyz, (1.0, 0.0, 0.0))
    left = quat_rotate(pose.attitude_wxyz, (0.0, 1.0, 0.0))
    assert nose == pytest.approx((math.cos(yaw_rad), math.sin(yaw_rad), 0.0), abs=1e-6)
    assert left == pytest.approx((-math.sin(yaw_rad), math.cos(yaw_rad), 0.0), abs=1e-6)


def test_y_up_turns_world_and_body_alike() -> None:
    quat: Quat = quat_from_euler_zyx(0.3, -0.5, 1.1)
    vector: Vec3 = (0.2, -0.7, 0.4)
    turned_vector, turned_quat = natnet.z_up_from_y_up(vector, quat)
    expected, _ = natnet.z_up_from_y_up(quat_rotate(quat, vector), quat)
    assert quat_rotate(turned_quat, turned_vector) == pytest.approx(expected)


# -- age -----------------------------------------------------------------------------------------------------------------------


SERVER_AHEAD_S = 5000.0
"""The server's clock less this computer's."""


def stamped_client() -> NatNetClient:
    """A client whose server stamps frames with a clock of 10 MHz."""
    client = NatNetClient(1, "z", "unicast")
    connection = struct.pack("<QH?4s", 10_000_000, 1511, False, bytes(4))
    client.receive(natnet.encode_message(Message.SERVER_INFO, server_info()[4:] + connection), 0.0)
    return client


def answer_echo(client: NatNetClient, sent_s: float, received_s: float) -> None:
    """Let the server receive the client's echo request at `received_s`; both times are this computer's."""
    (request,) = [r for r in client.requests(sent_s) if natnet.message_id(r) == Message.ECHO_REQUEST]
    ticks = round((received_s + SERVER_AHEAD_S) * 1e7)
    client.receive(natnet.encode_message(Message.ECHO_RESPONSE, request[4:] + struct.pack("<Q", ticks)), received_s)


def age_s(client: NatNetClient, number: int, exposure_s: float, sent_s: float, arrived_s: float) -> float | None:
    """Latency of the pose in a frame with these times of this computer."""
    origin_s = 1000.0  # that of the simulated server's ticks
    ahead_s = SERVER_AHEAD_S - origin_s
    frame = client.receive(encode_frame("4.1", number, sent_s + ahead_s, [POSE], exposure_s + ahead_s, {}), arrived_s)
    assert frame is not None
    pose = client.pose(frame, arrived_s)
    assert pose is not None
    return pose.latency_s


def test_the_age_of_a_pose_is_from_exposure_to_arrival() -> None:
    client = stamped_client()
    assert age_s(client, 1, 1.0, 1.004, 1.15) == pytest.approx(0.004), "no echo: what the server says"
    answer_echo(client, 2.0, 2.0002)
    assert age_s(client, 2, 2.5, 2.504, 2.65) == pytest.approx(0.1502)


@pytest.mark.parametrize("request_s", [0.0005, 0.1])
def test_a_slow_request_makes_no_pose_younger_and_a_fast_one_corrects_it(request_s: float) -> None:
    client = stamped_client()
    answer_echo(client, 2.0, 2.0 + request_s)
    assert age_s(client, 1, 2.5, 2.504, 2.51) == pytest.approx(0.01 + request_s)
    answer_echo(client, 3.0, 3.0)
    answer_echo(client, 3.5, 3.5 + request_s)
    assert age_s(client, 2, 4.0, 4.004, 4.01) == pytest.approx(0.01)


def test_an_answer_to_no_request_is_ignored() -> None:
    client = stamped_client()
    client.receive(natnet.encode_message(Message.ECHO_RESPONSE, struct.pack("<QQ", 77, 1)), 2.0)
    client.receive(natnet.encode_message(Message.ECHO_RESPONSE, b"short"), 2.0)
    assert client.malformed == 1
    assert age_s(client, 1, 2.5, 2.504, 2.65) == pytest.approx(0.004)


def test_a_clock_that_was_set_ahead_needs_a_new_echo() -> None:
    client = stamped_client()
    answer_echo(client, 2.0, 2.0)
    assert age_s(client, 1, 12.0, 12.004, 2.51) == pytest.approx(0.004), "sent 9.5 s after its arrival"
    assert age_s(client, 2, 2.6, 2.604, 2.75) == pytest.approx(0.004)
    answer_echo(client, 3.0, 3.0)
    assert age_s(client, 3, 3.6, 3.604, 3.75) == pytest.approx(0.15)


def test_without_answers_the_age_becomes_unknown() -> None:
    client = stamped_client()
    answer_echo(client, 2.0, 2.0)
    assert age_s(client, 1, 11.8, 11.804, 11.9) == pytest.approx(0.1)
    assert age_s(client, 2, 12.0, 12.004, 12.1) == pytest.approx(0.004)
