"""The simulated world as a child process of the launcher."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Self, cast

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
    """A running simulated world, as the flight of one of its vehicles sees it; made by `start`.

    Args:
        process: the process, which vehicles of one world share.
        told: pipe on which the world hears about this flight.
        said: pipe on which the world speaks about this vehicle.
        px4: whether the world flies a real PX4.
        time: simulated time of the flight; None for a world in real time.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        told: IO[bytes],
        said: IO[bytes],
        log: Path,
        px4: bool,
        time: SharedTime | None,
    ) -> None:
        self.process, self.told, self.log, self.time = process, told, log, time
        self._said, self._px4 = said, px4
        self._error: str | None = None
        self._lines = JsonLines(said.fileno())
        self.final: dict[str, Any] = {}
        self.at_rest = False
        self.before_stop: Callable[[], None] = lambda: None
        """Called first of all by `stop`: a flight waits for the other flights in the same world."""
        self.flight_environment: dict[str, str] = {}
        """Environment variables of the flight process with which the world injects faults into it."""

    @classmethod
    def start(cls, config: SitlConfig, out: Path, speed: float | None = None, *, px4: bool = False) -> Self:
        """Start the world of one vehicle.

        Args:
            speed: simulated seconds in a second of real time at most; None for a world in real time.

        Raises:
            LaunchError: the kernel gives no shared memory or no sockets.
        """
        return cls.start_all([(config, out)], speed, px4=px4)[0]

    @classmethod
    def start_all(
        cls, members: Sequence[tuple[SitlConfig, Path]], speed: float | None = None, *, px4: bool = False
    ) -> list[Self]:
        """Start the world of several vehicles, each with a flight of its own; as `start`."""
        times = [None if speed is None else SharedTime(speed) for _ in members]
        arguments, inherited = [sys.executable, "-P", "-m", "sitl", "--for-launcher"], []
        for config, out in members:
            path = out / "sitl_config.json"
            write_text(path, config.model_dump_json(indent=1))
            arguments += ["--config", str(path)]
            arguments += ["--px4", str((out / PX4_FOLDER).resolve())] if px4 else []
        pipes = [(*os.pipe(), *os.pipe()) for _ in members]
        for hears, _, _, speaks in pipes[1:]:
            arguments += ["--channel", f"{hears},{speaks}"]
            inherited += [hears, speaks]
        for time_of in times:
            if time_of is not None:
                in_time, descriptors = time_of.of_world()
                arguments += in_time
                inherited += descriptors
        out = members[0][1]
        with open(out / "sitl.log", "wb") as log:
            process = subprocess.Popen(
                arguments,
                pass_fds=inherited,
                stdin=pipes[0][0],
                stdout=pipes[0][3],
                stderr=log,
                start_new_session=True,
            )
        for time_of in times:
            if time_of is not None:
                time_of.world_started()
        ends: list[tuple[IO[bytes], IO[bytes]]] = []
        for hears, tells, listens, speaks in pipes:
            os.close(hears)
            os.close(speaks)
            ends.append((os.fdopen(tells, "wb", buffering=0), os.fdopen(listens, "rb", buffering=0)))
        path = out / "sitl.log"
        return [cls(process, *pair, path, px4, time_of) for pair, time_of in zip(ends, times, strict=True)]

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
        """Yield the world's messages until the deadline (`time.monotonic`; 0: those that have arrived) or the process's end."""
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
        with contextlib.suppress(OSError):  # a world that has exited is detected elsewhere
            os.write(self.told.fileno(), json.dumps({"type": "flight", "pid": pid}).encode() + b"\n")

    def wait_at_rest(self, deadline_s: float) -> None:
        """Wait until the world's rotors have stopped, at most until the deadline."""
        for _ in self.messages(0.0):
            pass
        while not self.at_rest and time.monotonic() < deadline_s and not self.ended:
            for _ in self.messages(time.monotonic() + 0.2):
                pass

    def stop(self) -> None:
        """Ask the world to exit, read its last messages, then end it. Repeated calls do nothing."""
        if self._said.closed:
            return
        if self.time is not None:
            self.time.all_started()  # a process that was never started is not waited for
        self.before_stop()
        with contextlib.suppress(OSError):
            self.told.close()
        self._read_for(SITL_EXIT_TIMEOUT_S)
        if not self.ended:
            self.process.terminate()
            self._read_for(SITL_TERMINATE_TIMEOUT_S)
        terminate(self.process)
        self._said.close()
        if self.time is not None:
            self.time.close()

    def _read_for(self, timeout_s: float) -> None:
        for _ in self.messages(time.monotonic() + timeout_s):
            pass
