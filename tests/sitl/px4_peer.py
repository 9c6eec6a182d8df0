"""The other end of PX4's simulator link, on a real TCP socket: connects, and answers every HIL_SENSOR as PX4 does in lockstep.

As a program (`python px4_peer.py -i N -d ETC -s SCRIPT`) it stands where the px4 binary stands: it ends on SIGTERM.
"""

from __future__ import annotations

import argparse
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

ARMED = int(mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
Answer = Callable[[Any], list[float] | None]
"""Return controls for one HIL_SENSOR, or None for no answer."""


class LockstepPeer:
    """The peer runs in a thread, so that the simulator under test can wait for it."""

    def __init__(self, port: int, answer: Answer, mode: int = ARMED) -> None:
        self.sensors: list[Any] = []
        self._answer = answer
        self._mode = mode
        self._codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._codec.robust_parsing = True
        self._socket = socket.create_connection(("127.0.0.1", port), 10.0)
        self._socket.setblocking(False)
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="px4-peer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._wake.close()
        self._thread.join(10.0)
        self._woken.close()
        self._socket.close()

    def _run(self) -> None:
        while True:
            readable, _, _ = select.select([self._socket, self._woken], [], [])
            if self._woken in readable:
                return
            try:
                data = self._socket.recv(65536)
            except ConnectionError:
                return
            if not data:
                return
            for message in self._codec.parse_buffer(data) or ():
                self._take(message)

    def _take(self, message: Any) -> None:
        if message.get_type() != "HIL_SENSOR":
            return
        self.sensors.append(message)
        controls = self._answer(message)
        if controls is not None:
            padded = [*controls, *[0.0] * (16 - len(controls))]
            reply = mavlink.MAVLink_hil_actuator_controls_message(message.time_usec, padded, self._mode, 1)
            self._socket.sendall(reply.pack(self._codec))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-i", type=int, required=True)
    parser.add_argument("-d", required=True)
    parser.add_argument("-s", required=True)
    arguments = parser.parse_args()
    asked_to_end = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: asked_to_end.set())
    print(f"instance {arguments.i}, start scripts {arguments.d}", flush=True)
    with LockstepPeer(4560 + arguments.i, lambda message: [0.5] * 4):
        asked_to_end.wait()
    sys.exit(0)


if __name__ == "__main__":
    main()
