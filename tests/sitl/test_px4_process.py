"""PX4 is found, gets a free instance and its own folder, and its end is reported. The binary is a test peer."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from sitl.autopilot.types import ImuSample
from sitl.px4.hil_link import HilSensors, Px4Error, SimulatorLink
from sitl.px4.process import Installation, Instance, Px4Process, find
from tests.sitl import px4_peer
from tests.support import DEADLINE_S


def installed(folder: Path, script: str = "") -> Path:
    """Return a folder like that of a build; its binary is the peer or another script."""
    (folder / "bin").mkdir(parents=True)
    (folder / "etc" / "init.d-posix").mkdir(parents=True)
    (folder / "etc" / "init.d-posix" / "rcS").touch()
    binary = folder / "bin" / "px4"
    binary.write_text(script or f'#!/bin/sh\nexec "{sys.executable}" "{px4_peer.__file__}" "$@"\n')
    binary.chmod(0o755)
    return folder


def test_it_is_found_by_folder_by_binary_and_on_the_path(tmp_path: Path) -> None:
    build = installed(tmp_path / "build")
    binary = build / "bin" / "px4"
    expected = Installation(binary, build / "etc")
    assert find({"PX4_SITL": str(build), "PATH": ""}) == expected
    assert find({"PX4_SITL": str(binary), "PATH": ""}) == expected
    assert find({"PATH": str(build / "bin")}) == expected
    assert find({"PATH": str(tmp_path)}) is None


def test_two_worlds_never_share_an_instance() -> None:
    with Instance.claim() as first, Instance.claim() as second:
        assert first.number < second.number
        assert {first.onboard_port, second.onboard_port} == {14540 + first.number, 14540 + second.number}
        with pytest.raises(Px4Error, match="found their ports in use"):
            Instance.claim(range(first.number, first.number + 1))


def test_an_instance_whose_mavlink_ports_are_in_use_is_passed_over() -> None:
    with Instance.claim() as free:
        number = free.number
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 14580 + number))
        with Instance.claim() as claimed:
            assert claimed.number > number


async def test_it_runs_in_its_folder_and_ends_when_asked(tmp_path: Path) -> None:
    installation = find({"PX4_SITL": str(installed(tmp_path / "build"))})
    assert installation is not None
    with Instance.claim() as instance:
        async with SimulatorLink(instance.simulator, HilSensors(1), 4) as link:
            process = Px4Process(installation, instance, tmp_path / "scratch", {"SDLOG_MODE": 1})
            try:
                async with asyncio.timeout(DEADLINE_S):
                    t_s = 0.0
                    while not link.in_step:
                        t_s += 0.004
                        link.send(ImuSample(t_s, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81), 0.3), (1.0, 0.0, 0.0, 0.0))
                        await link.await_lockstep(0.004)
                left = f"/tmp/px4-sock-{instance.number}"  # PX4 leaves it there also at an orderly end
                with contextlib.suppress(FileExistsError):
                    os.symlink("nowhere", left)
                process.terminate()
                assert await process.await_end(DEADLINE_S)
            finally:
                process.kill()
    with pytest.raises(FileNotFoundError):
        os.lstat(left)
    log = (tmp_path / "scratch" / "px4.log").read_text()
    assert f"instance {instance.number}, start scripts {tmp_path / 'build' / 'etc'}" in log


def test_one_that_dies_is_reported_with_its_last_complaint(tmp_path: Path) -> None:
    build = installed(tmp_path / "build", "#!/bin/sh\necho 'ERROR [init] Unknown model'\nexit 7\n")
    installation = find({"PX4_SITL": str(build)})
    assert installation is not None
    with Instance.claim() as instance:
        process = Px4Process(installation, instance, tmp_path / "scratch", {})
        assert asyncio.run(process.await_end(DEADLINE_S))
        process.kill()
    scratch = tmp_path / "scratch"
    assert process.exit_summary() == (
        f"PX4: px4 -i {instance.number} ended with exit code 7 (ERROR [init] Unknown model); see {scratch / 'px4.log'}"
    )


def test_one_that_does_not_listen_is_killed(tmp_path: Path) -> None:
    build = installed(tmp_path / "build", "#!/bin/sh\ntrap '' TERM\nwhile :; do sleep 1; done\n")
    installation = find({"PX4_SITL": str(build)})
    assert installation is not None
    with Instance.claim() as instance:
        process = Px4Process(installation, instance, tmp_path / "scratch", {})
        process.kill()
    assert not process.running
    assert f"ended by {signal.SIGKILL.name}" in process.exit_summary()
    with pytest.raises(ProcessLookupError):
        os.kill(process.pid, 0)
