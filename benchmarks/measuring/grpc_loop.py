"""The bare loop over MAVSDK 3, which uses a gRPC server. It runs in a separate environment, because MAVSDK 4 has the same name.

python -m benchmarks.measuring.grpc_loop PORT DESCRIPTOR FRAMES

Prints "ready" when it has found the autopilot on the port, then receives from the socket, and prints seconds per frame as JSON.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import time
from typing import Any

from benchmarks.measuring.latency import DEADLINE_S, WARM_UP
from benchmarks.measuring.wires import receive
from companion.io.arrival import stamp_arrivals
from companion.runtime.realtime import FLIGHT_PRIORITY, claim_realtime


async def loop(port: int, mocap: socket.socket, frames: int) -> list[float]:
    """Run the loop of `receive_and_send` with asyncio, as MAVSDK 3 requires."""
    from mavsdk import System
    from mavsdk.offboard import Attitude

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        server_port = probe.getsockname()[1]
    system: Any = System(port=server_port)
    async with asyncio.timeout(DEADLINE_S):
        await system.connect(f"udpin://127.0.0.1:{port}")
        async for state in system.core.connection_state():
            if state.is_connected:
                break
    mocap.setblocking(False)
    stamp_arrivals(mocap)
    readable = asyncio.Event()
    asyncio.get_running_loop().add_reader(mocap, readable.set)
    claim_realtime(FLIGHT_PRIORITY)
    _claim_for(system._server_process.pid)
    print("ready", flush=True)
    taken_s: list[float] = []
    while len(taken_s) < frames:
        try:
            thrust, came_s = receive(mocap)
        except BlockingIOError:
            readable.clear()
            async with asyncio.timeout(DEADLINE_S):
                await readable.wait()
            continue
        await system.offboard.set_attitude(Attitude(1.0, 2.0, 3.0, thrust))
        taken_s.append(time.monotonic() - came_s)
    return taken_s[WARM_UP:]


def _claim_for(server_pid: int) -> None:
    """Claim the same priority for MAVSDK's server if permitted."""
    with contextlib.suppress(OSError):
        for thread in map(int, os.listdir(f"/proc/{server_pid}/task")):
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(FLIGHT_PRIORITY))


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # MAVSDK ends its server on exit
    with socket.socket(fileno=int(sys.argv[2])) as mocap:
        print(json.dumps(asyncio.run(loop(int(sys.argv[1]), mocap, int(sys.argv[3])))), flush=True)


if __name__ == "__main__":
    main()
