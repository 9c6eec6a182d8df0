"""The simulated devices in one process on simulated time: what they send over their wires in a short flight.

The event loop runs on world time, so that the same world gives the same bytes. A pilot in the test flies the vehicle through the stub
and the servo bus.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from pymavlink.dialects.v20 import common as mavlink

from companion.io.force_torque import rft
from companion.io.mocap.natnet import Message
from companion.model.frames import attitude_ned_frd_from_enu_flu, ned_from_enu, quat_from_euler_zyx
from companion.sitl_config.loader import SitlConfig
from sitl.autopilot.backend import StubBackend
from sitl.autopilot.commander import Command
from sitl.autopilot.mavlink import Ports as LinkPorts
from sitl.autopilot.types import AttitudeTarget
from sitl.faults.timing import with_fault_times
from sitl.server import Ports, Sitl, start_of
from sitl.servo import registers as reg
from sitl.servo.protocol import Instruction, packet
from sitl.world.plant import Plant
from tests.support import DEADLINE_S

START_M = (-0.2, 0.0)
OFFBOARD = (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0)
STREAM_S, MODE_S, ARM_S, UP_S = 0.3, 0.5, 0.6, 0.75
END_STEPS = 1500
"""Physics steps of a whole flight, including the catch."""
PERIOD_STEPS = 5
_LAST_BYTES_S = 0.05
NM_PER_COUNT = 1.3 * 2.69e-3

BAUD_BPS = 3_000_000


@dataclass(frozen=True)
class Emitted:
    """What the devices send."""

    steps: tuple[tuple[Any, ...], ...]
    """Per physics step: MAVLink, NatNet, servo bus, and faults of processes."""
    force: bytes
    """Whole stream of the force sensor; the kernel decides when its bytes arrive."""

    def goes_on_as(self, steps: Sequence[tuple[Any, ...]], force: bytes) -> bool:
        """Return whether the newest step and the bytes so far equal those of this flight."""
        return steps[-1] == self.steps[len(steps) - 1] and self.force.startswith(force)


class WorldLoop(asyncio.SelectorEventLoop):
    """An event loop on the world's time."""

    t_s = 0.0

    def time(self) -> float:
        """World time."""
        return self.t_s


def emitted(config: SitlConfig, end: int, usual: Emitted | None = None) -> Emitted:
    """Return what the devices send in `end` physics steps.

    The flight ends at the first step that differs from `usual`.
    """
    with asyncio.Runner(loop_factory=WorldLoop) as runner:
        return runner.run(_emitted(with_fault_times(config), end, usual))


async def _emitted(config: SitlConfig, end: int, usual: Emitted | None) -> Emitted:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, WorldLoop)
    events: list[Any] = []
    autopilot = StubBackend(config.vehicle.airframe, config.world, LinkPorts(0, 0))
    start = start_of(START_M, 0.0, config.mission.start.arm_deg)
    sitl = Sitl(config.vehicle, config.world, start, Ports(), events.append, autopilot)
    steps: list[tuple[Any, ...]] = []
    with _flight_process() as process:
        sitl.flight.pid = process.pid
        async with sitl.wires() as devices:
            with contextlib.closing(Partner(sitl, devices)) as partner:
                pilot = Pilot(config, autopilot, sitl.plant, partner)
                await partner.all_hear()
                for step in range(end):
                    loop.t_s = sitl.plant.t_s
                    pilot.step(step)
                    sitl._step()
                    for _ in range(3):
                        await asyncio.sleep(0)
                    fate = (sitl.flight.kind, sorted(sitl._injected), tuple(map(str, events)))
                    steps.append((*partner.heard(), fate))
                    if usual is not None and not usual.goes_on_as(steps, partner.force):
                        break
                else:
                    partner.read_force(_LAST_BYTES_S)
    return Emitted(tuple(steps), partner.force)


@contextlib.contextmanager
def _flight_process() -> Iterator[subprocess.Popen[bytes]]:
    """Run a process in place of the flight process."""
    process = subprocess.Popen(["sleep", "600"])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


async def turns_until(done: Callable[[], bool]) -> None:
    """Let the event loop run until the condition holds."""
    give_up_s = time.monotonic() + DEADLINE_S
    while not done():
        assert time.monotonic() < give_up_s
        await asyncio.sleep(0)


class Partner:
    """The other end of the four wires: requests data from each device and records every byte."""

    def __init__(self, sitl: Sitl, devices: dict[str, dict[str, Any]]) -> None:
        autopilot, mocap = urlsplit(devices["autopilot"]["address"]), devices["mocap"]
        assert sitl.bus is not None
        self._bus, self._sensor = sitl.bus, sitl.force
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        link, frames = self._sockets
        for opened in self._sockets:
            opened.setblocking(False)
        link.connect((autopilot.hostname, autopilot.port))
        for data in _from_a_ground_station():
            link.send(data)
        for message in (Message.KEEP_ALIVE, Message.REQUEST_MODELDEF):
            frames.sendto(struct.pack("<HH", message, 0), (mocap["server"], mocap["command_port"]))
        self._tty = os.open(devices["force"]["port"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._answers: list[tuple[bytes, float]] = []
        self.force = b""
        """Bytes that the force sensor sent."""

    async def all_hear(self) -> None:
        """Start the force sensor's stream, and let every device read what was sent so far."""
        os.write(self._tty, rft.pack(bytes((rft.Command.START,)), rft.COMMAND_BYTES))
        sensor = self._sensor
        assert sensor is not None
        await turns_until(lambda: sensor.streaming)
        for _ in range(20):  # the event loop takes a datagram in a turn
            await asyncio.sleep(0)

    def to_servos(self, data: bytes) -> None:
        """Write a packet on the servo bus."""
        self._answers.append(self._bus.answer_to(data, BAUD_BPS))

    def heard(self) -> tuple[Any, ...]:
        """Return what arrived on each wire since the last call."""
        answers, self._answers = tuple(self._answers), []
        self.read_force(0.0)
        return (*map(_received, self._sockets), answers)

    def read_force(self, within_s: float) -> None:
        """Read the force sensor until nothing has arrived for `within_s`."""
        while select.select([self._tty], [], [], within_s)[0]:
            self.force += os.read(self._tty, 65535)

    def close(self) -> None:
        """Close everything."""
        for opened in self._sockets:
            opened.close()
        os.close(self._tty)


def _from_a_ground_station() -> list[bytes]:
    kind, state = mavlink.MAV_TYPE_GCS, mavlink.MAV_STATE_ACTIVE
    encoder = mavlink.MAVLink(None, srcSystem=245, srcComponent=190)
    heartbeat = mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, state, 3)
    return [bytes(heartbeat.pack(encoder)), bytes(mavlink.MAVLink_param_request_list_message(1, 1).pack(encoder))]


def _received(opened: socket.socket) -> bytes:
    data = b""
    with contextlib.suppress(BlockingIOError):
        while True:
            data += opened.recv(65535)
    return data


class Pilot:
    """Takes off, flies in +x through the catch and holds the arm; does not arm while the vehicle is handled."""

    def __init__(self, config: SitlConfig, autopilot: StubBackend, plant: Plant, partner: Partner) -> None:
        self._joints, self._arm_rad = config.vehicle.arm.joints, plant.world.q[slice(*_span(plant))]
        self._px4, self._plant, self._partner = autopilot.px4, plant, partner
        self._arms = not config.world.hand
        self._hover = config.vehicle.airframe.mass_kg * 9.81 / config.vehicle.airframe.thrust_max_n

    def step(self, step: int) -> None:
        """Act before each physics step."""
        if step % PERIOD_STEPS:
            return
        period, t_s = step // PERIOD_STEPS, self._plant.t_s
        if period < len(_SET_UP):
            for joint in self._joints:
                self._partner.to_servos(packet(joint.servo_id, _SET_UP[period]))
        else:
            self._hold_arm(period)
        self._fly(t_s)

    def _hold_arm(self, period: int) -> None:
        q, v, layout = self._plant.world.q, self._plant.world.v, self._plant.world.layout
        for joint, wanted, place, speed in zip(
            self._joints, self._arm_rad, layout.joint_q, layout.joint_v, strict=True
        ):
            torque_nm = 4.0 * (wanted - q[place]) - 0.3 * v[speed] + 0.01
            counts = max(-700, min(700, round(joint.sign * torque_nm / NM_PER_COUNT)))
            write = bytes((Instruction.WRITE, reg.GOAL_CURRENT.address, 0)) + struct.pack("<h", counts)
            self._partner.to_servos(packet(joint.servo_id, write))
        for joint in self._joints[period % 2 : period % 2 + 1]:
            self._partner.to_servos(packet(joint.servo_id, _READ_PRESENT))

    def _fly(self, t_s: float) -> None:
        px4, (x, y, z, *attitude) = self._px4, self._plant.world.q[0:7]
        vx, vy, vz = self._plant.world.v[0:3]
        turned = (attitude[0], attitude[1], attitude[2], attitude[3])
        px4.on_vision(t_s, ned_from_enu((x, y, z)), attitude_ned_frd_from_enu_flu(turned))
        if t_s < STREAM_S or not self._arms:
            return
        up = t_s >= UP_S
        thrust = self._hover * (1.0 + 0.5 * (0.9 - z) - 0.35 * vz) if up else 0.0
        pitch = max(-0.15, min(0.15, 0.3 * (0.4 - vx))) if z > 0.4 else 0.0
        roll = max(-0.15, min(0.15, 0.2 * y + 0.2 * vy))
        attitude_ned = attitude_ned_frd_from_enu_flu(quat_from_euler_zyx(roll, pitch, 0.0))
        px4.on_setpoint(t_s, AttitudeTarget(attitude_ned, max(0.0, min(0.9, thrust))))
        if abs(t_s - MODE_S) < 1e-6:
            px4.on_command(t_s, Command.DO_SET_MODE, OFFBOARD)
        if abs(t_s - ARM_S) < 1e-6:
            px4.on_command(t_s, Command.COMPONENT_ARM_DISARM, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


def _span(plant: Plant) -> tuple[int, int]:
    first, second = plant.world.layout.joint_q
    return first, second + 1


def _reading(address: int, size: int) -> bytes:
    return bytes((Instruction.READ, address & 0xFF, address >> 8, size & 0xFF, size >> 8))


def _writing(address: int, value: int) -> bytes:
    return bytes((Instruction.WRITE, address & 0xFF, address >> 8, value))


_READ_PRESENT = _reading(reg.PRESENT_CURRENT.address, 21)
"""Reads the present values up to the temperature."""
_SET_UP = (
    _writing(reg.LED.address, 1),
    *(_reading(register.address, register.size) for register in reg.REGISTERS if register.eeprom),
    _writing(reg.OPERATING_MODE.address, 0),
    _writing(reg.TORQUE_ENABLE.address, 1),
)
