"""The wires to PX4, each with a real peer."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import tty
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.link import Link
from companion.io.px4.wire import ROUND_DATAGRAMS, UdpWire, Wire, open_wire
from tests.support import DEADLINE_S, free_udp_port, wait_until
from tests.wires import serial_line


def heartbeat(system: int = 1, component: int = 1) -> bytes:
    encoder = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    packed: bytes = mavlink.MAVLink_heartbeat_message(2, 12, 209, 4 << 16 | 6 << 24, 4, 3).pack(encoder)
    return packed


def received(wire: Wire) -> list[bytes]:
    return [data for _, data in wire.receive()]


def wait_readable(wire: Wire) -> None:
    assert select.select([wire.fileno()], [], [], DEADLINE_S)[0]


@contextmanager
def opened(address: str, local_port: int = 0, peer: tuple[str, int] | None = None) -> Iterator[Wire]:
    wire = open_wire(address, local_port, peer)
    try:
        yield wire
    finally:
        wire.close()


@pytest.mark.parametrize(
    "data",
    [b"\xfd", b"no MAVLink", heartbeat()[:-1], heartbeat()[:-1] + b"\x00", heartbeat(255, 190), heartbeat(1, 154)],
    ids=["one byte", "text", "cut", "checksum", "ground station", "gimbal"],
)
def test_udpin_takes_only_the_sender_of_a_valid_heartbeat_for_px4(data: bytes) -> None:
    port = free_udp_port()
    with (
        opened(f"udpin://127.0.0.1:{port}") as wire,
        closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger,
        closing(socket.socket(type=socket.SOCK_DGRAM)) as px4,
    ):
        px4.settimeout(DEADLINE_S)
        assert not wire.send(b"lost")
        stranger.sendto(data, ("127.0.0.1", port))
        wait_readable(wire)
        assert received(wire) == []
        assert not wire.ready
        px4.sendto(heartbeat(), ("127.0.0.1", port))
        wait_readable(wire)
        assert received(wire) == [heartbeat()]
        assert wire.ready
        assert wire.send(b"heard")
        assert px4.recv(100) == b"heard"


def test_a_flood_from_px4s_own_address_is_read_in_parts() -> None:
    port = free_udp_port()
    with opened(f"udpin://127.0.0.1:{port}") as wire, closing(socket.socket(type=socket.SOCK_DGRAM)) as px4:
        sent = [heartbeat(), *(b"%d" % number for number in range(ROUND_DATAGRAMS + 20))]
        for data in sent:
            px4.sendto(data, ("127.0.0.1", port))
        wait_readable(wire)
        assert received(wire) == sent[:ROUND_DATAGRAMS]
        assert received(wire) == sent[ROUND_DATAGRAMS:]


@pytest.mark.parametrize("kind", ["udpin", "udpout"])
def test_only_the_address_that_the_flight_proved_is_heard(kind: str) -> None:
    with (
        closing(socket.socket(type=socket.SOCK_DGRAM)) as px4,
        closing(socket.socket(type=socket.SOCK_DGRAM)) as stranger,
    ):
        for one in (px4, stranger):
            one.bind(("127.0.0.1", 0))
        peer = px4.getsockname()
        port = free_udp_port()
        where = f"127.0.0.1:{port if kind == 'udpin' else peer[1]}"
        with opened(f"{kind}://{where}", port, peer) as wire:
            stranger.sendto(heartbeat(), ("127.0.0.1", port))
            px4.sendto(heartbeat(1, 1) + b"of PX4", ("127.0.0.1", port))
            wait_readable(wire)
            assert received(wire) == [heartbeat(1, 1) + b"of PX4"]


def test_px4_that_a_router_moved_to_another_port_is_heard_there(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """PX4 is accepted at another port only after 1 s of silence, from the same IP address and with the same system id."""
    sockets = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(4)]
    with contextlib.ExitStack() as stack:
        px4, moved, other_host, other_system = (stack.enter_context(closing(one)) for one in sockets)
        for one, host in ((px4, 1), (moved, 1), (other_host, 9), (other_system, 1)):
            one.bind((f"127.0.0.{host}", 0))
        port = free_udp_port()
        where = ("127.0.0.1", port)
        wire = stack.enter_context(opened(f"udpin://0.0.0.0:{port}", port, px4.getsockname()))
        link = Link(wire, (1, 195), 1)

        def from_all_but_px4() -> list[int]:
            other_host.sendto(heartbeat(), where)
            other_system.sendto(heartbeat(2), where)
            moved.sendto(heartbeat(), where)
            return [message.get_srcSystem() for message in link.receive()]

        px4.sendto(heartbeat(), where)
        wait_readable(wire)
        assert [message.get_srcSystem() for message in link.receive()] == [1]
        assert from_all_but_px4() == []
        monkeypatch.setattr("companion.io.px4.wire.REPIN_SILENCE_S", 0.05)
        wait_until(lambda: from_all_but_px4() == [1], lambda: "PX4 is not heard at its new port")
        moved.settimeout(DEADLINE_S)
        link.send_heartbeat()
        assert moved.recv(1000)
        assert [
            f"now sends from port {moved.getsockname()[1]}" in record.getMessage() for record in caplog.records
        ] == [True]


def test_udpin_is_not_to_be_had_while_the_flight_holds_it() -> None:
    with closing(socket.socket(type=socket.SOCK_DGRAM)) as flight:
        flight.bind(("127.0.0.1", 0))
        with pytest.raises(OSError, match="in use"):
            open_wire(f"udpin://127.0.0.1:{flight.getsockname()[1]}", 0)


def test_udpout_speaks_from_the_port_of_the_flight() -> None:
    with closing(socket.socket(type=socket.SOCK_DGRAM)) as px4:
        px4.settimeout(DEADLINE_S)
        px4.bind(("127.0.0.1", 0))
        port = free_udp_port()
        with opened(f"udpout://127.0.0.1:{px4.getsockname()[1]}", port) as wire:
            assert isinstance(wire, UdpWire) and wire.ready
            wire.send(b"hello")
            data, address = px4.recvfrom(100)
            assert (data, address) == (b"hello", ("127.0.0.1", port))


def test_a_serial_port_that_px4_does_not_drain_holds_nobody_up() -> None:
    """Flow control, or USB whose other end has stopped: pyserial would retry for ever."""
    with serial_line() as (_, port), opened(f"serial://{port}:57600") as wire:
        taken = 0
        while wire.send(heartbeat()):
            taken += 1
            assert taken < 100_000, "the line takes everything"
        assert taken > 0


def test_what_waits_in_a_serial_port_that_px4_does_not_read_is_dropped() -> None:
    """PX4 that restarts under flow control must not receive a request to arm that was withdrawn long ago."""
    with serial_line() as (px4, port), opened(f"serial://{port}:57600") as wire:
        assert wire.send(bytes(8192))  # the far end of a pseudo-terminal has 4 kB of its own
        assert wire.send(b"arm")
        while wire.send(heartbeat()):
            pass
        assert wire.send(heartbeat()) and b"arm" not in os.read(px4, 1_000_000)


def test_a_serial_port_that_another_process_holds_is_not_opened() -> None:
    with serial_line() as (_, port):
        with opened(f"serial://{port}:921600"), pytest.raises(OSError, match="exclusively"):
            open_wire(f"serial://{port}:921600", 0)
        with opened(f"serial://{port}:921600"):
            pass


def test_a_serial_port_that_hangs_up_is_lost() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    with opened(f"serial://{os.ttyname(slave)}:921600") as wire:
        os.close(slave)
        assert (wire.receive(), wire.lost) == ([], False)
        os.close(master)
        wait_readable(wire)
        assert (wire.receive(), wire.lost) == ([], True)
        assert not wire.send(b"into the void")


def test_a_tcp_connection_that_ends_is_lost() -> None:
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as server,
        opened(f"tcpout://127.0.0.1:{server.getsockname()[1]}") as wire,
    ):
        connection, _ = server.accept()
        assert (wire.receive(), wire.lost) == ([], False)
        connection.close()
        wait_readable(wire)
        assert (wire.receive(), wire.lost) == ([], True)
        wire.send(b"into the void")


def test_a_tcp_connection_that_delivers_nothing_is_lost_with_what_waits_in_it() -> None:
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        server.bind(("127.0.0.1", 0))
        server.listen()
        with opened(f"tcpout://127.0.0.1:{server.getsockname()[1]}") as wire:
            connection, _ = server.accept()
            with connection:

                def lost() -> bool:
                    while wire.send(heartbeat()):
                        pass
                    return wire.receive() == [] and wire.lost

                wait_until(lost, lambda: "the connection is not lost")


def test_no_message_on_a_tcp_connection_waits_for_the_answer_to_the_one_before() -> None:
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as server,
        opened(f"tcpout://127.0.0.1:{server.getsockname()[1]}") as wire,
        socket.socket(fileno=os.dup(wire.fileno())) as shared,
    ):
        assert shared.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
