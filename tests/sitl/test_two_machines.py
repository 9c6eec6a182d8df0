"""One world with two machines: each has wires of its own, motion capture sees both, and time starts over for both at once."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from companion.analysis.pair import PairFigures
from companion.model.types import Vec3
from companion.runtime.simulated_time import Descriptors, Page, SimulatedTime
from companion.sitl_config.faults import Fault
from companion.sitl_config.team import load_team
from sitl.faults.processes import inject_process_fault
from sitl.lockstep import MachineTime, TimeKeeper
from sitl.natnet import BodyPose
from sitl.server import Sitl
from sitl.wires import MachineWires, Ports
from sitl.world.pair import pair_scene
from sitl.world.start import start_of
from tests.support import DEADLINE_S, wait_until


def server_of(*overrides: str) -> Sitl:
    configs = [config for _, config in load_team("carry", overrides).members]
    machines = [
        MachineWires(
            each.vehicle,
            each.world,
            start_of(each.mission.start.position_m, each.mission.start.yaw_deg, each.mission.start.arm_deg),
            Ports(),
            lambda _: None,
        )
        for each in configs
    ]
    return Sitl(machines, make_scene=lambda: pair_scene(configs))


def run_for(server: Sitl, steps: int) -> tuple[list[dict[str, dict[str, object]]], list[list[BodyPose]]]:
    """Step a server with open wires; return the addresses and the bodies of each frame."""
    frames: list[list[BodyPose]] = []

    async def run() -> list[dict[str, dict[str, object]]]:
        async with server.wires() as devices:
            assert server.mocap is not None
            server.mocap.publish = lambda t_s, poses, exposure_t_s, **_: frames.append(list(poses))  # type: ignore[method-assign]
            for _ in range(steps):
                server._step()
                await asyncio.sleep(0.0)
            return list(devices)

    return asyncio.run(run()), frames


def test_each_machine_has_wires_of_its_own_and_one_server_sees_both() -> None:
    server = server_of("world.mocap_noise_m=0.0")
    (left, right), frames = run_for(server, 50)
    for device, key in (("autopilot", "address"), ("arm", "port"), ("force", "port")):
        assert left[device][key] != right[device][key]
    assert left["mocap"] == right["mocap"]
    assert frames
    for frame in frames:
        seen = {pose.id: pose.position_m for pose in frame}
        for machine in server.machines:
            x, y, z = seen[machine.vehicle.devices.mocap.rigid_body_id]
            assert math.dist((x, y, z), machine.plant.truth.position_world_m) < 0.05
    assert server.bar is not None
    samples = server.bar.report().samples
    assert [sample.t_s for sample in samples] == pytest.approx([0.002 + 0.02 * n for n in range(5)])
    assert not any(sample.gripped for sample in samples)


def test_a_machine_whose_poses_are_lost_is_missing_in_the_frames() -> None:
    server = server_of()
    right = server.machines[1]
    right.faults.active["mocap_loss"] = Fault(kind="mocap_loss", t_s=0.0, after="start")
    right.plant.inject(right.faults)
    _, frames = run_for(server, 20)
    ids = {pose.id for frame in frames for pose in frame}
    assert server.machines[0].vehicle.devices.mocap.rigid_body_id in ids
    assert right.vehicle.devices.mocap.rigid_body_id not in ids


@pytest.fixture
def pair() -> Iterator[tuple[TimeKeeper, list[SimulatedTime]]]:
    machines, processes = [], []
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            page = Page.create()
            world, process = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            stack.enter_context(world)
            machines.append(MachineTime(Page(page), {"flight": world}))
            processes.append(SimulatedTime(Descriptors(page, process.detach())))
            stack.callback(processes[-1].close)
            os.close(page)
        yield TimeKeeper(machines, float("inf")), processes


def read(keeper: TimeKeeper) -> None:
    for machine in keeper.machines:
        machine.processes["flight"].read()


def begin(process: SimulatedTime) -> None:
    process.begins = True
    process.report(0.0)


@pytest.mark.parametrize("other_ends", [False, True], ids=["the other asks later", "the other ends"])
def test_time_starts_over_once_when_both_have_asked(
    pair: tuple[TimeKeeper, list[SimulatedTime]], other_ends: bool
) -> None:
    keeper, (left, right) = pair
    keeper.set(-5.0)
    assert (left.now(), right.now()) == (-5.0, -5.0)
    begin(left)
    right.report(0.0)
    read(keeper)
    assert not keeper.begins()
    if other_ends:
        right.close()
    else:
        begin(right)
    read(keeper)
    assert keeper.begins()
    assert not keeper.begins()


def test_figures_of_a_bar_that_is_stretched_tilted_and_beside_its_place() -> None:
    figures = PairFigures()
    tilt_rad = 0.1
    attitude = (math.cos(tilt_rad / 2), 0.0, -math.sin(tilt_rad / 2), 0.0)  # the left end is up
    along = (math.cos(tilt_rad), 0.0, math.sin(tilt_rad))

    def pull(sign: float, lift_n: float) -> Vec3:
        x, _, z = along
        return (sign * 2.0 * x, 0.0, sign * 2.0 * z + lift_n)

    figures.add((0.0, 0.03, 1.0), attitude, [pull(1.0, 3.0), pull(-1.0, 1.0)], (0.0, 0.0, 1.0))
    found = figures.report(0.2)
    assert found["bar_p_rms_m"] == pytest.approx(0.03)
    assert found["bar_tilt_rms_deg"] == pytest.approx(math.degrees(tilt_rad))
    assert found["internal_force_rms_n"] == pytest.approx(2.0 + 0.5 * (3.0 - 1.0) * math.sin(tilt_rad))
    assert found["share"] == pytest.approx((3.0 + 2.0 * along[2]) / 4.0)
    assert found["let_go"] == 0.2
    assert PairFigures().report(None) == dict.fromkeys(found)


def test_the_guardian_that_is_killed_is_that_of_the_same_vehicle(monkeypatch: pytest.MonkeyPatch) -> None:
    def process(*words: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", *words])

    with contextlib.ExitStack() as stack:
        guardians = [stack.enter_context(process("companion.guardian", "--config", end)) for end in ("left", "right")]
        flight = stack.enter_context(process("companion.flight.main", "--config", "right"))
        for each in (*guardians, flight):
            stack.callback(each.kill)
        monkeypatch.setattr(os, "getppid", os.getpid)
        wait_until(lambda: inject_process_fault("kill_guardian", flight.pid), lambda: "no guardian found")
        assert guardians[1].wait(DEADLINE_S) != 0
        assert guardians[0].poll() is None
