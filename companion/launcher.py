"""What the user started: brings the processes of a flight up, watches them, outlives them, and says how it ended.

launcher --starts--> sitl (with --sitl), flight --starts--> recorder
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion import status
from companion.config.loader import FlightConfig
from companion.exit_codes import EXIT_CODES
from companion.types import Outcome

SITL_READY_TIMEOUT_S = 30.0
SITL_SETTLE_TIMEOUT_S = 40.0
"""After the flight process is gone: how long the world may take to come to rest."""
RECORDER_CLOSE_TIMEOUT_S = 10.0

OnMessage = Callable[[status.Message], None]


class LaunchError(Exception):
    """A process of the flight could not be started; one line."""


@dataclass
class FlightResult:
    """What is known after the flight."""

    outcome: Outcome
    recorder: dict[str, Any] | None = None
    world: dict[str, Any] = field(default_factory=dict)
    """SITL truth: payload_kg, caught, crashed, ..."""
    refusal: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """Exit code of `companion fly`."""
        return EXIT_CODES[self.outcome]


class SitlProcess:
    """The simulated world as a child process."""

    def __init__(self, config: FlightConfig, out: Path) -> None:
        path = out / "sitl_config.json"
        path.write_text(config.model_dump_json(indent=1), encoding="utf-8")
        with open(out / "sitl.log", "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "--config", str(path), "--for-launcher"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        self._log = out / "sitl.log"
        self._buffer = b""
        self.final: dict[str, Any] = {}
        self.at_rest = False

    def devices(self) -> dict[str, dict[str, Any]]:
        """Addresses of the simulated devices, once they are open."""
        for message in self.messages(time.monotonic() + SITL_READY_TIMEOUT_S):
            if message.get("type") == "ready":
                devices: dict[str, dict[str, Any]] = message["devices"]
                return devices
            if message.get("type") == "error":
                raise LaunchError(str(message["text"]))
        raise LaunchError(f"sitl: did not come up; see {self._log}")

    def messages(self, deadline_s: float) -> Iterator[dict[str, Any]]:
        """JSON lines until the deadline (0: only what is there) or the end of the process."""
        assert self.process.stdout is not None
        fd = self.process.stdout.fileno()
        while True:
            while b"\n" in self._buffer:
                line, _, self._buffer = self._buffer.partition(b"\n")
                with contextlib.suppress(ValueError):
                    message = json.loads(line)
                    self._note(message)
                    yield message
            left_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([fd], [], [], left_s)[0]:
                return
            data = os.read(fd, 65536)
            if not data:
                return
            self._buffer += data

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("type") == "final":
            self.final = message["world"]
        if message.get("type") == "at_rest":
            self.at_rest = bool(message["at_rest"])

    def wait_at_rest(self, deadline_s: float) -> None:
        """Until the world's rotors stand, or the deadline."""
        for _ in self.messages(0.0):
            pass
        while not self.at_rest and time.monotonic() < deadline_s and self.process.poll() is None:
            for _ in self.messages(time.monotonic() + 0.2):
                pass

    def stop(self) -> None:
        """Ask for the end, take the last words, make sure."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        for _ in self.messages(time.monotonic() + 5.0):
            pass
        terminate(self.process)


def terminate(process: subprocess.Popen[bytes], patience_s: float = 3.0) -> None:
    """End a child: wait, then SIGTERM, then SIGKILL; reaped in any case, its pipes closed."""
    for number in (0, signal.SIGTERM, signal.SIGKILL):  # 0 sends nothing
        process.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
            break
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


class Launcher:
    """One flight from start to end, seen from outside.

    Args:
        config: checked configuration; with SITL the device addresses are replaced by the world's.
        out: folder for everything that the flight leaves; exists already.
        sitl: fly in the simulated world.
        on_message: called with every message of the flight process, for the display.
    """

    def __init__(self, config: FlightConfig, out: Path, *, sitl: bool, on_message: OnMessage) -> None:
        self._config = config
        self._out = out
        self._use_sitl = sitl
        self._on_message = on_message
        self._stop_asked = False
        self._channel: socket.socket | None = None
        self._result: dict[str, Any] | None = None
        self._refusal: tuple[str, ...] = ()
        self._recorder_pid: int | None = None

    def ask_to_land(self) -> None:
        """Ctrl-C: land; asking again changes nothing."""
        self._stop_asked = True
        if self._channel is not None:
            status.send(self._channel, {"type": "land"})

    def run(self) -> FlightResult:
        """Fly.

        Raises:
            LaunchError: the simulated world could not be started.
        """
        handlers = {number: signal.signal(number, lambda *_: self.ask_to_land()) for number in _LAND_SIGNALS}
        sitl: SitlProcess | None = None
        try:
            config = self._config
            if self._use_sitl:
                sitl = SitlProcess(config, self._out)
                config = with_devices(config, sitl.devices())
            path = self._out / "config.json"
            path.write_text(config.model_dump_json(indent=1), encoding="utf-8")
            outcome = self._fly(path, sitl)
        finally:
            if sitl is not None:
                sitl.stop()
            for number, handler in handlers.items():
                signal.signal(number, handler)
        world = sitl.final if sitl is not None else {}
        if world.get("crashed") and outcome is not Outcome.REFUSED:
            outcome = Outcome.CRASHED
        recorder = self._result.get("recorder") if self._result else None
        return FlightResult(outcome, recorder, world, self._refusal)

    def _fly(self, config_path: Path, sitl: SitlProcess | None) -> Outcome:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours:
            ours.setblocking(False)
            with theirs, open(self._out / "flight.log", "wb") as log:
                process = subprocess.Popen(
                    [
                        *(sys.executable, "-m", "companion.app", "--config", str(config_path)),
                        *("--out", str(self._out), "--channel", str(theirs.fileno())),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(theirs.fileno(),),
                    start_new_session=True,
                )
            (self._out / "flight.pid").write_text(str(process.pid))
            self._channel = ours
            if self._stop_asked:
                self.ask_to_land()
            try:
                self._watch(process, ours, sitl)
            finally:
                self._channel = None
                terminate(process, patience_s=30.0 if self._result is None else 10.0)
        self._await_recorder()
        if process.returncode < 0 or (self._result is None and not self._refusal):
            if sitl is not None:
                sitl.wait_at_rest(time.monotonic() + SITL_SETTLE_TIMEOUT_S)
            return Outcome.LOST
        return Outcome.REFUSED if self._result is None else Outcome(self._result["outcome"])

    def _watch(self, process: subprocess.Popen[bytes], channel: socket.socket, sitl: SitlProcess | None) -> None:
        """Pass the flight's messages on until it closes its channel."""
        while True:
            readable, _, _ = select.select([channel], [], [], 0.5)
            if sitl is not None:
                for message in sitl.messages(0.0):
                    self._on_message({**message, "source": "sitl"})
            if not readable:
                if process.poll() is not None:
                    return
                continue
            with contextlib.suppress(BlockingIOError):
                while True:
                    received = status.receive(channel)
                    if received is None:
                        return
                    self._take(received)

    def _take(self, message: status.Message) -> None:
        kind = message.get("type")
        if kind == "result":
            self._result = message
        elif kind == "refused":
            self._refusal = tuple(message["lines"])
        elif kind == "started":
            self._recorder_pid = message["recorder_pid"]
        self._on_message(message)

    def _await_recorder(self) -> None:
        """The recorder closes the log after a flight process that was killed; it is no child of ours, so look at its pid."""
        if self._recorder_pid is None or self._result is not None:
            return
        try:
            pidfd = os.pidfd_open(self._recorder_pid)
        except OSError:
            return
        select.select([pidfd], [], [], RECORDER_CLOSE_TIMEOUT_S)
        os.close(pidfd)


_LAND_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def with_devices(config: FlightConfig, addresses: dict[str, dict[str, Any]]) -> FlightConfig:
    """The configuration with some device settings replaced, checked again."""
    data = json.loads(config.model_dump_json())
    for device, settings in addresses.items():
        data["vehicle"]["devices"][device].update(settings)
    return FlightConfig.model_validate_json(json.dumps(data))
