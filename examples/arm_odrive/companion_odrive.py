"""An arm on ODrive motor controllers (firmware 0.6) over CAN. It has not been tried with a real ODrive yet.

CANSimple protocol: the id of a frame is node << 5 | command, and a remote frame asks for a value (Get_*); an axis state comes only in
HEARTBEAT, which every ODrive sends by itself (`axis0.config.can.heartbeat_msg_rate_ms`, 100 by default). Little endian. Angles are
turns and torques N m of the motor; `gear_ratio` relates them to the output shaft.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Sequence

from companion.config.arm import Joint
from companion.config.base import Model, Positive
from companion.config.devices import ArmDevice
from companion.io.arm.motors import MotorState

VERSION, HEARTBEAT, ERROR, STATE, ENCODER, MODE = 0x00, 0x01, 0x03, 0x07, 0x09, 0x0B
TORQUE, TEMPERATURE, CLEAR_ERRORS, TORQUES = 0x0E, 0x15, 0x18, 0x1C
IDLE, CLOSED_LOOP, TORQUE_CONTROL, PASSTHROUGH = 1, 8, 1, 1
REMOTE = 0x40000000
FRAME = struct.Struct("<IB3x8s")
"""struct can_frame of Linux."""
_START_TIMEOUT_S = 1.0
_TEMPERATURE_EVERY = 100


class ODriveOptions(Model):
    """ODrive motor controllers on CAN."""

    channel: str = "can0"
    gear_ratio: Positive = 1.0
    """Turns of the motor per turn of the joint."""
    reply_timeout_s: Positive = 0.004
    watchdog_timeout_s: Positive
    """axis0.config.watchdog_timeout of every ODrive, with enable_watchdog: set them with odrivetool, and try them."""


def can_socket(channel: str) -> socket.socket:
    """Return an open raw socket on a CAN interface."""
    opened = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    opened.bind((channel,))
    return opened


class ODriveArm:
    """One ODrive for each joint; `servo_id` of the joint is its node id."""

    options = ODriveOptions
    product_name = "ODrive"
    watchdog = "the ODrives' own watchdogs, as set with odrivetool (not read)"

    def __init__(self, options: ODriveOptions, device: ArmDevice, joints: Sequence[Joint]) -> None:
        self.watchdog_ms = 1e3 * options.watchdog_timeout_s
        self._nodes = [joint.servo_id for joint in joints]
        self._gear = options.gear_ratio
        self._reply_timeout_s = options.reply_timeout_s
        self._cycle = 0
        self._temperatures_c: list[float] = [0.0] * len(joints)
        self._states: dict[int, int] = {}
        """Axis state in the newest HEARTBEAT of each node."""
        self._can = can_socket(options.channel)

    def open(self) -> None:
        """Check that every ODrive answers, and switch torque control on with torque 0."""
        versions = [data[4:7] for (data,) in self._ask([VERSION], _START_TIMEOUT_S)]
        self.product_name = "ODrive, firmware " + " and ".join(".".join(map(str, version)) for version in versions)
        for node in self._nodes:
            self._send(node, CLEAR_ERRORS, bytes(1))
            self._send(node, MODE, struct.pack("<II", TORQUE_CONTROL, PASSTHROUGH))
            self._send(node, TORQUE, struct.pack("<f", 0.0))
            self._send(node, STATE, struct.pack("<I", CLOSED_LOOP))
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while states := {self._states.get(node) for node in self._nodes} - {CLOSED_LOOP}:
            if time.monotonic() > deadline_s:
                raise RuntimeError(f"axis states {states}, expected {CLOSED_LOOP} (closed loop); odrivetool shows why")
            self.write_torque([0.0] * len(self._nodes))  # feeds the watchdogs
            self._ask([ERROR])

    def read(self) -> list[MotorState]:
        """Ask every ODrive for angle, rate, torque and errors, and now and then for its temperature."""
        wanted = [ENCODER, TORQUES, ERROR]
        if self._cycle % _TEMPERATURE_EVERY == 0:
            wanted.append(TEMPERATURE)
        self._cycle += 1
        states = []
        for number, (encoder, torques, error, *temperature) in enumerate(self._ask(wanted)):
            turns, turns_s = struct.unpack("<ff", encoder)
            if temperature:
                self._temperatures_c[number] = max(struct.unpack("<ff", temperature[0]))
            active, reason = struct.unpack("<II", error)
            states.append(
                MotorState(
                    angle_rad=2.0 * math.pi * turns / self._gear,
                    velocity_rad_s=2.0 * math.pi * turns_s / self._gear,
                    torque_nm=struct.unpack("<ff", torques)[1] * self._gear,
                    temperature_c=self._temperatures_c[number],
                    error=f"active errors {active:#x}, disarmed by {reason:#x}" if active or reason else "",
                )
            )
        return states

    def write_torque(self, torque_nm: Sequence[float]) -> None:
        """Command the torques, which also feeds the watchdogs."""
        for node, nm in zip(self._nodes, torque_nm, strict=True):
            self._send(node, TORQUE, struct.pack("<f", nm / self._gear))

    def torque_off(self) -> None:
        """Set every axis idle."""
        for node in self._nodes:
            self._send(node, STATE, struct.pack("<I", IDLE))

    def close(self) -> None:
        """Close the socket."""
        self._can.close()

    def _send(self, node: int, command: int, data: bytes = b"", remote: int = 0) -> None:
        self._can.send(FRAME.pack(node << 5 | command | remote, 8 if remote else len(data), data))

    def _receive(self) -> tuple[int, int, bytes]:
        """Return id, size and data of the next frame."""
        identity, size, data = FRAME.unpack(self._can.recv(FRAME.size))
        if identity & 0x1F == HEARTBEAT and not identity & REMOTE:
            self._states[identity >> 5] = data[4]
        return identity, size, data

    def _ask(self, commands: Sequence[int], timeout_s: float = 0.0) -> list[list[bytes]]:
        """Ask every node for these values; return its answers in the order of the nodes and commands. Frames that have arrived before
        are dropped: late answers, which would be taken for new ones in this and every later cycle, and cyclic messages.
        """
        self._can.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._receive()
        wanted = [node << 5 | command for node in self._nodes for command in commands]
        for node in self._nodes:
            for command in commands:
                self._send(node, command, remote=REMOTE)
        answers: dict[int, bytes] = {}
        timeout_s = timeout_s or self._reply_timeout_s
        deadline_s = time.monotonic() + timeout_s
        while not answers.keys() >= set(wanted):
            self._can.settimeout(max(1e-6, deadline_s - time.monotonic()))
            try:
                identity, size, data = self._receive()
            except TimeoutError:
                silent = sorted({identity >> 5 for identity in set(wanted) - answers.keys()})
                raise TimeoutError(f"no answer from nodes {silent} within {1e3 * timeout_s:g} ms") from None
            if identity in wanted and size == 8:
                answers[identity] = data
        return [[answers[node << 5 | command] for command in commands] for node in self._nodes]
