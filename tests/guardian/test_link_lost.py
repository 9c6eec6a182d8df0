"""The guardian with forged messages, a lost link, and a flight process that does not die at once."""

from __future__ import annotations

import json
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.guardian.mocap import GuardianMocap
from companion.io.mocap.system import MocapSettings
from companion.model.types import MocapPose
from sitl.natnet import BodyPose, encode_frame
from tests.guardian.rig import ARMED, ATTITUDE, DISARMED, LAND_MODE, OFFBOARD_MODE, Cameras, Rig
from tests.support import DEADLINE_S, wait_until
from tests.wires import plugged, serial_line

NAV_LAND = mavlink.MAV_CMD_NAV_LAND

_HOOK = """
import sys

if "companion.guardian" in sys.orig_argv:
    import atexit, json
    import companion.guardian.process as process

    class Counting(process.TakeoverLanding):
        rounds = steps = 0

        def take_messages(self, *arguments):
            Counting.rounds += 1
            super().take_messages(*arguments)

        def step(self, *arguments):
            Counting.steps += 1
            super().step(*arguments)

    process.TakeoverLanding = Counting
    atexit.register(lambda: open({file!r}, "w").write(json.dumps([Counting.rounds, Counting.steps])))
    if {immortal}:
        process.FlightProcess.kill = lambda self: None
"""


def install_hook(folder: Path, monkeypatch: pytest.MonkeyPatch, *, immortal: bool = False) -> Path:
    """Count the rounds of the guardian's loop; `immortal` delays SIGKILL, as for a process inside the kernel."""
    hooks = folder / "hooks"
    hooks.mkdir()
    counts = folder / "counts.json"
    (hooks / "sitecustomize.py").write_text(_HOOK.format(file=str(counts), immortal=immortal), encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(hooks), os.environ.get("PYTHONPATH")))))
    return counts


def heartbeat(base_mode: int, custom_mode: int) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, 12, base_mode, custom_mode, 4, 3)
    packed: bytes = message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    return packed


class Px4Cable:
    """PX4's end of a serial cable, under a fixed name as in /dev/serial/by-id."""

    def __init__(self, name: Path) -> None:
        self._name = name
        self._decoder = mavlink.MAVLink(None)
        self._decoder.robust_parsing = True
        self.commands: list[int] = []

    @contextmanager
    def plugged(self) -> Iterator[int]:
        self.commands.clear()
        with serial_line() as (master, port), plugged(self._name, port):
            os.set_blocking(master, False)
            yield master

    def hears(self, master: int, base_mode: int, custom_mode: int) -> list[int]:
        """Send a HEARTBEAT; return the commands received so far."""
        try:
            os.write(master, heartbeat(base_mode, custom_mode))
            data = os.read(master, 65536)
        except OSError:  # nothing there, or nobody has opened the other end
            return self.commands
        found = self._decoder.parse_buffer(data) or []
        self.commands += [message.command for message in found if message.get_type() == "COMMAND_LONG"]
        return self.commands


def test_a_forged_disarmed_heartbeat_does_not_end_the_landing(tmp_path: Path) -> None:
    with Rig(tmp_path) as rig, closing(socket.socket(type=socket.SOCK_DGRAM)) as forger:
        rig.beat_until_ready()

        def forged_until_commanded() -> bool:
            forger.sendto(heartbeat(DISARMED, LAND_MODE), ("127.0.0.1", rig.port))
            return len(rig.peer.commands(NAV_LAND)) >= 4

        rig.peer.acks[NAV_LAND] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        os.kill(rig.flight.pid, signal.SIGKILL)
        wait_until(forged_until_commanded, rig.log.read_text)
        assert rig.guardian.poll() is None, rig.log.read_text()
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.events[-1] == "guardian_landed"


def test_a_cable_that_hangs_up_costs_no_more_rounds_and_is_taken_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counts = install_hook(tmp_path, monkeypatch)
    cable = Px4Cable(tmp_path / "autopilot")
    with Rig(tmp_path, address=f"serial://{tmp_path / 'autopilot'}:921600") as rig:
        with cable.plugged() as master:
            rig.beat_until_ready()
            rig.flight.kill()
            wait_until(lambda: NAV_LAND in cable.hears(master, ARMED, OFFBOARD_MODE), rig.log.read_text)
        wait_until(lambda: "guardian_no_link" in rig.events, rig.log.read_text)
        assert "the connection has ended; trying again" in rig.log.read_text()
        with cable.plugged() as master:
            wait_until(lambda: NAV_LAND in cable.hears(master, ARMED, OFFBOARD_MODE), rig.log.read_text)
            wait_until(
                lambda: bool(cable.hears(master, DISARMED, LAND_MODE)) and rig.result is not None, rig.log.read_text
            )
            assert rig.guardian.wait(DEADLINE_S) == 0
        assert rig.events.count("guardian_no_link") == 1
    rounds, steps = json.loads(counts.read_text())
    # A step takes its 10 ms; motion capture wakes the loop once in that time, a message of PX4 now and then.
    assert rounds < 10 * steps


def test_nothing_is_opened_beside_a_flight_process_that_still_lives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_hook(tmp_path, monkeypatch, immortal=True)
    cable = Px4Cable(tmp_path / "autopilot")
    with cable.plugged() as master, Rig(tmp_path, address=f"serial://{tmp_path / 'autopilot'}:921600") as rig:
        rig.beat_until_ready()
        wait_until(lambda: "guardian_no_link" in rig.events, rig.log.read_text)
        assert "the killed flight process still holds the link" in rig.log.read_text()
        open_files = [os.readlink(one) for one in Path(f"/proc/{rig.guardian.pid}/fd").iterdir()]
        assert os.path.realpath(tmp_path / "autopilot") not in open_files
        rig.flight.kill()
        wait_until(lambda: NAV_LAND in cable.hears(master, ARMED, OFFBOARD_MODE), rig.log.read_text)


def test_over_udp_it_lands_beside_a_killed_flight_process_that_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of its threads is in uninterruptible sleep; the guardian once waited 30 s for it."""
    install_hook(tmp_path, monkeypatch, immortal=True)
    with Rig(tmp_path) as rig:
        rig.beat_until_ready()
        wait_until(lambda: bool(rig.peer.commands(NAV_LAND)), rig.log.read_text)
        rig.land()
        assert rig.guardian.wait(DEADLINE_S) == 0, rig.log.read_text()
        assert rig.flight.poll() is None, "it has not ended"
        assert "the flight process was killed but has not ended" in rig.log.read_text()
        assert "guardian_no_link" not in rig.events
        assert rig.events[-1] == "guardian_landed", "it hears PX4"


def test_of_two_streams_of_motion_capture_at_one_address_none_is_passed_on() -> None:
    with Cameras(1) as cameras, closing(socket.socket(type=socket.SOCK_DGRAM)) as forger:
        settings = MocapSettings(
            server="127.0.0.1",
            interface="127.0.0.1",
            transport="unicast",
            multicast_group="239.255.42.99",
            command_port=cameras.port,
            data_port=1511,
            rigid_body_id=1,
            up_axis="z",
        )
        with closing(GuardianMocap(settings)) as client:
            seen: list[MocapPose] = []

            def read() -> bool:
                client.keep_connected()
                seen.extend(client.poses())
                return len(seen) > 10

            wait_until(read, lambda: f"no poses: {client.problem}")
            assert client.problem is None
            ours = client.sockets[0].getsockname()
            number = 1_000_000

            def forged() -> bool:
                nonlocal number
                number += 1
                body = BodyPose(1, (0.0, 0.0, 1.0), ATTITUDE)
                forger.sendto(encode_frame("4.1", number, 1.0, (body,), None, {}), ours)
                seen.clear()
                read()
                return client.problem is not None and "two servers at one address" in client.problem and not seen

            wait_until(forged, lambda: f"{client.problem}, {seen[-1:]}")
