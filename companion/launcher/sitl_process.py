"""The simulated world as a child process of the launcher."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

from companion.launcher.shared_time import SharedTime
from companion.model.codec import RecordError, from_jsonable
from companion.model.launcher_messages import WorldAtRest, WorldEnded, WorldFailed, WorldMessage, WorldReady
from companion.runtime.subprocesses import JsonLines, LaunchError, how_it_ended, last_line, terminate, write_text
from companion.sitl_config.loader import SitlConfig

SITL_READY_TIMEOUT_S = 30.0
PX4_READY_TIMEOUT_S = 700.0
"""Timeout with a real PX4. The world has its own timeouts for PX4's boot and for a user who starts PX4 manually."""
PX4_FOLDER = "px4"
"""Folder of a real PX4's files, below the flight's folder."""
SITL_EXIT_TIMEOUT_S = 5.0
"""Timeout for the world to exit once the launcher has closed its input and the rotors have stopped."""
SITL_TERMINATE_TIMEOUT_S = 10.0
"""Timeout for the exit after SIGTERM; a real PX4 needs a few seconds."""


class SitlProcess:
    """A running simulated world.

    Args:
        config: checked configuration.
        out: folder of the flight.
        shared_time: simulated time of the flight; None for a world in real time.
        px4: whether the world flies a real PX4.
    """

    def __init__(
        self, config: SitlConfig, out: Path, shared_time: SharedTime | None = None, *, px4: bool = False
    ) -> None:
        self._px4 = px4
        self._error: str | None = None
        path = out / "sitl_config.json"
        write_text(path, config.model_dump_json(indent=1))
        self.log = out / "sitl.log"
        in_time, inherited = ((), ()) if shared_time is None else shared_time.of_world()
        with open(self.log, "wb") as log:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-P", "-m", "sitl", "--config", str(path), "--for-launcher"),
                    *(("--px4", str((out / PX4_FOLDER).resolve())) if px4 else ()),
                    *in_time,
                ],
                pass_fds=inherited,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        if shared_time is not None:
            shared_time.world_started()
        assert self.process.stdout is not None
        self._lines = JsonLines(self.process.stdout.fileno())
        self.final: dict[str, Any] = {}
        self.at_rest = False
        self.flight_environment: dict[str, str] = {}
        """Environment variables of the flight process with which the world injects faults into it."""

    def devices(
        self,
        on_message: Callable[[WorldMessage], None] = lambda message: None,
        given_up: Callable[[], bool] = lambda: False,
    ) -> dict[str, dict[str, Any]]:
        """Wait until the simulated devices are open and the autopilot can fly; return the addresses of the devices.

        Args:
            on_message: called with the world's messages until then.
            given_up: polled several times per second; True cancels the wait.

        Raises:
            LaunchError: the world ended, was not ready in time, or the wait was cancelled.
        """
        timeout_s = PX4_READY_TIMEOUT_S if self._px4 else SITL_READY_TIMEOUT_S
        deadline_s = time.monotonic() + timeout_s
        while not self.ended and time.monotonic() < deadline_s:
            if given_up():
                raise LaunchError("sitl: cancelled while the simulated world was starting")
            devices = self._ready(min(deadline_s, time.monotonic() + 0.2), on_message)
            if devices is not None:
                return devices
        if self.ended:
            raise LaunchError(self.exit_summary())
        raise LaunchError(f"sitl: the simulated world was not ready within {timeout_s:g} s; see {self.log}")

    def _ready(self, deadline_s: float, on_message: Callable[[WorldMessage], None]) -> dict[str, dict[str, Any]] | None:
        for message in self.messages(deadline_s):
            on_message(message)
            if isinstance(message, WorldReady):
                self.flight_environment = message.flight_environment
                return message.devices
            if isinstance(message, WorldFailed):
                raise LaunchError(message.text)
        return None

    def exit_summary(self) -> str:
        """Return one line on how the world ended, for a world that ended by itself."""
        terminate(self.process)
        if self._error is not None:
            return self._error
        return f"sitl: the simulated world {how_it_ended(self.process.returncode)}{last_line(self.log)}; see {self.log}"

    def messages(self, deadline_s: float) -> Iterator[WorldMessage]:
        """Yield the world's messages until the deadline (`time.monotonic`) or the end of the process. With deadline 0, yield only
        those that have already arrived.
        """
        for line in self._lines.read(deadline_s):
            try:
                message: WorldMessage = from_jsonable(cast(Any, WorldMessage), line)
            except RecordError as error:  # the flight goes on
                message = WorldFailed(f"sitl: {error}")
            self._update(message)
            yield message

    @property
    def ended(self) -> bool:
        """Whether the world has closed its end of the pipe, which means that it has exited or is about to."""
        return self._lines.ended

    def _update(self, message: WorldMessage) -> None:
        match message:
            case WorldEnded():
                self.final = message.world
            case WorldFailed():
                self._error = message.text
            case WorldAtRest():
                self.at_rest = message.at_rest

    def send_flight_pid(self, pid: int) -> None:
        """Send the id of the flight process to the world, which may have to kill or stop it."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):  # a world that has exited is detected elsewhere
            os.write(self.process.stdin.fileno(), json.dumps({"type": "flight", "pid": pid}).encode() + b"\n")

    def wait_at_rest(self, deadline_s: float) -> None:
        """Wait until the world's rotors have stopped, at most until the deadline."""
        for _ in self.messages(0.0):
            pass
        while not self.at_rest and time.monotonic() < deadline_s and not self.ended:
            for _ in self.messages(time.monotonic() + 0.2):
                pass

    def stop(self) -> None:
        """Ask the world to exit, read its last messages, then end it. Repeated calls do nothing."""
        assert self.process.stdin is not None and self.process.stdout is not None
        if self.process.stdout.closed:
            return
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self._read_for(SITL_EXIT_TIMEOUT_S)
        if not self.ended:
            self.process.terminate()
            self._read_for(SITL_TERMINATE_TIMEOUT_S)
        terminate(self.process)

    def _read_for(self, timeout_s: float) -> None:
        for _ in self.messages(time.monotonic() + timeout_s):
            pass
