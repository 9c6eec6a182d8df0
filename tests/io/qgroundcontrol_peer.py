"""A ground station at the other end of the wire, spoken by pymavlink: what QGroundControl would see, and what it may say."""

from __future__ import annotations

import socket
import threading
import time
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from tests.support import DEADLINE_S


class GroundPeer:
    """Listens on a free port of loopback and records everything; answers the last sender, as QGroundControl does."""

    def __init__(self, beating: bool = True) -> None:
        self.beating = beating
        self._heard: list[tuple[Any, int, int]] = []
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port = int(self._socket.getsockname()[1])
        self.address = f"udpout://127.0.0.1:{self.port}"
        self._socket.settimeout(0.01)
        self._partner: Any = None
        self._thread = threading.Thread(target=self._run, name="ground-peer")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self._socket.close()

    def of(self, name: str, component: int | None = None) -> list[Any]:
        """All messages of one type so far, from one component."""
        with self._changed:
            return [m for m, _, sender in self._heard if m.get_type() == name and component in (None, sender)]

    def senders(self) -> set[tuple[int, int]]:
        with self._changed:
            return {(system, component) for _, system, component in self._heard}

    def wait_for(
        self, kind: str, /, component: int | None = None, deadline_s: float = DEADLINE_S, **fields: Any
    ) -> Any:
        """Block until a message of the type, from the component, with these fields, is there."""
        with self._changed:
            found: list[Any] = []

            def there() -> bool:
                found[:] = [
                    m
                    for m, _, sender in self._heard
                    if m.get_type() == kind
                    and component in (None, sender)
                    and all(getattr(m, key) == value for key, value in fields.items())
                ]
                return bool(found)

            assert self._changed.wait_for(there, deadline_s), f"no {kind} {fields} within {deadline_s} s"
            return found[-1]

    def say(self, message: Any, system: int = 255, component: int = mavlink.MAV_COMP_ID_MISSIONPLANNER) -> None:
        self.say_bytes(message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component)))

    def say_bytes(self, data: bytes) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self._partner is not None, DEADLINE_S), "no message has arrived"
        self._socket.sendto(data, self._partner)

    def settle(self) -> None:
        """Everything that was sent to us before this call has been read: a mark is sent after it."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as marker:
            mark = mavlink.MAVLink_ping_message(1, 77, 0, 0)
            marker.sendto(mark.pack(mavlink.MAVLink(None, srcSystem=99)), ("127.0.0.1", self.port))
        self.wait_for("PING", seq=77)

    def read_param(self, name: str) -> Any:
        """PARAM_REQUEST_READ, and the answer."""
        self.say(mavlink.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        return self.wait_for("PARAM_VALUE", param_id=name)

    def _run(self) -> None:
        decoder = mavlink.MAVLink(None)
        decoder.robust_parsing = True
        beat_s = 0.0
        while not self._stop.is_set():
            now_s = time.monotonic()
            if self.beating and self._partner is not None and now_s >= beat_s:
                beat_s = now_s + 1.0
                self.say(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
            try:
                data, sender = self._socket.recvfrom(65535)
            except TimeoutError:
                continue
            with self._changed:
                self._partner = sender
                for m in decoder.parse_buffer(data) or []:
                    self._heard.append((m, m.get_srcSystem(), m.get_srcComponent()))
                self._changed.notify_all()
