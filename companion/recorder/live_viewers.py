"""The Foxglove server: viewers see the channels of the log while the vehicle flies.

The server and the log are two sinks of one context: a viewer message is built once for both. Of ``/inputs``, ``/outputs`` and
``/sent`` the log takes every tick; viewers get them at 20 Hz, on channels of their own with the same topics.

The server's threads are foxglove-sdk's own. A message only enters the queue of each viewer, which drops its oldest message when it is
full, so a slow or dead viewer delays nothing. Viewers can send nothing: the server has no capabilities.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from companion.recorder.viewer_channels import due

PERIOD_S = 0.05
_BACKLOG_MESSAGES = 256
"""Messages that wait for one viewer: about a second of flight."""
_LIVE = "live"
"""Metadata key of the channels that are for viewers only."""


class LiveViewers:
    """A running server, and the channels that the log does not hold.

    Args:
        context: the context of the log's channels.
        address: host and port of this computer.
        records: the log's channels of the records, which hold every tick.
        on_viewer: called when a viewer subscribes to `/scene_static`, from a thread of the server; must not wait.

    Raises:
        RuntimeError: the port is in use, or the host is not an address of this computer.
    """

    def __init__(
        self,
        context: foxglove.Context,
        address: tuple[str, int],
        records: Sequence[foxglove.Channel],
        on_viewer: Callable[[], None],
    ) -> None:
        host, port = address
        topics = {record.topic() for record in records}
        # Any program that reaches the port could otherwise fill flight.log: each malformed message is an error there.
        logging.getLogger("foxglove").setLevel(logging.CRITICAL)
        self._server = foxglove.start_server(
            name="companion",
            host=host,
            port=port,
            context=context,
            server_listener=_Listener(on_viewer),
            channel_filter=lambda channel: _LIVE in channel.metadata or channel.topic not in topics,
            message_backlog_size=_BACKLOG_MESSAGES,
        )
        self._channels = [
            foxglove.Channel(
                record.topic(),
                schema=record.schema(),
                message_encoding=record.message_encoding,
                context=context,
                metadata={_LIVE: f"{1.0 / PERIOD_S:g} Hz"},
            )
            for record in records
        ]
        self._sent_s = -math.inf

    def tick(self, t_s: float, stamp_ns: int, texts: Sequence[bytes]) -> None:
        """Send the records of a tick if they are due.

        Args:
            t_s: flight clock; after a step back the records are due.
            stamp_ns: wall clock of the tick.
            texts: the records as JSON, in the order of their channels.
        """
        if not due(t_s, self._sent_s, PERIOD_S):
            return
        self._sent_s = t_s
        for channel, text in zip(self._channels, texts, strict=True):
            channel.log(text, log_time=stamp_ns)

    def stop(self, within_s: float) -> bool:
        """Send what waits and close the server within `within_s`; return whether it is closed, which a stuck viewer prevents."""
        closing = threading.Thread(target=self._server.stop, name="viewers", daemon=True)
        closing.start()
        closing.join(within_s)
        return not closing.is_alive()


def in_log(channel: foxglove.ChannelDescriptor) -> bool:
    """Whether the log takes a channel, which it does unless the channel is for viewers only."""
    return _LIVE not in channel.metadata


class _Listener(ServerListener):  # type: ignore[misc]  # foxglove-sdk is untyped for mypy
    def __init__(self, on_viewer: Callable[[], None]) -> None:
        self._on_viewer = on_viewer

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        if channel.topic == "/scene_static":
            self._on_viewer()
