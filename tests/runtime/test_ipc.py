"""The channels between the launcher and its processes, on real sockets."""

from __future__ import annotations

import socket

from companion.model.codec import to_packet
from companion.model.launcher_messages import Land, Message, Px4Text, Unreadable
from companion.runtime import ipc


def test_a_message_arrives_and_one_that_cannot_says_so() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def heard(message: Message) -> Message | None:
        assert ipc.send(theirs, message)
        return ipc.receive(ours)

    with ours, theirs:
        assert heard(Land()) == Land()
        longest = "x" * (ipc.MAX_MESSAGE_BYTES - 100)
        assert heard(Px4Text(longest)) == Px4Text(longest)
        too_long = Px4Text("x" * ipc.MAX_MESSAGE_BYTES)
        assert heard(too_long) == Unreadable(f"Px4Text of {len(to_packet(too_long))} bytes is too long")
        theirs.send(b"\xc1 no message")
        assert isinstance(ipc.receive(ours), Unreadable)
        theirs.close()
        assert ipc.receive(ours) is None


def test_the_last_message_of_an_ended_process_is_received_even_if_it_left_messages_unread() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        with theirs:
            assert ipc.send(ours, Land())
            assert ipc.send(theirs, Px4Text("last"))
        assert [ipc.receive(ours), ipc.receive(ours)] == [Px4Text("last"), None]
