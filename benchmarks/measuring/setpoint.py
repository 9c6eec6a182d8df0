"""Mocap datagram in -> SET_ATTITUDE_TARGET out: bare loops on native MAVSDK, on pymavlink, over gRPC, and the companion's edge."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.measuring.latency import DEADLINE_S, RATE_HZ, WARM_UP, Latency
from benchmarks.measuring.wires import autopilot_edge, bare_mavsdk, receive_and_send, with_far_end
from tests.support import ROOT

GRPC_PACKAGE = "mavsdk>=3,<4"
GRPC_FOLDER = ROOT / "build" / "mavsdk-grpc"
_PIP_DEADLINE_S = 300.0
_TYPE_MASK = 0b111
"""SET_ATTITUDE_TARGET.type_mask: body rates are ignored."""


class NotMeasured(Exception):
    """The reason why something was not measured, in one line."""


def measure(frames: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Measure all loops in turn; each result has `inside` and `wire`, or `not_measured`."""
    found: dict[str, Any] = {}
    for name, loop in (
        ("native", bare_mavsdk),
        ("edge", autopilot_edge),
        ("pymavlink", pymavlink_echo),
        ("grpc", mavsdk_grpc),
    ):
        say(name)
        try:
            inside, wire = loop(frames + WARM_UP)
        except (NotMeasured, RuntimeError, OSError, ValueError) as error:
            found[name] = {"not_measured": " ".join(str(error).split()) or type(error).__name__}
        else:
            found[name] = {"inside": asdict(inside), "wire": asdict(wire)}
    return found


def pymavlink_echo(frames: int) -> tuple[Latency, Latency]:
    """Receive, pack SET_ATTITUDE_TARGET with pymavlink and send it, without a link or discovery."""
    from pymavlink.dialects.v20 import common as mavlink

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.bind(("127.0.0.1", port))
            wire.settimeout(DEADLINE_S)
            _, autopilot = wire.recvfrom(4096)  # its heartbeat
            out = mavlink.MAVLink(None, srcSystem=245, srcComponent=191)

            def send(thrust: float) -> None:
                message = out.set_attitude_target_encode(
                    0, 1, 1, _TYPE_MASK, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, thrust
                )
                wire.sendto(message.pack(out), autopilot)

            go()
            return receive_and_send(mocap, frames, send)

    return with_far_end(frames, run)


def mavsdk_grpc(frames: int) -> tuple[Latency, Latency]:
    """Receive, then call Offboard.set_attitude of MAVSDK 3.

    Raises:
        NotMeasured: MAVSDK 3 cannot be installed here.
    """
    python = grpc_environment()

    def run(port: int, go: Callable[[], None], mocap: socket.socket) -> list[float]:
        process = subprocess.Popen(
            [str(python), "-m", "benchmarks.measuring.grpc_loop", str(port), str(mocap.fileno()), str(frames)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=(mocap.fileno(),),
            cwd=ROOT,
            text=True,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert process.stdout is not None
        try:
            ready, _, _ = select.select([process.stdout], [], [], 2 * DEADLINE_S)
            if ready and process.stdout.readline() == "ready\n":
                go()
                out, _ = process.communicate(timeout=2 * DEADLINE_S + frames / RATE_HZ)
                taken_s: list[float] = json.loads(out)
                return taken_s
        except (subprocess.TimeoutExpired, ValueError):
            pass
        finally:
            _end(process)
        _, said = process.communicate()
        raise NotMeasured((said.strip().splitlines() or ["MAVSDK 3 did not find the autopilot"])[-1])

    return with_far_end(frames, run)


def _end(process: subprocess.Popen[str]) -> None:
    """End the process and its server, which is in its process group."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(5.0)


def grpc_environment(folder: Path = GRPC_FOLDER) -> Path:
    """Return the Python of an environment with MAVSDK 3; create the environment if needed.

    Raises:
        NotMeasured: pip could not install it.
    """
    python = folder / "bin" / "python"
    if _works(python):
        return python
    pip = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--quiet", GRPC_PACKAGE]
    try:
        for command in ([sys.executable, "-m", "venv", "--clear", str(folder)], pip):
            subprocess.run(command, capture_output=True, text=True, timeout=_PIP_DEADLINE_S, check=True)
    except subprocess.CalledProcessError as error:
        said = [line for line in error.stderr.splitlines() if line.startswith("ERROR")] or ["pip failed"]
        raise NotMeasured(f"{GRPC_PACKAGE} could not be installed: {said[-1]}") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NotMeasured(f"{GRPC_PACKAGE} could not be installed: {error}") from None
    if not _works(python):
        raise NotMeasured(f"{GRPC_PACKAGE} was installed but cannot be imported")
    return python


def _works(python: Path) -> bool:
    if not python.exists():
        return False
    code = "import importlib.metadata as m, mavsdk.offboard; assert m.version('mavsdk').startswith('3.')"
    return (
        subprocess.run([str(python), "-c", code], capture_output=True, timeout=DEADLINE_S, check=False).returncode == 0
    )
