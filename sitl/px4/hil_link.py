"""The world as PX4's external simulator: MAVLink 2 over TCP, HIL_SENSOR out, HIL_ACTUATOR_CONTROLS in, in lockstep.

PX4 is the client. Its only clock is the `time_usec` of the newest HIL_SENSOR, so the world and PX4 advance in turn: a sample, its
answer, the next sample. The clock restarts with each PX4 that connects. Motion capture reaches PX4 over the companion's link, not this
one.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import socket
from typing import Any, Self, cast

from pymavlink.dialects.v20 import common as mavlink

from companion.model.frames import quat_conjugate, quat_rotate
from companion.model.types import Quat, Vec3
from sitl.autopilot.types import ImuSample, RotorCommands

CLOCK_ORIGIN_S = 1.0
"""PX4's clock at its first sample, whatever the world time. It must not be zero, and not several minutes either, because EKF2's first
estimate is then late (PX4 1.16.1: by about 10 s for 300 s; for 1000 s, by more than the preflight check waits).
"""
ANSWER_PATIENCE_S = 2.0
"""Timeout for the answer to one sample; then the next sample is sent."""
ANSWER_DEADLINE_S = 10.0
"""Time without any answer after which PX4 counts as hung."""
FIELD_EVERY, FIELD_OFFSET = 5, 2
"""Every fifth sample includes the magnetometer: 50 Hz."""

_ACCEL_AND_GYRO, _MAG, _BARO = 0x07 | 0x38, 0x1C0, 0x200 | 0x800 | 0x1000
_GROUND_ALTITUDE_M = 488.0
_FIELD_NED_GAUSS: Vec3 = (0.21, 0.01, 0.43)
_FIELD_NOISE_GAUSS, _PRESSURE_NOISE_HPA = 0.001, 0.01
_TEMPERATURE_C = 25.0


class Px4Error(Exception):
    """PX4 cannot be started, has ended or does not answer; the text is one line for the user."""


def pressure_hpa(altitude_m: float) -> float:
    """Return the pressure of the standard atmosphere in hPa at a height above sea level."""
    return 1013.25 * math.pow(1.0 - 2.25577e-5 * altitude_m, 5.25588)


def field_frd_gauss(attitude_wxyz: Quat) -> Vec3:
    """Return the magnetic field in gauss in the body frame (FRD), given the attitude (body FLU to world ENU)."""
    north, east, down = _FIELD_NED_GAUSS
    forward, left, up = quat_rotate(quat_conjugate(attitude_wxyz), (east, north, -down))
    return (forward, -left, -up)


class HilSensors:
    """Builds the HIL_SENSOR messages of one flight.

    PX4 does not boot without a magnetometer and a barometer, even if it does not fuse them, so both have plausible, noisy values.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._number = 0

    def message(self, imu: ImuSample, attitude_wxyz: Quat) -> Any:
        """Return the HIL_SENSOR message of one sample.

        Args:
            imu: IMU sample, with its time counted from PX4's first sample.
            attitude_wxyz: true attitude, body FLU to world ENU.
        """
        gauss = self._random.gauss
        fields = _ACCEL_AND_GYRO
        field: Vec3 = (0.0, 0.0, 0.0)
        pressure = altitude_m = 0.0
        if self._number % FIELD_EVERY == FIELD_OFFSET:
            fields |= _MAG
            x, y, z = field_frd_gauss(attitude_wxyz)
            field = (
                x + gauss(0.0, _FIELD_NOISE_GAUSS),
                y + gauss(0.0, _FIELD_NOISE_GAUSS),
                z + gauss(0.0, _FIELD_NOISE_GAUSS),
            )
        if imu.baro_m is not None:
            fields |= _BARO
            altitude_m = _GROUND_ALTITUDE_M + imu.baro_m
            pressure = pressure_hpa(altitude_m) + gauss(0.0, _PRESSURE_NOISE_HPA)
        self._number += 1
        return mavlink.MAVLink_hil_sensor_message(
            clock_us(imu.t_s), *imu.accel_frd_m_s2, *imu.gyro_frd_rad_s, *field, pressure, 0.0, altitude_m, _TEMPERATURE_C, fields
        )  # fmt: skip


def clock_us(t_s: float) -> int:
    """Return the time on PX4's clock in us, given the world time since PX4's first sample."""
    return round((t_s + CLOCK_ORIGIN_S) * 1e6)


class SimulatorLink:
    """The simulator's end of the TCP link; an async context manager. PX4 may disconnect and reconnect.

    Args:
        listener: listening socket to which PX4 connects, 127.0.0.1:4560 plus the instance number; closed with the link.
        rotors: number of rotors; HIL_ACTUATOR_CONTROLS carries up to 16.
    """

    def __init__(self, listener: socket.socket, sensors: HilSensors, rotors: int) -> None:
        self._stopped: RotorCommands = (0.0,) * rotors
        self.rotors = self._stopped
        """Rotor commands of the newest answer, 0 to 1, in PX4's order; 0 while disarmed."""
        self.armed = False
        self.answers = 0
        """Number of HIL_ACTUATOR_CONTROLS received since PX4 connected."""
        self.unanswered = 0
        """Number of samples that PX4 did not answer."""
        self.connections = 0
        self.clock_begun_s: float | None = None
        """World time of the connected PX4's first sample, at which its clock is `CLOCK_ORIGIN_S`; None before that sample."""
        self._listener = listener
        self._sensors = sensors
        self._server: asyncio.Server | None = None
        self._peer: _Peer | None = None
        self._encoder = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_SYSTEM_CONTROL)
        self._awaited_us: int | None = None
        self._answer = asyncio.Event()
        self._change = asyncio.Event()
        self._silent_s = 0.0
        self._idle = False
        """Whether PX4 is disarmed and does not answer. In OFFBOARD without setpoints, as after a flight, it computes no controls."""

    async def __aenter__(self) -> Self:
        self._server = await asyncio.get_running_loop().create_server(lambda: _Peer(self), sock=self._listener)
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._server is not None:
            self._server.close()
        if self._peer is not None:
            self._peer.close()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._peer.closed.wait()

    @property
    def port(self) -> int:
        """TCP port to which PX4 connects."""
        return int(self._listener.getsockname()[1])

    @property
    def connected(self) -> bool:
        """Whether a PX4 is connected."""
        return self._peer is not None

    @property
    def in_step(self) -> bool:
        """Whether PX4 has begun to answer samples, which shows that its modules are running."""
        return self._peer is not None and self.answers > 0

    async def await_lockstep(self, deadline_s: float) -> bool:
        """Wait for PX4's first answer while samples are being sent; return False at the timeout."""
        return await self._until(lambda: self.in_step, deadline_s)

    async def await_disconnect(self, deadline_s: float) -> bool:
        """Wait until PX4 has disconnected; return False at the timeout."""
        return await self._until(lambda: not self.connected, deadline_s)

    async def _until(self, reached: Any, deadline_s: float) -> bool:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(deadline_s):
                while not reached():
                    self._change.clear()
                    await self._change.wait()
        return bool(reached())

    def send(self, imu: ImuSample, attitude_wxyz: Quat) -> None:
        """Send one sample to PX4, if one is connected; `answered` waits for the answer."""
        if self._peer is None:
            return
        if self.clock_begun_s is None:
            self.clock_begun_s = imu.t_s
        message = self._sensors.message(imu._replace(t_s=imu.t_s - self.clock_begun_s), attitude_wxyz)
        # A PX4 that is booting or idle does not answer.
        self._awaited_us = int(message.time_usec) if self.answers and not self._idle else None
        self._peer.write(message.pack(self._encoder))
        self._encoder.seq = (self._encoder.seq + 1) % 256

    @property
    def pending(self) -> bool:
        """Whether the newest sample is still unanswered."""
        return self._awaited_us is not None

    async def answered(self) -> None:
        """Wait until PX4 has answered the newest sample or has disconnected, but at most `ANSWER_PATIENCE_S`.

        After such a timeout, answers of a disarmed PX4 are not awaited until it answers again.

        Raises:
            Px4Error: an armed PX4 has not answered for `ANSWER_DEADLINE_S`.
        """
        while self._awaited_us is not None:
            self._answer.clear()
            try:
                async with asyncio.timeout(ANSWER_PATIENCE_S):
                    await self._answer.wait()
            except TimeoutError:
                self.unanswered += 1
                self._silent_s += ANSWER_PATIENCE_S
                self._awaited_us = None
                self._idle = not self.armed
                if self._silent_s >= ANSWER_DEADLINE_S:
                    raise Px4Error(
                        f"PX4: expected an answer to every HIL_SENSOR (lockstep), found none for {ANSWER_DEADLINE_S:g} s; "
                        "PX4 hangs, or the computer is too slow for PX4"
                    ) from None

    # -- called by the peer --------------------------------------------------------------------------------------

    def attach(self, peer: _Peer) -> bool:
        """Accept a connection from PX4; return False if another PX4 is connected."""
        if self._peer is not None:
            return False
        self._peer = peer
        self.connections += 1
        self.clock_begun_s = None
        self.answers = 0
        self._silent_s = 0.0
        self._idle = False
        self._change.set()
        return True

    def detach(self, peer: _Peer) -> None:
        """Handle the disconnection of PX4 and stop the rotors."""
        if self._peer is not peer:
            return
        self._peer = None
        self.rotors, self.armed, self.answers = self._stopped, False, 0
        self._awaited_us = None
        self._answer.set()
        self._change.set()

    def take(self, message: Any) -> None:
        """Handle one message from PX4."""
        if message.get_type() != "HIL_ACTUATOR_CONTROLS":
            return
        self.answers += 1
        self._idle = False
        if self.answers == 1:
            self._change.set()
        self.armed = bool(message.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.rotors = tuple([min(1.0, max(0.0, value)) for value in message.controls[: len(self._stopped)]])
        if self._awaited_us is not None and message.time_usec >= self._awaited_us:
            self._awaited_us = None
            self._silent_s = 0.0
            self._answer.set()


class _Peer(asyncio.Protocol):
    """One TCP connection from PX4."""

    def __init__(self, link: SimulatorLink) -> None:
        self.closed = asyncio.Event()
        self._link = link
        self._transport: asyncio.Transport | None = None
        self._decoder = mavlink.MAVLink(None)
        self._decoder.robust_parsing = True

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Attach the new connection to the link, or abort it if another PX4 is connected."""
        self._transport = cast(asyncio.Transport, transport)
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if not self._link.attach(self):
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Detach the closed connection from the link."""
        self._transport = None
        self._link.detach(self)
        self.closed.set()

    def data_received(self, data: bytes) -> None:
        """Decode the received messages, which may arrive in parts, and pass them to the link."""
        for message in self._decoder.parse_buffer(data) or ():
            self._link.take(message)

    def write(self, data: bytes) -> None:
        """Send bytes, if the connection is open."""
        if self._transport is not None:
            self._transport.write(data)

    def close(self) -> None:
        """Close the connection at once."""
        if self._transport is not None:
            self._transport.abort()
