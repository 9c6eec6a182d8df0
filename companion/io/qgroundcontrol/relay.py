"""The process between the flight process and a MAVLink ground station: `python -m companion.io.qgroundcontrol.relay`.

It holds three sockets: the channel to the flight process, one to its link to PX4 (loopback) and one to the ground station.
The latter two are connected, so the kernel drops datagrams from any other address. A flood from the ground costs this process time, not
the flight. It ends when the channel closes.

Messages on the channel are JSON (`companion.io.qgroundcontrol.channel`). To the flight process: `{"port": N}` once, or `{"error":
text}`; later `{"text": text}`. From it: `{"vehicle_port": N}` once; later `{"arming": true}` when it requests arming, `{"texts":
[[severity, text], ...]}`, `{"situation": text}`, `{"t_ms": N, "values": {...}}`, `{"bye": true}`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import socket
import sys
import time
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.io.qgroundcontrol.channel import pack, unpack
from companion.io.qgroundcontrol.downlink_filter import DownlinkFilter
from companion.io.qgroundcontrol.texts import COMPONENT, Texts, heartbeat_message, value_messages
from companion.io.qgroundcontrol.uplink_filter import UplinkFilter

NICENESS = 10
CHANNEL_MAX_BYTES = 65_536
GONE = "flight process ended: guardian lands, link closes"
_DATAGRAM_MAX_BYTES = 65535
_ROUND_DATAGRAMS = 64
"""Largest number of datagrams from one socket before the others are read."""
_HEARTBEAT_S = 1.0
_AWAY_S = 5.0
"""Silence of a ground station after which the current situation is sent again."""
_REPORT_S = 5.0
"""Time between two lines about refused messages."""


class Relay:
    """Relay between one vehicle and one ground station.

    Args:
        vehicle: UDP, bound on loopback; connected once the flight process's port is known.
        ground: UDP, connected to the ground station.
        uplink: filter of the ground station's messages.
        vehicle_system: MAVLink system id of the vehicle.
        name: the ground station's address for display.
    """

    def __init__(
        self,
        channel: socket.socket,
        vehicle: socket.socket,
        ground: socket.socket,
        uplink: UplinkFilter,
        vehicle_system: int,
        name: str,
    ) -> None:
        self._channel, self._vehicle, self._ground, self._name = channel, vehicle, ground, name
        for one in (channel, vehicle, ground):
            one.setblocking(False)
        self._open = False
        """Whether the flight process's port is known."""
        self._bye = False
        self._uplink, self._downlink, self._texts = uplink, DownlinkFilter(), Texts()
        self._encoder = mavlink.MAVLink(None, srcSystem=vehicle_system, srcComponent=COMPONENT)
        self._situation: str | None = None
        self._beat_s = self._report_s = 0.0
        self._heard_s: float | None = None
        self._told: Counter[str] = Counter()

    def run(self) -> None:
        """Run until the flight process signs off or is gone."""
        waits = select.poll()
        for one in (self._channel, self._vehicle, self._ground):
            waits.register(one, select.POLLIN)
        while True:
            now_s = time.monotonic()
            ready = {fd for fd, _ in waits.poll(1e3 * max(0.0, min(self._beat_s - now_s, 0.1)))}
            now_s = time.monotonic()
            if self._channel.fileno() in ready and not self._hear():
                break
            if self._vehicle.fileno() in ready:
                for datagram in _received(self._vehicle):
                    self._uplink.state.hear(datagram, now_s)
                    for frame in self._downlink.pick(datagram, now_s):
                        self._to_ground(frame)
            if self._ground.fileno() in ready:
                self._take_from_ground(now_s)
            if now_s >= self._beat_s:
                self._beat_s = now_s + _HEARTBEAT_S
                self._say(heartbeat_message())
            for message in self._texts.due(now_s):
                self._say(message)
            self._report(now_s)
        if not self._bye:
            self._texts = Texts()
            self._texts.say(int(mavlink.MAV_SEVERITY_ALERT), GONE)
            for message in self._texts.due(time.monotonic()):
                self._say(message)

    def _hear(self) -> bool:
        """Process messages from the flight process. Return False when the channel has closed."""
        for _ in range(_ROUND_DATAGRAMS):
            try:
                data = self._channel.recv(CHANNEL_MAX_BYTES)
            except BlockingIOError:
                return True
            except OSError:
                return False
            if not data:
                return False
            self._take(unpack(data))
        return True

    def _take(self, said: dict[str, Any]) -> None:
        if "vehicle_port" in said:
            self._vehicle.connect(("127.0.0.1", said["vehicle_port"]))
            self._open = True
        if "arming" in said:
            self._uplink.state.expect_arming(time.monotonic())
        for severity, text in said.get("texts", ()):
            self._texts.say(severity, text)
        self._situation = said.get("situation", self._situation)
        if "values" in said:
            for message in value_messages(said["t_ms"], said["values"]):
                self._say(message)
        self._bye = self._bye or "bye" in said

    def _take_from_ground(self, now_s: float) -> None:
        for datagram in _received(self._ground):
            passed = self._uplink.admit(datagram, now_s)
            if not passed or not self._open:
                continue
            if self._heard_s is None:
                self._tell(f"ground station {self._name} is connected")
            if self._situation is not None and (self._heard_s is None or now_s - self._heard_s > _AWAY_S):
                self._texts.say(int(mavlink.MAV_SEVERITY_INFO), self._situation)
            self._heard_s = now_s
            for frame in passed:
                with contextlib.suppress(
                    OSError
                ):  # the flight process does not keep up: the message is lost, as on any link
                    self._vehicle.send(frame)

    def _report(self, now_s: float) -> None:
        """Report refused messages: a line for each new reason, and the counts at intervals."""
        if self._uplink.refused == self._told or now_s < self._report_s:
            return
        self._report_s = now_s + _REPORT_S
        new = self._uplink.refused - self._told
        self._told = Counter(self._uplink.refused)
        reasons = ", ".join(f"{count} {reason}" for reason, count in new.most_common(5))
        self._tell(f"ground station {self._name}: messages refused: {reasons}")

    def _say(self, message: Any) -> None:
        self._to_ground(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256

    def _to_ground(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # no listener or no network; either may come back
            self._ground.send(data)

    def _tell(self, text: str) -> None:
        with contextlib.suppress(OSError):
            self._channel.send(pack({"text": text}))


def _received(source: socket.socket) -> list[bytes]:
    datagrams = []
    for _ in range(_ROUND_DATAGRAMS):
        try:
            datagrams.append(source.recv(_DATAGRAM_MAX_BYTES))
        except BlockingIOError:
            break
        except OSError:
            continue  # an ICMP error from an earlier send: no listener
    return datagrams


def main(argv: list[str] | None = None) -> int:
    """Entry point of the relay process."""
    parser = argparse.ArgumentParser(prog="companion.io.qgroundcontrol.relay")
    parser.add_argument("--fd", type=int, required=True, help="channel to the flight process")
    parser.add_argument("--host", required=True, help="ground station, an IP address")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--system", type=int, required=True, help="MAVLink system id of the vehicle")
    parser.add_argument("--name", required=True, help="the ground station's address for display")
    parser.add_argument("--while-armed", action="store_true", help="pass everything even while PX4 is armed")
    parser.add_argument("--console", action="store_true", help="pass SERIAL_CONTROL while PX4 is not armed")
    a = parser.parse_args(argv)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends with the flight process
    os.nice(NICENESS)
    family = socket.AF_INET6 if ":" in a.host else socket.AF_INET
    with (
        socket.socket(fileno=a.fd) as channel,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(family, socket.SOCK_DGRAM) as ground,
    ):
        vehicle.bind(("127.0.0.1", 0))
        try:
            ground.connect((a.host, a.port))
        except OSError as error:
            channel.send(pack({"error": error.strerror or str(error)}))
            return 1
        channel.send(pack({"port": vehicle.getsockname()[1]}))
        uplink = UplinkFilter(a.system, while_armed=a.while_armed, console=a.console)
        Relay(channel, vehicle, ground, uplink, a.system, a.name).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
