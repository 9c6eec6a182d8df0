"""Measures the time from a motion-capture datagram to SET_ATTITUDE_TARGET, in bare loops on MAVSDK and pymavlink and in the driver."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from benchmarks.measuring.latency import DEADLINE_S, WARM_UP, Latency
from benchmarks.measuring.wires import autopilot_edge, bare_mavsdk, receive_and_send, with_far_end

_TYPE_MASK = 0b111
"""SET_ATTITUDE_TARGET.type_mask: body rates are ignored."""


def measure(frames: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all loops in turn; each result has `inside` and `wire`, or `not_measured`."""
    found: dict[str, Any] = {}
    for name, loop in (
        ("native", bare_mavsdk),
        ("edge", autopilot_edge),
        ("pymavlink", pymavlink_echo),
    ):
        say(name)
        try:
            inside, wire = loop(frames + WARM_UP)
        except (RuntimeError, OSError, ValueError) as error:
            found[name] = {"not_measured": " ".join(str(error).split()) or type(error).__name__}
        else:
            found[name] = {"inside": asdict(inside), "wire": asdict(wire)}
    return found


def pymavlink_echo(frames: int) -> tuple[Latency, Latency]:
    """Receive, pack SET_ATTITUDE_TARGET with pymavlink and send it, without a link or discovery."""
    from pymavlink.dialects.v20 import common as mavlink

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.bind(("127.0.0.1", port))
            wire.settimeout(DEADLINE_S)
            _, autopilot = wire.recvfrom(4096)  # its heartbeat
            out = mavlink.MAVLink(None, srcSystem=245, srcComponent=191)

            def send(thrust: float) -> None:
                message = out.set_attitude_target_encode(
                    0, 1, 1, _TYPE_MASK, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, thrust
                )
                wire.sendto(message.pack(out), autopilot)

            go()
            return receive_and_send(mocap, frames, send)

    return with_far_end(frames, run)
