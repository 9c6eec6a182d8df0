"""The simulated world as a child process of the launcher."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.children import LaunchError, how_it_ended, last_line, terminate, write_text
from companion.config.loader import FlightConfig

SITL_READY_TIMEOUT_S = 30.0
SITL_LEAVE_TIMEOUT_S = 5.0
"""The world ends by itself when the launcher leaves it and its rotors stand."""
SITL_LAST_WORDS_TIMEOUT_S = 3.0
"""After SIGTERM."""


class SitlProcess:
    """The simulated world as a child process."""

    def __init__(self, config: FlightConfig, out: Path) -> None:
        path = out / "sitl_config.json"
        write_text(path, config.model_dump_json(indent=1))
        self.log = out / "sitl.log"
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "sitl", "--config", str(path), "--for-launcher"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        self._buffer = b""
        self.final: dict[str, Any] = {}
        self.at_rest = False
        self.flight_environment: dict[str, str] = {}
        """What the flight process's environment needs for faults of its own that the world plants."""
        self.ended = False
        """The world closed its end of the pipe: it is gone, or about to be."""

    def devices(self) -> dict[str, dict[str, Any]]:
        """Addresses of the simulated devices, once they are open."""
        for message in self.messages(time.monotonic() + SITL_READY_TIMEOUT_S):
            if message.get("type") == "ready":
                devices: dict[str, dict[str, Any]] = message["devices"]
                self.flight_environment = message.get("flight_environment", {})
                return devices
            if message.get("type") == "error":
                raise LaunchError(str(message["text"]))
        if self.ended:
            raise LaunchError(self.epitaph())
        raise LaunchError(f"sitl: the simulated world was not ready within {SITL_READY_TIMEOUT_S:g} s; see {self.log}")

    def epitaph(self) -> str:
        """One line about a world that ended by itself."""
        terminate(self.process)
        return f"sitl: the simulated world {how_it_ended(self.process.returncode)}{last_line(self.log)}; see {self.log}"

    def messages(self, deadline_s: float) -> Iterator[dict[str, Any]]:
        """JSON lines until the deadline (0: only what is there) or the end of the process."""
        if self.ended:
            return
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
                self.ended = True
                return
            self._buffer += data

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("type") == "final":
            self.final = message["world"]
        if message.get("type") == "at_rest":
            self.at_rest = bool(message["at_rest"])

    def tell_flight(self, pid: int) -> None:
        """Name the flight process to the world, which may be asked to kill or to stop it."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):  # a world that is gone is noticed elsewhere
            os.write(self.process.stdin.fileno(), json.dumps({"type": "flight", "pid": pid}).encode() + b"\n")

    def wait_at_rest(self, deadline_s: float) -> None:
        """Until the world's rotors stand, or the deadline."""
        for _ in self.messages(0.0):
            pass
        while not self.at_rest and time.monotonic() < deadline_s and not self.ended:
            for _ in self.messages(time.monotonic() + 0.2):
                pass

    def stop(self) -> None:
        """Ask for the end, take the last words, make sure. Does nothing after the first time."""
        assert self.process.stdin is not None and self.process.stdout is not None
        if self.process.stdout.closed:
            return
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self._listen(SITL_LEAVE_TIMEOUT_S)
        if not self.ended:
            self.process.terminate()
            self._listen(SITL_LAST_WORDS_TIMEOUT_S)
        terminate(self.process)

    def _listen(self, timeout_s: float) -> None:
        for _ in self.messages(time.monotonic() + timeout_s):
            pass
