"""Flight and guardian hang together in the air, over real wires; a new `companion fly` finds what they left."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path
from typing import Any

from companion.analysis.log import FlightLog
from companion.model.exit_codes import EXIT_ABORTED, EXIT_LOST
from companion.model.types import AutopilotRequest
from tests.support import HOVER, Sandbox, World, read_summary, set_options, wait_until

HIGH = set_options(**{"mission.phases[0].height_m": 1.2, "mission.phases[0].duration_s": 3.0})
SLOW = "world.px4_params={MPC_LAND_SPEED: 0.3}"
"""PX4's own landing takes longer than a busy computer takes to start the next companion."""


def ids(summary: dict[str, Any]) -> list[str]:
    return [event["id"] for event in summary["events"]]


def test_hung_beside_a_hung_guardian_and_started_again_without_the_arm_it_lands_what_it_finds(sandbox: Sandbox) -> None:
    """The launcher kills both and reports it. With the arm: tests/core/test_armed_externally.py."""
    with World(sandbox, HOVER, ["world.payload_kg=0", SLOW]) as world:
        with sandbox.start("fly", HOVER, "--out", "first", *HIGH, *world.addresses()) as first:
            first.wait_for("  hold\n")
            for name in ("guardian.pid", "flight.pid"):
                os.kill(int((sandbox.cwd / "first" / name).read_text()), signal.SIGSTOP)
            # The world, PX4, physics and all, stands still until the next companion speaks to PX4.
            world.process.send_signal(signal.SIGSTOP)
            hung = first.end()
        assert hung.code == EXIT_LOST, (hung.out, hung.err)
        assert "flight: the flight process sent nothing for 5 s and was killed" in hung.err
        assert "guardian: the guardian process hung and was killed" in hung.err
        assert read_summary(sandbox.cwd / "first")["outcome"] == "lost"
        # Limp, the arm may hang past its walls, and then its edge refuses it.
        walls = set_options(**{"vehicle.arm.joints[1].angle_deg": [-170.0, 150.0]})
        addresses = world.addresses(arm={"port": "/dev/pts/none"})
        with sandbox.start("fly", HOVER, "--out", "second", *walls, *addresses) as second:
            flight_pid = sandbox.cwd / "second/flight.pid"
            wait_until(flight_pid.exists, lambda: "no flight process")
            pid = int(flight_pid.read_text())
            wait_until(lambda: has_udp_socket(pid), lambda: (sandbox.cwd / "second/flight.log").read_text())
            world.process.send_signal(signal.SIGCONT)
            ended = second.end()
        assert ended.code == EXIT_ABORTED, (ended.out, ended.err)
        summary = read_summary(sandbox.cwd / "second")
        assert ids(summary)[0] == "armed_externally", ids(summary)
        assert "but not by the companion" in ended.out
        assert "takeoff" not in ids(summary)
        log = FlightLog.read(sandbox.cwd / "second/flight.mcap")
        asked = {o.request for o in log.outputs}
        assert not asked & {AutopilotRequest.ARM} and AutopilotRequest.LAND in asked
        assert all(o.attitude is None or o.attitude.thrust == 0.0 for o in log.outputs)
        assert all(o.arm_torque_nm is None for o in log.outputs)
        assert "landing without this device: arm bus" in ended.out
        assert any(i.mocap is not None for i in log.inputs) and all(o.mocap_trusted for o in log.outputs)
        assert world.armings == 1 and not world.crashes
        wait_until(lambda: at_rest(world), lambda: str(world.messages[-3:]))
    sandbox.assert_nobody_left()


def at_rest(world: World) -> bool:
    rests = [message["at_rest"] for message in world.messages if message["type"] == "WorldAtRest"]
    return bool(rests) and rests[-1]


def has_udp_socket(pid: int) -> bool:
    """The flight process opens its devices: motion capture first."""
    own = set()
    for name in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):  # closed while we looked
            own.add(os.readlink(name))
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return any(f"socket:[{row[9]}]" in own for row in rows)
