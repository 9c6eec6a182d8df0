"""NatNet client without I/O: takes datagrams with arrival times, returns frames, poses and requests.

`companion.io.mocap.optitrack` adds the sockets, for the flight, the guardian and the commissioning tools.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from companion.io.mocap import natnet
from companion.io.mocap.definitions import parse_model_definitions
from companion.io.mocap.frames import Frame, RigidBody, parse_frame
from companion.io.mocap.markers import marker_frame
from companion.io.mocap.natnet import OLDEST_VERSION, Malformed, Message, ServerInfo, Version
from companion.io.mocap.server_clock import ServerClock
from companion.model.markers import MarkerFrame
from companion.model.team import BarPose
from companion.model.types import IDENTITY_QUAT, MocapPose, Vec3
from companion.safety.stream_watch import StreamWatch

SUPPORTED_VERSIONS: Final = "{}.{} or later".format(*OLDEST_VERSION)
CONNECT_PERIOD_S: Final = 0.25
KEEP_ALIVE_PERIOD_S: Final = 0.5
ECHOES_WAITING: Final = 8
"""Number of newest echo requests whose answers are accepted."""
RECONNECT_SILENCE_S: Final = 1.0
"""Silence after which a connect request is sent: a restarted server knows its clients only after a new one."""
FRAMES_SILENCE_S: Final = 0.1
"""Silence after which frames have stopped."""


class NatNetClient:
    """Receives one rigid body from one server. The version of the server's first answer stays in use.

    Args:
        body_id: streaming id of the rigid body.
        up_axis: "y" or "z": Motive's streaming setting.
        transport: "unicast" or "multicast"; a unicast server forgets a client that sends no keep-alives.
        ball: `devices.mocap.ball`; None if no marker is read.
    """

    def __init__(
        self,
        body_id: int,
        up_axis: str,
        transport: str,
        application: str = "companion",
        ball: Mapping[str, Any] | None = None,
    ) -> None:
        self._body_id = body_id
        self._up_axis = up_axis
        self._unicast = transport == "unicast"
        self._application = application
        self._ball = ball
        self._with_markers = ball is not None and ball["kind"] == "marker"
        self._tracked_m: Vec3 = (0.0, 0.0, 0.0)
        """Newest position at which the vehicle's body was tracked, in the axes of the stream."""
        self._streams = StreamWatch()
        self._clock = ServerClock()
        self._token = 0
        self._echo_sent_s: dict[int, float] = {}
        """Time at which each of the newest unanswered echo requests was sent, by its token."""
        self._last_number: int | None = None
        self._last_frame_s = 0.0
        self._heard_s = -math.inf
        """Arrival of the newest frame or server info."""
        self.info: ServerInfo | None = None
        """The server's description; None before it has answered."""
        self.version: Version | None = None
        """NatNet version of the frames; None before the server has answered, or if its version is not supported."""
        self.body_ids: tuple[int, ...] | None = None
        """Rigid bodies of the newest frame by streaming id; None before the first frame."""
        self.names: dict[int, str] = {}
        """Names of the rigid bodies by streaming id, once the server has sent them."""
        self.two_streams = False
        """The newest frame belongs to one of two mixed streams: two servers are sending from the same address."""
        self.out_of_order = 0
        self.malformed = 0
        self.problem: str | None = None
        """What was wrong with the newest datagram that was rejected or is ambiguous; None if none was."""

    def requests(self, now_s: float) -> list[bytes]:
        """Return the datagrams to send to the server now; call it again after `request_period_s`."""
        if self.version is None:
            return [natnet.encode_connect(self._application)]
        requests = []
        if now_s - self._heard_s > RECONNECT_SILENCE_S:
            requests.append(natnet.encode_connect(self._application))
        if self._unicast:
            requests.append(natnet.encode_request(Message.KEEP_ALIVE))
        if self.info is None or not self.info.clock_frequency_hz:
            return requests
        self._token += 1
        self._echo_sent_s = {token: s for token, s in self._echo_sent_s.items() if token > self._token - ECHOES_WAITING}
        self._echo_sent_s[self._token] = now_s
        requests.append(natnet.encode_echo_request(self._token))
        return requests

    def is_silent(self, now_s: float) -> bool:
        """Return whether frames have arrived, but none for a while."""
        return self._last_number is not None and now_s - self._last_frame_s > FRAMES_SILENCE_S

    @property
    def request_period_s(self) -> float:
        """Time between two calls of `requests`, s."""
        return CONNECT_PERIOD_S if self.version is None else KEEP_ALIVE_PERIOD_S

    def farewell(self) -> list[bytes]:
        """Return the datagrams to send before the sockets are closed."""
        return [natnet.encode_message(Message.DISCONNECT)] if self._unicast else []

    def receive(self, datagram: bytes, arrived_s: float) -> Frame | None:
        """Process a datagram from the server.

        Returns:
            The datagram's frame, or None if it has none or its frame is malformed, repeated or late. While two streams are mixed
            every frame is returned, in any order.
        """
        message = natnet.message_id(datagram)
        if message == Message.FRAME:
            return self._receive_frame(datagram, arrived_s)
        if message == Message.SERVER_INFO:
            self._receive_info(datagram, arrived_s)
        elif message == Message.ECHO_RESPONSE:
            self._receive_echo(datagram)
        elif message == Message.MODELDEF and self.version is not None:
            definitions = parse_model_definitions(datagram, self.version)
            if isinstance(definitions, Malformed):
                self._reject(definitions)
            else:
                self.names = {definition.id: definition.name for definition in definitions}
        return None

    def other_body(self, datagram: bytes, body_id: int) -> RigidBody | None:
        """Return a body other than the vehicle's from a frame that `receive` has returned, or None if its pose is malformed."""
        assert self.version is not None and self.info is not None
        frame = parse_frame(datagram, self.version, body_id, self.info.clock_frequency_hz)
        return frame.body if isinstance(frame, Frame) else None

    def pose(self, frame: Frame, stamp_s: float) -> MocapPose | None:
        """Return the rigid body's pose in the world frame, or None if the frame does not contain it.

        Args:
            stamp_s: arrival of its datagram on the flight clock, s.
        """
        body = frame.body
        if body is None:
            return None
        position_m, quat_wxyz = body.position_m, body.quat_wxyz
        if self._up_axis == "y":
            position_m, quat_wxyz = natnet.z_up_from_y_up(position_m, quat_wxyz)
        return MocapPose(
            stamp_s=stamp_s,
            latency_s=frame.age_s,
            frame_number=frame.number,
            position_world_m=position_m,
            attitude_wxyz=quat_wxyz,
            tracking_valid=body.tracking_valid,
            marker_error_m=body.error_m,
            exposure_server_s=frame.exposure_s,
        )

    def markers(self, frame: Frame, datagram: bytes, stamp_s: float) -> MarkerFrame | None:
        """Return the single markers of a frame in the world frame, or None if no ball is followed. If the ball is a rigid body, it is
        the only marker, as long as it is tracked.

        Args:
            stamp_s: arrival of the datagram on the flight clock, s.
        """
        if self._ball is None:
            return None
        if frame.body is not None and frame.body.tracking_valid:
            self._tracked_m = frame.body.position_m
        positions = frame.markers
        if not self._with_markers:
            ball = self.other_body(datagram, self._ball["id"])
            positions = (ball.position_m,) if ball is not None and ball.tracking_valid else ()
        if self._up_axis == "y":
            positions = tuple([natnet.z_up_from_y_up(position, IDENTITY_QUAT)[0] for position in positions])
        near_m = self._tracked_m if self._up_axis == "z" else natnet.z_up_from_y_up(self._tracked_m, IDENTITY_QUAT)[0]
        return marker_frame(stamp_s, frame.age_s, frame.number, positions, near_m)

    def bar(self, frame: Frame, datagram: bytes, bar_id: int, stamp_s: float) -> BarPose | None:
        """Return the bar's rigid body in the world frame, or None if the frame does not contain it.

        Args:
            stamp_s: arrival of the datagram on the flight clock, s.
        """
        body = self.other_body(datagram, bar_id) if bar_id in frame.body_ids else None
        pose = None if body is None else self.pose(frame._replace(body=body), stamp_s)
        if pose is None:
            return None
        return BarPose(
            stamp_s=stamp_s,
            position_world_m=pose.position_world_m,
            attitude_wxyz=pose.attitude_wxyz,
            tracking_valid=pose.tracking_valid,
        )

    def _receive_info(self, datagram: bytes, arrived_s: float) -> None:
        info = natnet.parse_server_info(datagram)
        if isinstance(info, Malformed):
            self._reject(info)
            return
        version = info.natnet_version[:2]
        if self.version is not None and version != self.version:
            before = ".".join(map(str, self.version))
            self.problem = f"the server was restarted with NatNet {info.version} instead of {before}"
            return
        self.info, self._heard_s = info, arrived_s
        self.version = version if version >= OLDEST_VERSION else None
        if self.version is None:
            self.problem = f"the server speaks NatNet {info.version}, expected {SUPPORTED_VERSIONS}"

    def _receive_echo(self, datagram: bytes) -> None:
        answer = natnet.parse_echo_response(datagram)
        if isinstance(answer, Malformed):
            self._reject(answer)
            return
        token, ticks = answer
        sent_s = self._echo_sent_s.pop(token, None)
        frequency_hz = self.info.clock_frequency_hz if self.info is not None else None
        if sent_s is not None and frequency_hz:
            self._clock.echo(sent_s, ticks / frequency_hz)

    def _receive_frame(self, datagram: bytes, arrived_s: float) -> Frame | None:
        if self.version is None or self.info is None:
            return None
        ticks_hz, markers = self.info.clock_frequency_hz, self._with_markers
        frame = parse_frame(datagram, self.version, self._body_id, ticks_hz, markers=markers)
        if isinstance(frame, Malformed):
            self._reject(frame)
            return None
        self.two_streams = self._streams.update(frame.number, frame.body, arrived_s)
        if self.two_streams:
            self.problem = "two servers at one address: frame numbers arrive in two sequences"
        elif not natnet.is_newer(frame.number, self._last_number, arrived_s - self._last_frame_s):
            self.out_of_order += 1
            return None
        self._last_number = frame.number
        self._last_frame_s = self._heard_s = arrived_s
        self.body_ids = frame.body_ids
        if self.is_ambiguous:
            self.problem = f"two rigid bodies have the streaming id {self._body_id}; the first one is used"
        if frame.bad_markers:
            self.malformed += frame.bad_markers
            self.problem = f"frame {frame.number}: {frame.bad_markers} markers without a finite position are dropped"
        if frame.latency_s is None or frame.exposure_s is None:
            return frame
        return frame._replace(age_s=self._clock.age_s(frame.exposure_s, frame.latency_s, arrived_s))

    @property
    def is_ambiguous(self) -> bool:
        """Return whether the newest frame has two bodies with the vehicle's streaming id."""
        return self.body_ids is not None and self.body_ids.count(self._body_id) > 1

    def _reject(self, bad: Malformed) -> None:
        self.malformed += 1
        self.problem = bad.reason
