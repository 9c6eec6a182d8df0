"""The guardian as a child process of the launcher: started beside the flight, heard, and ended for sure."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.model.types import Outcome
from companion.runtime import ipc
from companion.runtime.subprocesses import holds_traceback, how_it_ended, last_line, remove_file, terminate, write_text

SILENT_S = 5.0
"""In charge it speaks twice a second; silent for this long it hangs itself."""


class GuardianProcess:
    """Started once the flight process exists, so that it can hold that one process and no other.

    Args:
        config_path: effective configuration.
        out: folder of the flight.
        flight_pid: of the flight process, a child that is not reaped yet.
        beats: the guardian's end of the socket to the flight process; closed here.
        shared: descriptors that the guardian holds open for the world's sake.
    """

    def __init__(
        self, config_path: Path, out: Path, flight_pid: int, beats: socket.socket, shared: Sequence[int]
    ) -> None:
        self.log = out / "guardian.log"
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.channel.setblocking(False)
        pidfd = os.pidfd_open(flight_pid)
        try:
            with theirs, beats, open(self.log, "wb") as log:
                self.process = subprocess.Popen(
                    [
                        *(sys.executable, "-m", "companion.guardian", "--config", str(config_path)),
                        *("--beats", str(beats.fileno()), "--channel", str(theirs.fileno()), "--pidfd", str(pidfd)),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    pass_fds=(beats.fileno(), theirs.fileno(), pidfd, *shared),
                    start_new_session=True,
                )
        except BaseException:
            self.channel.close()
            raise
        finally:
            os.close(pidfd)
        self._number = out / "guardian.pid"
        write_text(self._number, str(self.process.pid))
        self.events: list[ipc.Message] = []
        self.result: ipc.Message | None = None
        self.open = True
        """It has not closed its end of the channel."""
        self._heard_s = time.monotonic()

    @property
    def took_over(self) -> bool:
        """It has taken the vehicle."""
        return bool(self.events)

    @property
    def outcome(self) -> Outcome | None:
        """How the flight ended that it took over; None: it did not."""
        if not self.took_over:
            return None
        return outcome_of(self.result)

    def listen(self) -> list[ipc.Message]:
        """What it has said since the last call; never waits."""
        heard: list[ipc.Message] = []
        while self.open:
            try:
                message = ipc.receive(self.channel)
            except BlockingIOError:
                break
            if message is None:
                self.open = False
                break
            self._heard_s = time.monotonic()
            heard.append(message)
            if message.get("type") == "event":
                self.events.append(message)
            elif message.get("type") == "guardian_result":
                self.result = message
        return heard

    def hangs(self) -> bool:
        """In charge and silent."""
        return self.open and self.took_over and time.monotonic() - self._heard_s > SILENT_S

    def end(self, patience_s: float) -> None:
        """Make sure that it is gone. After the flight's end it leaves by itself."""
        terminate(self.process, patience_s)
        remove_file(self._number)
        self.listen()
        self.channel.close()

    def kill(self) -> None:
        """At once: there is nothing left that it could land."""
        self.process.kill()

    def trouble(self) -> str | None:
        """One line about a guardian that failed; None: it did not."""
        code = self.process.returncode
        if code not in (0, 1):
            return f"guardian: the guardian process {how_it_ended(code)}{last_line(self.log)}; see {self.log}"
        if holds_traceback(self.log):
            return f"guardian: an internal error was logged{last_line(self.log)}; see {self.log}"
        return None

    def summary_events(self) -> list[dict[str, Any]]:
        """Its events as summary.json lists events."""
        return [
            {
                "t_s": event["flight_t_s"],
                "mission_t_s": event["t_s"],
                **{key: event[key] for key in ("id", "severity", "action", "text")},
            }
            for event in self.events
        ]


def outcome_of(result: ipc.Message | None) -> Outcome:
    """How a flight ended that the guardian took over, by its `guardian_result`; None: it reported none."""
    if result is None or not result["landed"]:
        return Outcome.LOST
    return Outcome.CRASHED if result["overturned"] else Outcome.ABORTED
