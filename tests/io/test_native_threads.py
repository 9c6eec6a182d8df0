"""MAVSDK's threads keep their interpreter state from one callback to the next: real MAVSDK, real sockets."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from companion.io.px4 import inbox as autopilot_inbox
from tests.io.px4_peer import Px4Peer, free_udp_port
from tests.io.test_px4 import edge, eventually

pytestmark = pytest.mark.waits


@pytest.mark.parametrize("kept", [True, False])
def test_the_state_outlives_the_callback(monkeypatch: pytest.MonkeyPatch, kept: bool) -> None:
    """A thread-local value is lost with the interpreter state that it lives in."""
    if not kept:
        monkeypatch.setattr(autopilot_inbox, "keep_interpreter_state", lambda: None)

    async def run() -> list[int]:
        port = free_udp_port()
        own, counts = threading.local(), []

        def on_message(_: Any, __: Any) -> None:
            own.calls = getattr(own, "calls", 0) + 1
            counts.append(own.calls)

        with Px4Peer(port):
            async with edge(port) as autopilot:
                autopilot._direct.subscribe_message("HIGHRES_IMU", on_message)
                await eventually(lambda: len(counts) >= 40, "40 messages")
        return counts

    counts = asyncio.run(run())
    assert (max(counts) > 10) is kept
