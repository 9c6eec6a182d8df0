"""The local channels between the launcher and the flight and guardian processes: short messages on SOCK_SEQPACKET pairs.

The flight process never waits for the launcher: if the channel is full, the message is lost. If the launcher has ended (end of file),
the flight process lands.
"""

from __future__ import annotations

import socket

from companion.model.codec import RecordError, from_packet, to_packet
from companion.model.launcher_messages import Message, Unreadable

MAX_MESSAGE_BYTES = 60_000


def send(channel: socket.socket, message: Message) -> bool:
    """Send without waiting; return False if the message was lost. In place of a message that is too long, send `Unreadable`."""
    packet = to_packet(message)
    if len(packet) > MAX_MESSAGE_BYTES:
        packet = to_packet(Unreadable(f"{type(message).__name__} of {len(packet)} bytes is too long"))
    try:
        channel.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
    except OSError:
        return False
    return True


def receive(channel: socket.socket) -> Message | None:
    """Return one message, `Unreadable` for a malformed one, or None if the peer has closed the channel."""
    try:
        packet = channel.recv(MAX_MESSAGE_BYTES + 1)
    except ConnectionResetError:  # said once, before what is still queued
        return receive(channel)
    if not packet:
        return None
    try:
        message: Message = from_packet(Message, packet)
    except RecordError as error:
        return Unreadable(str(error))
    return message
