"""What tests of whole programs share: a place to run `companion` in, a simulated world on its own, proof that nothing is left.

Everything that a `Sandbox` starts works in its folder, and children inherit that: whoever is still there afterwards was left behind.
A pty lives as long as the process that holds its master, so no process means no pty.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import itertools
import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from msgspec.structs import replace

from companion.cli.main import main
from companion.config.arm import Tool
from companion.config.tether import Tether
from companion.config.vehicle import Vehicle
from companion.model.outputs import Outputs
from companion.model.types import IDENTITY_QUAT, Inputs, MocapPose
from companion.sitl_config.loader import load_sitl

ROOT = Path(__file__).parents[1]
CATCH = ROOT / "configs/missions/catch.yaml"
HOVER = ROOT / "configs/missions/hover.yaml"
SHORT_CATCH = ROOT / "tests/short_catch.yaml"
"""For tests of what is done with a flight, whatever is flown."""
DEADLINE_S = 240.0
"""For everything that a test waits for: far beyond what it takes, on a loaded machine too."""
IN_BACKGROUND = ("sh", "-c", 'trap "" INT TERM CHLD; exec "$@"', "sh")
"""Starts a program with signals ignored, as it may inherit them."""
PREFLIGHT = "vehicle.safety.preflight_s"
USUAL: dict[str, object] = {PREFLIGHT: 1.0, "vehicle.ground.mqtt": None}
"""Of every flight of the tests that does not set them itself: the preflight has tests of its own, and no flight of a test speaks to
whatever broker this computer may have.
"""
PATIENT: dict[str, object] = {
    **USUAL,
    "vehicle.safety.arm_timeout_s": 1.0,
    "vehicle.safety.arm_read_failures_max": 150,
    "vehicle.safety.mocap_timeout_s": 1.0,
    "vehicle.safety.vehicle_timeout_s": 1.0,
    "vehicle.safety.link_lag_max_s": 0.8,
    "vehicle.safety.guardian_timeout_s": 0.8,
    "vehicle.devices.arm.watchdog_ms": 1000,
}
"""Of every flight of the tests in real time: a shared computer is held up now and then by more than the vehicle file allows."""

LOW_HOVER: dict[str, object] = {
    "mission.phases[0].height_m": 0.5,
    "mission.phases[0].duration_s": 2.0,
    "mission.phases[1].duration_s": 1.0,
}
"""A short flight of `HOVER`: in the air and on the ground again, in less than half of its time. From 2.0 s
to 3.0 s of the mission, 3.2 s to 4.2 s after arming, it hovers.
"""
OVER_WIRES = LOW_HOVER | {"mission.phases[0].duration_s": 1.5}
"""A tick over wires costs eight times as much as one of the fast loop."""
HOVERS_S = 3.5
"""After arming: it hovers."""

SUMMARY_KEYS: dict[str, Any] = {
    "outcome": None,
    "controller": None,
    "preset": None,
    "payload_kg": None,
    "catch_t_s": None,
    "rms": dict.fromkeys(("pre", "post"), dict.fromkeys(("e_p_m", "e_q_deg", "e_alpha_deg"))),
    "impedance_error": dict.fromkeys(("position_n", "arm_nm")),
    "final_e_z_m": None,
    "loop": {"rate_hz": None, "ticks": None, "missed": None, "lateness_ms": dict.fromkeys(("p50", "p99", "max"))},
    "latency_ms": dict.fromkeys(("mocap_to_setpoint", "joint_read_to_write"), dict.fromkeys(("p50", "p99", "max"))),
    "stages_ms": dict.fromkeys(
        ("wait_for_joints", "core", "send", "whole", "bus_read", "bus_cycle"), dict.fromkeys(("p50", "p99", "max"))
    ),
    "recorder": dict.fromkeys(("samples", "dropped")),
    "events": None,
    "tether": {"min_slack_m": None},
}
"""Keys of summary.json that outside scripts rely on."""


SIMULATED = ("fly", "check", "sitl", "compare", "faults")
"""Commands that fly the laboratory by default."""


def in_a_world(arguments: tuple[object, ...]) -> tuple[object, ...]:
    """Add `--world ideal` to a command that names no world."""
    if arguments[:1] and arguments[0] in SIMULATED and "--world" not in arguments:
        return (*arguments, "--world", "ideal")
    return arguments


@dataclass(frozen=True)
class Ended:
    """A program that ran to its end."""

    code: int
    out: str
    err: str

    @property
    def err_lines(self) -> list[str]:
        return self.err.splitlines()


class Sandbox:
    """A current directory and a TMPDIR for everything started in it."""

    def __init__(self, folder: Path, environment: Mapping[str, str] | None = None) -> None:
        self.cwd = folder / "cwd"
        self.tmp = folder / "tmp"
        self.cwd.mkdir(parents=True)
        self.tmp.mkdir()
        self.config = folder / "config"
        self._environment = dict(environment or {})

    @property
    def environment(self) -> dict[str, str]:
        own = {"TMPDIR": str(self.tmp), "XDG_CONFIG_HOME": str(self.config), "COLUMNS": "200"}
        return {**os.environ, **own, **self._environment}

    def start(self, *arguments: object, report: bool = False, background: bool = False) -> Running:
        """`companion ARGUMENTS`, in a process group of its own, as a terminal would start it, or a shell without job control in the
        background. A simulated flight is as fast as the computer, and one in real time is `PATIENT`; it leaves a report only if it is
        asked for. A check watches for as long as the preflight of such a flight."""
        given = " ".join(map(str, arguments))
        usual: dict[str, object] = {}
        if arguments[:1] == ("fly",):
            lockstep = "--sitl" in given and "--real-time" not in given
            usual = (USUAL if lockstep else PATIENT) | (OVER_WIRES if arguments[1:2] == (HOVER,) else {})
            arguments += ("--speed", "max") if lockstep and "--speed" not in given else ()
        elif arguments[:1] == ("check",):
            usual = {PREFLIGHT: USUAL[PREFLIGHT]}
        more = {key: value for key, value in usual.items() if key not in given}
        no_report = ["--no-report"] if arguments[:1] == ("fly",) and not report else []
        arguments = in_a_world(arguments)
        return Running(self, (*arguments, *no_report, *set_options(**more)), IN_BACKGROUND if background else ())

    def run(self, *arguments: object, report: bool = False) -> Ended:
        """`companion ARGUMENTS` to its end."""
        with self.start(*arguments, report=report) as running:
            return running.end()

    def survivors(self) -> dict[int, str]:
        """Processes that work in this sandbox: pid and command line.

        Of all others nothing is read that lies in their memory, as command line and environment do: the kernel locks a process's
        memory map meanwhile, and a flight beside this test would wait for a test that waits for a core.
        """
        here = str(self.cwd.resolve())
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdecimal() or int(entry.name) == os.getpid():
                continue
            with contextlib.suppress(OSError):  # it ended while we looked, or is another user's
                if os.readlink(entry / "cwd").startswith(here):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
        return found

    def pid_of(self, module: str) -> int:
        """The one process here that runs `python -m MODULE`."""
        found = [pid for pid, command in self.survivors().items() if f"-m {module} " in f"{command} "]
        assert len(found) == 1, (module, self.survivors())
        return found[0]

    def assert_nobody_left(self, within_s: float = 0.0) -> None:
        """No process that was started here runs any more, after `within_s` at the latest, and TMPDIR is empty."""
        wait_until(lambda: not self.survivors(), lambda: f"left behind: {self.survivors()}", within_s)
        left = [path.name for path in self.tmp.iterdir()]
        assert not left, f"files left in TMPDIR: {left}"

    def end_survivors(self) -> None:
        """For a test's teardown: a test that failed half way leaves nothing either."""
        for pid in self.survivors():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


def hooked(folder: Path) -> dict[str, str]:
    """An environment in which every Python imports what is in that folder, its `sitecustomize` at the start."""
    return {"PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))}


@contextlib.contextmanager
def sandbox_in(folder: Path, environment: Mapping[str, str] | None = None) -> Iterator[Sandbox]:
    """A sandbox that is empty of processes afterwards, whatever happens."""
    sandbox = Sandbox(folder, environment)
    try:
        yield sandbox
    finally:
        sandbox.end_survivors()


class Running:
    """A `companion` command that runs; its output is read as it comes."""

    def __init__(self, sandbox: Sandbox, arguments: Sequence[object], started_by: Sequence[str] = ()) -> None:
        self.process = subprocess.Popen(
            [*started_by, sys.executable, "-m", "companion", *map(str, arguments)],
            cwd=sandbox.cwd,
            env=sandbox.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._read = {"out": b"", "err": b""}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for pipe in (self.process.stdout, self.process.stderr):
            assert pipe is not None
            pipe.close()

    def wait_for(self, text: str | re.Pattern[str]) -> None:
        """Until standard output has shown `text`."""
        pattern = re.compile(re.escape(text)) if isinstance(text, str) else text
        deadline_s = time.monotonic() + DEADLINE_S
        while not pattern.search(self._text("out")):
            assert self._pump(deadline_s), (f"{text!r} did not come", self._text("out"), self._text("err"))

    @property
    def out(self) -> str:
        """Standard output up to what the last `wait_for` was for."""
        return self._text("out")

    def signal(self, number: signal.Signals) -> None:
        """To the whole process group, as the terminal's Ctrl-C."""
        os.killpg(self.process.pid, number)

    def close_output(self) -> None:
        """Nobody reads standard output any more."""
        assert self.process.stdout is not None
        self.process.stdout.close()

    def end(self) -> Ended:
        """Read both streams to their end; both close with the last process that holds them."""
        deadline_s = time.monotonic() + DEADLINE_S
        while self._pump(deadline_s):
            pass
        code = self.process.wait(max(0.0, deadline_s - time.monotonic()))
        return Ended(code, self._text("out"), self._text("err"))

    def _text(self, name: str) -> str:
        return self._read[name].decode()

    def _pump(self, deadline_s: float) -> bool:
        """Take what comes next; False: both streams have ended."""
        assert self.process.stdout is not None and self.process.stderr is not None
        pipes = [pipe for pipe in (self.process.stdout, self.process.stderr) if not pipe.closed]
        if not pipes:
            return False
        ready, _, _ = select.select(pipes, [], [], max(0.0, deadline_s - time.monotonic()))
        assert ready, ("the command is still busy", self._text("out"), self._text("err"))
        for pipe in ready:
            data = os.read(pipe.fileno(), 65536)
            self._read["out" if pipe is self.process.stdout else "err"] += data
            if not data:
                pipe.close()
        return True


def run_here(*arguments: object) -> Ended:
    """`companion ARGUMENTS` in this process, to its end: spares the half second of processor time that the start of a process takes.

    Not for a command that takes real-time priority: every test after it in this process would have it too.
    """
    before = os.sched_getscheduler(0)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main([str(word) for word in in_a_world(arguments)])
        except SystemExit as end:
            code = int(end.code or 0)
    assert os.sched_getscheduler(0) == before, "this command takes real-time priority: run it in a process of its own"
    return Ended(code, out.getvalue(), err.getvalue())


class World:
    """The simulated world on its own, as the launcher starts it: real wires, device addresses, and the truth of what happens in it."""

    def __init__(self, sandbox: Sandbox, mission: Path = CATCH, overrides: Sequence[str] = ()) -> None:
        self._config = sandbox.cwd / "world.json"
        self._config.write_text(load_sitl(mission, overrides=overrides).model_dump_json(), encoding="utf-8")
        self._log = sandbox.cwd / "world.log"
        with open(self._log, "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "--config", str(self._config), "--for-launcher"],
                env=sandbox.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        self._messages: list[dict[str, Any]] = []
        self._changed = threading.Condition()
        self._closed = False
        self._reader = threading.Thread(target=self._listen, name="world")
        self._reader.start()
        self.devices: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Self:
        try:
            self.devices = self.wait_for(lambda message: message["type"] == "WorldReady")["devices"]
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, *_: object) -> None:
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.terminate()
        try:
            self.process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        self.process.stdout.close()

    @property
    def messages(self) -> list[dict[str, Any]]:
        """Everything that the world has said."""
        with self._changed:
            return list(self._messages)

    @property
    def armings(self) -> int:
        """How often the rotors were armed."""
        return sum(message["type"] == "WorldAtRest" and not message["at_rest"] for message in self.messages)

    @property
    def pauses(self) -> int:
        """How often the world in real time has paused for a tenth of a second, because the computer was busy."""
        return sum(message["type"] == "WorldSlipped" for message in self.messages)

    @property
    def crashes(self) -> int:
        return sum(message["type"] == "WorldEvent" and message["kind"] == "crashed" for message in self.messages)

    def wait_for(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The first message, past or to come, that is wanted."""
        deadline_s = time.monotonic() + DEADLINE_S
        with self._changed:
            while True:
                for message in self._messages:
                    if wanted(message):
                        return message
                left_s = deadline_s - time.monotonic()
                assert not self._closed and left_s > 0, (
                    "the world did not say it",
                    self._messages,
                    self._log.read_text(),
                )
                self._changed.wait(left_s)

    def addresses(self, **but: Mapping[str, object]) -> list[str]:
        """`--set` options that lead a companion to this world; `but` replaces settings: `arm={"baud": 57600}`."""
        devices = {name: {**settings, **but.get(name, {})} for name, settings in self.devices.items()}
        return set_options(
            **{f"vehicle.devices.{name}.{key}": value for name, keys in devices.items() for key, value in keys.items()}
        )

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._changed:
                self._messages.append(json.loads(line))
                self._changed.notify_all()
        with self._changed:
            self._closed = True
            self._changed.notify_all()


def tether_of(vehicle: Vehicle) -> Tether:
    """The tether of a vehicle that has one."""
    assert vehicle.tether is not None
    return vehicle.tether


def tool_of(vehicle: Vehicle) -> Tool:
    """The tool of a vehicle that has one."""
    assert vehicle.tool is not None
    return vehicle.tool


def set_options(**values: object) -> list[str]:
    """`--set KEY=VALUE` each; keys as in `**{"world.seed": 3}`."""
    return [word for key, value in values.items() for word in ("--set", f"{key}={json.dumps(value)}")]


def read_summary(folder: Path) -> dict[str, Any]:
    """summary.json, with every key of the contract."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    _assert_keys(summary, SUMMARY_KEYS, "summary")
    for event in summary["events"]:
        assert {"t_s", "id", "severity", "action"} <= set(event)
    return summary


def _assert_keys(found: Any, wanted: dict[str, Any], where: str) -> None:
    missing = set(wanted) - set(found)
    assert not missing, f"{where} lacks {sorted(missing)}"
    for key, below in wanted.items():
        if below is not None:
            _assert_keys(found[key], below, f"{where}.{key}")


def _port_range() -> Iterator[int]:
    """Yield the ports of a range that belongs to this process, endlessly. The range lies below the kernel's ephemeral ports, so that no
    other socket takes a port between its choice and its use.
    """
    for slot in itertools.count():
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0ports of the tests {slot}")
            break
        except OSError:
            claim.close()
    first = 20_000 + _PORTS_EACH * (slot % (12_000 // _PORTS_EACH))
    try:
        yield from itertools.cycle(range(first, first + _PORTS_EACH))
    finally:
        claim.close()


_PORTS_EACH = 400
_ports = _port_range()


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port that nobody uses now, at no address of this computer: of TCP, unless the kind says otherwise."""
    while True:
        port = next(_ports)
        with socket.socket(type=kind) as probe, contextlib.suppress(OSError):
            probe.bind(("", port))
            return port


def free_udp_port() -> int:
    return free_port(socket.SOCK_DGRAM)


def wait_until(condition: Callable[[], bool], why: Callable[[], str], within_s: float = DEADLINE_S) -> None:
    """Look again and again until the condition holds; what to say if it never does."""
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, why()
        time.sleep(0.05)


async def eventually(condition: Callable[[], bool], what: str, within_s: float = DEADLINE_S) -> None:
    """Let the event loop run until the condition holds, which other threads or the loop's tasks bring about."""
    deadline_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {within_s} s: {what}"
        await asyncio.sleep(0.01)


def level_pose(t_s: float, **changes: object) -> MocapPose:
    """A pose of motion capture, level at 1 m, with fields replaced."""
    pose = MocapPose(
        stamp_s=t_s, latency_s=0.005, frame_number=1, position_world_m=(0.1, 0.2, 1.0), attitude_wxyz=IDENTITY_QUAT,
        tracking_valid=True, marker_error_m=0.0002,
    )  # fmt: skip
    return replace(pose, **changes)


def position_error_m(i: Inputs, o: Outputs) -> float:
    """By motion capture against the reference of the frame's exposure: what the metrics say, written once more."""
    assert i.mocap is not None and o.reference is not None
    age_s = i.t_s - i.mocap.stamp_s + (i.mocap.latency_s or 0.0)
    at, speed = o.reference.position_world_m, o.reference.velocity_world_m_s
    return math.dist(i.mocap.position_world_m, [p - age_s * v for p, v in zip(at, speed, strict=True)])
