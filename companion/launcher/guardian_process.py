"""The guardian as a child process of the launcher."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from companion.model.launcher_messages import FlightEvent, GuardianEnded, Message, TookOver
from companion.model.types import Outcome
from companion.runtime import ipc
from companion.runtime.subprocesses import holds_traceback, how_it_ended, last_line, remove_file, terminate, write_text

SILENT_S = 5.0
"""Silence after which the launcher treats the guardian as hung. After a takeover it reports twice a second."""


class GuardianProcess:
    """A running guardian, started after the flight process so that it can hold that process's pidfd.

    Args:
        flight_pid: id of the flight process, a child that has not been reaped.
        heartbeats: the guardian's end of the socket to the flight process; closed here.
        shared: descriptors that the guardian keeps open for the simulated world.
        in_time: arguments of simulated time; empty in real time.
        clock: the time that the guardian lives in, s.
    """

    def __init__(
        self,
        config_path: Path,
        out: Path,
        flight_pid: int,
        heartbeats: socket.socket,
        shared: Sequence[int],
        in_time: Sequence[str] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self.log = out / "guardian.log"
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        pidfd = os.pidfd_open(flight_pid)
        try:
            with theirs, heartbeats, open(self.log, "wb") as log:
                self.process = subprocess.Popen(
                    [
                        *(sys.executable, "-P", "-m", "companion.guardian", "--config", str(config_path)),
                        *(
                            "--heartbeats",
                            str(heartbeats.fileno()),
                            "--channel",
                            str(theirs.fileno()),
                            "--pidfd",
                            str(pidfd),
                        ),
                        *in_time,
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(heartbeats.fileno(), theirs.fileno(), pidfd, *shared),
                    start_new_session=True,
                )
        except BaseException:
            self.channel.close()
            raise
        finally:
            os.close(pidfd)
        self._pid_file = out / "guardian.pid"
        write_text(self._pid_file, str(self.process.pid))
        self.events: list[FlightEvent] = []
        self.took_over = False
        """Whether the guardian has taken over the vehicle. Any of its messages says so, because the first may be lost."""
        self.takeover: TookOver | None = None
        self.result: GuardianEnded | None = None
        self.open = True
        """Whether the guardian's end of the channel is open."""
        self._heard_s = self._clock()

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the flight if the guardian has taken over, otherwise None."""
        if not self.took_over:
            return None
        return outcome_of(self.result)

    def receive(self) -> list[Message]:
        """Return the messages since the last call; never waits."""
        heard: list[Message] = []
        while self.open:
            try:
                message = ipc.receive(self.channel)
            except BlockingIOError:
                break
            if message is None:
                self.open = False
                break
            self._heard_s = self._clock()
            self.took_over = True
            heard.append(message)
            match message:
                case TookOver():
                    self.takeover = message
                case FlightEvent():
                    self.events.append(message)
                case GuardianEnded():
                    self.result = message
        return heard

    def hangs(self) -> bool:
        """Return whether the guardian has taken over but has been silent for longer than `SILENT_S`."""
        return self.open and self.took_over and self._clock() - self._heard_s > SILENT_S

    def stop(self, patience_s: float) -> None:
        """Wait up to `patience_s` for the guardian to exit by itself, as it does after a flight; then end it."""
        terminate(self.process, patience_s)
        remove_file(self._pid_file)
        self.receive()
        self.channel.close()

    def failure(self) -> str | None:
        """Return one line on how the guardian failed, or None if it did not."""
        code = self.process.returncode
        if code not in (0, 1):
            return f"guardian: the guardian process {how_it_ended(code)}{last_line(self.log)}; see {self.log}"
        if holds_traceback(self.log):
            return f"guardian: an internal error was logged{last_line(self.log)}; see {self.log}"
        return None


def outcome_of(result: GuardianEnded | None) -> Outcome:
    """Return the outcome of a flight that the guardian took over.

    Args:
        result: the guardian's last message; None if it sent none.
    """
    if result is None or not result.landed:
        return Outcome.LOST
    return Outcome.CRASHED if result.overturned else Outcome.ABORTED
