"""A serial link to PX4 that is lost in the air. Other faults: tests/sitl/test_faults.py, and where they meet a wire,
tests/sitl/test_fault_wires.py; a flight over wires is that of the fast loop: test_lockstep.py.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from companion.model.exit_codes import EXIT_ABORTED
from tests.support import HOVER, Sandbox, World, read_summary
from tests.wires import bridged, plugged, serial_line


def test_a_serial_link_to_px4_that_comes_back_in_the_air_is_landed_and_not_lost(sandbox: Sandbox) -> None:
    name = sandbox.tmp.parent / "px4"
    with World(sandbox, HOVER, ["world.payload_kg=0"]) as world, ExitStack() as stack:
        px4 = ("127.0.0.1", int(world.devices["autopilot"]["address"].rpartition(":")[2]))
        udp = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))

        @contextmanager
        def cable() -> Iterator[None]:
            with serial_line() as (far, port), plugged(name, port), bridged(udp, px4, lambda: far):
                yield

        with cable():
            addresses = world.addresses(autopilot={"address": f"serial://{name}:921600"})
            flight = stack.enter_context(sandbox.start("fly", HOVER, "--out", "out", *addresses))
            flight.wait_for("  hold\n")
        flight.wait_for("no position, attitude or IMU sample")
        with cable():
            ended = flight.end()
        assert (ended.code, ended.err) == (EXIT_ABORTED, ""), (ended.out, ended.err)
        assert "the connection has ended" in ended.out and "the connection is open again" in ended.out
        assert read_summary(sandbox.cwd / "out")["outcome"] == "aborted"  # by the flight, without the guardian
        assert world.armings == 1 and not world.crashes
    sandbox.assert_nobody_left()
