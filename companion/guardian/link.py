"""The guardian's MAVLink link, on the address that the flight process used. Messages are encoded with pymavlink. No call waits."""

from __future__ import annotations

import contextlib
import logging
import math
import re
import socket
import time
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.retreat import Setpoint
from companion.io.px4 import messages
from companion.io.px4.udp_peer import REPIN_SILENCE_S, disconnect_udp
from companion.io.qgroundcontrol.frames import autopilot_heartbeat
from companion.model.frames import attitude_ned_frd_from_enu_flu, ned_from_enu, quat_from_euler_zyx, wrap_rad
from companion.model.types import AutopilotRequest, MocapPose

Message = Any

_LOG = logging.getLogger(__name__)
_NET = re.compile(r"(udpin|udpout|tcpout)://([^:/?]+):(\d+)")
_SERIAL = re.compile(r"(serial|serial_flowcontrol)://(/[^:]+):(\d+)")
_MAX_BYTES = 65535
_ROUND_DATAGRAMS = 1000
_CONNECT_TIMEOUT_S = 0.5
_TYPE_MASK_IGNORE_RATES = 7
# One NaN: PX4 uses EKF2_EVP_NOISE and EKF2_EVA_NOISE instead of a covariance.
_COVARIANCE_FROM_PARAMS = [math.nan] + [0.0] * 20


class Wire(Protocol):
    """Byte transport to PX4."""

    @property
    def ready(self) -> bool:
        """Whether PX4's address is known."""

    @property
    def lost(self) -> bool:
        """Whether the connection has ended. A lost wire ends every wait on it and transfers no data."""

    def fileno(self) -> int:
        """Return the descriptor to wait on."""

    def send(self, data: bytes) -> None:
        """Send one message; drop it if the transport does not accept it."""

    def receive(self) -> list[bytes]:
        """Return all data that has arrived."""

    def close(self) -> None:
        """Close the transport."""


class _ChannelWire:
    """A wire over a socket or serial port."""

    ready = True
    lost = False

    def __init__(self, channel: Any) -> None:
        self._channel = channel

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return int(self._channel.fileno())

    def close(self) -> None:
        """Close the transport."""
        with contextlib.suppress(OSError):
            self._channel.close()


class UdpWire(_ChannelWire):
    """UDP transport: bound to the port that PX4 sends to (`udpin`), or sending to PX4 from the flight process's port (`udpout`).
    PX4 only sends to the first peer of a UDP link, so the port must stay the same. Once PX4's address is known the socket is
    connected to it and the kernel drops datagrams of all other senders. After REPIN_SILENCE_S without a datagram the socket is
    disconnected, then connected to the next sender at the same IPv4 address that sends a HEARTBEAT with PX4's system id: a
    restarted router sends from a new port.

    Args:
        local: address to bind; None for any.
        remote: PX4's address; None to use the sender of the first valid HEARTBEAT of an autopilot.
        share_port: the killed flight process still holds the port, but reads nothing: of several sockets connected to PX4, the
            newest receives the datagrams (measured, Linux 6.18).
    """

    def __init__(
        self, local: tuple[str, int] | None, remote: tuple[str, int] | None, *, share_port: bool = False
    ) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        super().__init__(self._socket)
        self._remote: tuple[str, int] | None = None
        self._bound = local is not None
        self._connected = False
        self._heard_s = 0.0
        self.system: int | None = None
        """MAVLink system id of PX4; None accepts any."""
        self.ready = False
        """PX4's address is known."""
        try:
            self._socket.setblocking(False)
            if share_port:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if local is not None:
                self._socket.bind(local)
            if remote is not None:
                self._connect(remote)
        except OSError:
            self._socket.close()
            raise

    def send(self, data: bytes) -> None:
        """Send to PX4; do nothing before its address is known."""
        if self._remote is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._remote)

    def receive(self) -> list[bytes]:
        """Return datagrams from PX4's address; while the address is unknown, only the HEARTBEAT that reveals it."""
        # Disconnecting would take an unbound socket's port away from it.
        if self._connected and self._bound and time.monotonic() - self._heard_s > REPIN_SILENCE_S:
            disconnect_udp(self._socket)
            self._connected = False
        found: list[bytes] = []
        for _ in range(_ROUND_DATAGRAMS):
            try:
                data, sender = self._socket.recvfrom(_MAX_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # an ICMP error of an earlier send
                continue
            if not self._connected and self._is_from_px4(data, sender):
                self._connect(sender)
            if sender == self._remote:
                self._heard_s = time.monotonic()
                found.append(data)
        return found

    def _is_from_px4(self, data: bytes, sender: tuple[str, int]) -> bool:
        """Whether the datagram identifies its sender as PX4."""
        if self._remote is not None and sender[0] != self._remote[0]:
            return False
        heard = autopilot_heartbeat(data)
        return heard is not None and (self.system is None or heard.system == self.system)

    def _connect(self, remote: tuple[str, int]) -> None:
        before, self._remote = self._remote, remote
        self._socket.connect(remote)
        self._heard_s = time.monotonic()
        self._connected = self.ready = True
        if before is not None and remote != before:
            _LOG.warning(
                "PX4 sent nothing from %s:%d for %g s and now sends from port %d; the link uses that port",
                *before,
                REPIN_SILENCE_S,
                remote[1],
            )


class TcpWire(_ChannelWire):
    """TCP client transport."""

    def __init__(self, remote: tuple[str, int]) -> None:
        self._socket = socket.create_connection(remote, _CONNECT_TIMEOUT_S)
        super().__init__(self._socket)
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """Send what fits into the send buffer; the receiver resynchronises on the next message."""
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def receive(self) -> list[bytes]:
        """Return the data that has arrived. End of stream or an error marks the wire as lost."""
        try:
            data = self._socket.recv(_MAX_BYTES)
        except (BlockingIOError, InterruptedError):
            return []
        except OSError:
            data = b""
        self.lost = not data
        return [data] if data else []


class SerialWire(_ChannelWire):
    """Serial transport, 8N1."""

    def __init__(self, path: str, baud: int, flow_control: bool) -> None:
        import serial  # imported here because the other links do not need it

        # exclusive: takes the same flock as the flight process
        self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, rtscts=flow_control, exclusive=True)
        super().__init__(self._port)

    def send(self, data: bytes) -> None:
        """Write as many bytes as the port accepts."""
        with contextlib.suppress(OSError):
            self._port.write(data)

    def receive(self) -> list[bytes]:
        """Return the data that has arrived. A port that is readable but has no data (unplugged, hung up) is lost."""
        try:
            data = self._port.read(_MAX_BYTES)
        except OSError:  # serial.SerialException is one
            self.lost = True
            return []
        return [data] if data else []


def address_problem(address: str) -> str | None:
    """Return why the guardian cannot take over this link, or None if it can; called before take-off."""
    if _NET.fullmatch(address) or _SERIAL.fullmatch(address):
        return None
    return f"autopilot {address}: the guardian cannot take over this link; expected udpin, udpout, tcpout or serial"


def is_udp(address: str) -> bool:
    """Whether the address is a UDP link. A UDP link can be opened while the killed flight process still holds it."""
    net = _NET.fullmatch(address)
    return net is not None and net[1] in ("udpin", "udpout")


def open_wire(address: str, local_port: int, peer: tuple[str, int] | None = None, *, share_port: bool = False) -> Wire:
    """Open the link that the flight process has released.

    Args:
        address: value of `devices.autopilot.address`.
        local_port: UDP port of the flight process; 0 if unknown.
        peer: PX4's UDP address as the flight process confirmed it; None if unknown.
        share_port: the killed flight process still holds the link; only for UDP links (`is_udp`).

    Raises:
        OSError: the link does not exist, or another process holds it.
    """
    net = _NET.fullmatch(address)
    if net is not None:
        kind, host, port = net[1], net[2], int(net[3])
        if kind == "udpin":
            return UdpWire((host, port), peer, share_port=share_port)
        if kind == "udpout":
            remote = peer or (socket.gethostbyname(host), port)
            return UdpWire(("", local_port) if local_port else None, remote, share_port=share_port)
        return TcpWire((host, port))
    port_of = _SERIAL.fullmatch(address)
    if port_of is None:
        raise OSError(f"{address}: unknown link type")
    return SerialWire(port_of[2], int(port_of[3]), port_of[1] == "serial_flowcontrol")


class Link:
    """MAVLink 2 over a wire, with the identity of the companion.

    Args:
        wire: an open wire.
        own: system and component id of the companion.
        autopilot_system: system id of PX4.
    """

    def __init__(self, wire: Wire, own: tuple[int, int], autopilot_system: int) -> None:
        self.wire = wire
        self._autopilot_system = autopilot_system
        self._encoder = mavlink.MAVLink(None, srcSystem=own[0], srcComponent=own[1])
        self._decoder = self._new_decoder()
        self.poses_sent = 0

    @staticmethod
    def _new_decoder() -> Any:
        decoder = mavlink.MAVLink(None)
        decoder.robust_parsing = True
        return decoder

    def receive(self) -> list[Message]:
        """Return PX4's messages that have arrived. Malformed data is dropped and never raises."""
        found: list[Message] = []
        if isinstance(self.wire, UdpWire):
            self.wire.system = self._autopilot_system
        for data in self.wire.receive():
            try:
                parsed = self._decoder.parse_buffer(data) or ()
            except (mavlink.MAVError, ValueError, IndexError):
                self._decoder = self._new_decoder()
                continue
            if isinstance(self.wire, UdpWire) and self._decoder.buf_len():
                self._decoder = self._new_decoder()  # a truncated datagram must not consume the ones after it
            for message in parsed:
                source = (message.get_srcSystem(), message.get_srcComponent())
                if message.get_type() != "BAD_DATA" and source == (
                    self._autopilot_system,
                    messages.MAV_COMP_ID_AUTOPILOT1,
                ):
                    found.append(message)
        return found

    def send(self, message: Message) -> None:
        """Send one message."""
        data = message.pack(self._encoder)
        self._encoder.seq = (self._encoder.seq + 1) % 256
        self.wire.send(data)

    def send_heartbeat(self) -> None:
        """Send HEARTBEAT with the fields that MAVSDK uses for a companion computer."""
        self.send(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_UNINIT, 3
            )
        )

    def send_vision(self, pose: MocapPose) -> None:
        """Send VISION_POSITION_ESTIMATE with the fields and time base of the flight process.

        Raises:
            ValueError: the pose is not finite.
        """
        position_ned_m, euler_rad = messages.vision_ned(pose)
        usec = max(1, int(pose.stamp_s * 1e6))
        self.send(
            mavlink.MAVLink_vision_position_estimate_message(
                usec, *position_ned_m, *euler_rad, _COVARIANCE_FROM_PARAMS, 0
            )
        )
        self.poses_sent += 1

    def send_request(self, request: AutopilotRequest) -> None:
        """Send the MAVLink command of a request."""
        self._send_command(*messages.command(request))

    def request_message(self, message_id: int) -> None:
        """Send MAV_CMD_REQUEST_MESSAGE: PX4 sends the message immediately, once."""
        self._send_command(mavlink.MAV_CMD_REQUEST_MESSAGE, float(message_id), 0.0)

    def request_rate(self, message_id: int, rate_hz: float) -> None:
        """Send MAV_CMD_SET_MESSAGE_INTERVAL."""
        self._send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(message_id), 1e6 / rate_hz)

    def send_zero_thrust(self, t_s: float, yaw_rad: float) -> None:
        """Send SET_ATTITUDE_TARGET: level, at `yaw_rad` (world ENU), with zero thrust. Only for a vehicle on the ground."""
        q = attitude_ned_frd_from_enu_flu(quat_from_euler_zyx(0.0, 0.0, yaw_rad))
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_set_attitude_target_message(
                int(t_s * 1e3) & 0xFFFFFFFF, target, component, _TYPE_MASK_IGNORE_RATES, q, 0.0, 0.0, 0.0, 0.0
            )
        )

    def send_position(self, t_s: float, setpoint: Setpoint) -> None:
        """Send SET_POSITION_TARGET_LOCAL_NED with position, velocity, acceleration and yaw."""
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_set_position_target_local_ned_message(
                int(t_s * 1e3) & 0xFFFFFFFF,
                target,
                component,
                mavlink.MAV_FRAME_LOCAL_NED,
                mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
                *ned_from_enu(setpoint.position_world_m),
                *ned_from_enu(setpoint.velocity_world_m_s),
                *ned_from_enu(setpoint.acceleration_world_m_s2),
                wrap_rad(0.5 * math.pi - setpoint.yaw_rad),
                0.0,
            )
        )

    def _send_command(self, command: int, param1: float, param2: float) -> None:
        target, component = self._autopilot_system, messages.MAV_COMP_ID_AUTOPILOT1
        self.send(
            mavlink.MAVLink_command_long_message(target, component, command, 0, param1, param2, 0.0, 0.0, 0.0, 0.0, 0.0)
        )
