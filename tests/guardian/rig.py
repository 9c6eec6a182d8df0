"""A guardian process on real sockets, with a child as the flight process, PX4's end of the link, and a NatNet server."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from pymavlink.dialects.v20 import common as mavlink

from companion.config.loader import load_flight
from companion.guardian import heartbeat
from companion.guardian.heartbeat import Heartbeat
from companion.io.mocap.natnet import Message as NatNetMessage
from companion.io.team_link import TeamSettings
from companion.launcher.launcher import replace_device_settings
from companion.model.codec import from_packet
from companion.model.frames import attitude_ned_frd_from_enu_flu, ned_from_enu
from companion.model.launcher_messages import FlightEvent, GuardianEnded, Message
from companion.model.packets import LogLine, Packet, read_packet
from companion.model.types import Quat, Vec3
from companion.runtime.clock import monotonic
from sitl.natnet import BodyPose, NatNetServer
from tests.io.px4_peer import Px4Peer
from tests.support import DEADLINE_S, HOVER, free_udp_port, wait_until

LAND_MODE = 4 << 16 | 6 << 24
HOLD_MODE = 4 << 16 | 3 << 24
OFFBOARD_MODE = 6 << 16
ARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED
DISARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
POSITION_M: Vec3 = (0.5, -0.25, 1.25)
ATTITUDE: Quat = (0.9689124217106447, 0.0, 0.0, 0.24740395925452294)
"""Yaw 0.5 rad."""
OWN_IDS = (1, 195)
PATIENT_S = 2.0
"""Silence that the guardian bears: a test's heartbeats come when a busy computer lets it send them."""
STANDING_M = load_flight(HOVER).vehicle.airframe.ground_clearance_m
_FLIGHT = """
import socket, sys
port, px4 = map(int, sys.argv[1:])
s = socket.socket(type=socket.SOCK_DGRAM)
s.bind(("127.0.0.1", port))
s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
s.connect(("127.0.0.1", px4))
print(flush=True)
sys.stdin.read()
"""
"""Holds PX4's port as the flight process does, and does nothing else: the test sends the heartbeats."""


class EchoLess(NatNetServer):
    """A server that answers no echo request: its clients know its clock from its frames only."""

    def _reply(self, message: NatNetMessage, payload: bytes, address: tuple[str, int]) -> None:
        if message != NatNetMessage.ECHO_RESPONSE:
            super()._reply(message, payload, address)


class Cameras:
    """A NatNet server (unicast) that streams one body at rest at 100 Hz, in a thread."""

    def __init__(self, body_id: int, server: type[NatNetServer] = NatNetServer) -> None:
        self._server = server
        self.held_s = 0.0
        """Time for which the network holds each frame."""
        self.frames = 0
        self.position_m: Vec3 = POSITION_M
        self.attitude: Quat = ATTITUDE
        self.tracked = True
        self.port = 0
        self._body_id = body_id
        self._started = threading.Event()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="cameras")

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._started.wait(DEADLINE_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(DEADLINE_S)

    async def _serve(self) -> None:
        async with self._server(bodies=((self._body_id, "companion"),)) as server:
            self.port = server.command_port
            self._started.set()
            while not self._stop.is_set():
                now_s = monotonic() - self.held_s
                x, y, z = self.position_m
                noisy = (x, y, z + 1e-6 * (server.frame_number % 5))  # no measurement is the same twice
                server.publish(now_s, (BodyPose(self._body_id, noisy, self.attitude, self.tracked),), now_s)
                self.frames += 1
                await asyncio.sleep(0.01)


class Rig:
    """One guardian with its surroundings; used with `with`, which starts it and ends its processes."""

    def __init__(
        self,
        folder: Path,
        *,
        timeout_s: float = PATIENT_S,
        disk_full: bool = False,
        address: str | None = None,
        team: TeamSettings | None = None,
        server: type[NatNetServer] = NatNetServer,
    ) -> None:
        self._server = server
        self._team = team
        self.partner_session = 0
        """What the flight process knows of the other vehicle of a team."""
        self._folder = folder
        self._address = address
        self._timeout_s = timeout_s
        self.port = free_udp_port()
        self.peer = Px4Peer(self.port)
        self.peer.base_mode, self.peer.custom_mode = ARMED, OFFBOARD_MODE
        self.peer.landed = mavlink.MAV_LANDED_STATE_IN_AIR
        self.peer.position_ned_m, self.peer.velocity_ned_m_s = ned_from_enu(POSITION_M), (0.0, 0.0, 0.0)
        self.peer.attitude_ned_frd = attitude_ned_frd_from_enu_flu(ATTITUDE)
        self.origin_s = monotonic() - 10.0
        self.tick = 0
        self.messages: list[Message] = []
        self._disk_full = disk_full
        self.logged: list[Packet] = []

    def __enter__(self) -> Self:
        config = load_flight(HOVER)
        body = config.vehicle.devices.mocap.rigid_body_id
        self.cameras = Cameras(body, self._server).__enter__()
        devices: dict[str, dict[str, Any]] = {
            "autopilot": {"address": self._address or f"udpin://127.0.0.1:{self.port}"},
            "mocap": {
                "server": "127.0.0.1",
                "interface": "127.0.0.1",
                "transport": "unicast",
                "command_port": self.cameras.port,
            },
        }
        data = json.loads(replace_device_settings(config, devices).model_dump_json())
        data["vehicle"]["safety"]["guardian_timeout_s"] = self._timeout_s
        if self._team is not None:
            data["vehicle"]["devices"]["team"] = dataclasses.asdict(self._team)
        path = self._folder / "config.json"
        path.write_text(json.dumps(data), encoding="utf-8")

        self.flight = subprocess.Popen(
            [sys.executable, "-c", _FLIGHT, str(self.port), str(self.peer.address[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self.flight.stdout is not None
        self.flight.stdout.readline()  # it holds the port
        self.peer.__enter__()
        self.beats, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel, channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.recorder, recorder = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        self.recorder.setblocking(False)
        self.beats.setblocking(False)
        pidfd = os.pidfd_open(self.flight.pid)
        self.log = self._folder / "guardian.log"
        self.log.touch()
        with theirs, channel, open("/dev/full" if self._disk_full else self.log, "wb") as log:
            self.guardian = subprocess.Popen(
                [
                    *(sys.executable, "-m", "companion.guardian", "--config", str(path), "--pidfd", str(pidfd)),
                    *("--heartbeats", str(theirs.fileno()), "--channel", str(channel.fileno())),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=(theirs.fileno(), channel.fileno(), pidfd),
            )
        os.close(pidfd)
        with recorder:
            socket.send_fds(self.beats, [heartbeat.RECORDER_CHANNEL], [recorder.fileno()])
        return self

    def __exit__(self, *_: object) -> None:
        for process in (self.guardian, self.flight):
            if process.poll() is None:
                process.kill()
            process.wait(DEADLINE_S)
        for pipe in (self.flight.stdin, self.flight.stdout):
            assert pipe is not None
            pipe.close()
        self.peer.__exit__(None, None, None)
        self.cameras.__exit__(None, None, None)
        for opened in (self.beats, self.channel, self.recorder):
            opened.close()

    def beat(
        self,
        *,
        lifting: bool = True,
        pilot: bool = False,
        goodbye: bool = False,
        mocap_refused: bool = False,
        pose_age_s: float = 0.0,
    ) -> None:
        """Send the heartbeat of one tick."""
        self.tick += 1
        t_s = monotonic() - self.origin_s
        beat = Heartbeat(
            tick=self.tick,
            t_s=t_s,
            origin_s=self.origin_s,
            mission_t_s=5.0,
            lifting=lifting,
            pilot=pilot,
            goodbye=goodbye,
            mocap_refused=mocap_refused,
            autopilot_system=1,
            own_system=OWN_IDS[0],
            own_component=OWN_IDS[1],
            local_port=self.port,
            pose_stamp_s=t_s - pose_age_s,
            position_world_m=POSITION_M,
            attitude_wxyz=ATTITUDE,
            peer=self.peer.address,
            partner_session=self.partner_session,
        )
        self.beats.send(heartbeat.pack(beat))

    def beat_until_ready(self, **kind: bool) -> None:
        """Send heartbeats until the guardian is ready; the last one has these values."""

        def ready() -> bool:
            self.beat(**kind)
            try:
                return bool(self.beats.recv(heartbeat.MAX_BYTES) == heartbeat.READY)
            except BlockingIOError:
                return False

        wait_until(ready, lambda: f"the guardian is not ready: {self.log.read_text()}")
        self.beat(**kind)

    def listen(self) -> None:
        """Read the messages to launcher and recorder."""
        self.messages += [from_packet(Message, packet) for packet in self._arrived(self.channel)]
        self.logged += map(read_packet, self._arrived(self.recorder))

    def _arrived(self, opened: socket.socket) -> Iterator[bytes]:
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while data := opened.recv(65536):
                yield data

    @property
    def events(self) -> list[str]:
        """Ids of the guardian's events that the launcher received."""
        self.listen()
        return [message.id for message in self.messages if isinstance(message, FlightEvent)]

    @property
    def log_ids(self) -> list[str]:
        """Ids of the lines that the recorder received."""
        self.listen()
        return [packet.source for packet in self.logged if isinstance(packet, LogLine)]

    @property
    def result(self) -> GuardianEnded | None:
        """The guardian's final message."""
        self.listen()
        return next((message for message in self.messages if isinstance(message, GuardianEnded)), None)

    def come_down(self) -> None:
        """Lower motion capture and PX4's position to standing height, slowly enough to be plausible."""
        x, y, z = self.cameras.position_m
        while z > STANDING_M:
            z = max(STANDING_M, z - 0.05)
            self.cameras.position_m = (x, y, z)
            time.sleep(0.02)
        self.peer.position_ned_m, self.peer.velocity_ned_m_s = (y, x, -STANDING_M), (0.0, 0.0, 0.0)

    def land(self) -> None:
        """Play PX4 after LAND was commanded: mode, touchdown, disarm."""
        wait_until(lambda: bool(self.peer.commands(mavlink.MAV_CMD_NAV_LAND)), lambda: self.log.read_text())
        self.peer.custom_mode = LAND_MODE
        wait_until(lambda: "guardian_land" in self.events, lambda: self.log.read_text())
        self.come_down()
        self.peer.landed = mavlink.MAV_LANDED_STATE_ON_GROUND
        wait_until(lambda: bool(self.peer.commands(mavlink.MAV_CMD_COMPONENT_ARM_DISARM)), lambda: self.log.read_text())
        self.peer.base_mode = DISARMED
