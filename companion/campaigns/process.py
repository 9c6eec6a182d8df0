"""Parent process of a campaign: starts `python -m sitl.campaigns` and reads the results as the flights end."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from companion.model.exit_codes import EXIT_BAD_INPUT, EXIT_LOST

STALL_TIMEOUT_S = 300.0
"""Time without a result after which a campaign is treated as hung; a flight takes seconds."""
STOP_TIMEOUT_S = 3.0
_POLL_S = 0.2
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Message = dict[str, Any]


class CampaignError(Exception):
    """The campaign cannot continue. The text is one line for the user."""

    def __init__(self, text: str, *, bad_input: bool = False) -> None:
        super().__init__(text)
        self.bad_input = bad_input
        """Whether the user's input is the cause; if so, nothing was flown."""

    @property
    def exit_code(self) -> int:
        """Exit code of the command."""
        return EXIT_BAD_INPUT if self.bad_input else EXIT_LOST


class CampaignProcess:
    """A running campaign in its own process group. As a context manager it ends the campaign and all of its workers.

    Args:
        log: file for the campaign's standard error; deleted at the end if it is empty.
    """

    def __init__(self, job: Message, log: Path) -> None:
        self._log = log
        self._buffer = b""
        self._stop_asked = False
        # One flight per core: more threads inside a flight only compete with the other flights.
        environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        with open(log, "wb") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "sitl.campaigns"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                env=environment,
                start_new_session=True,
            )
        assert self._process.stdin is not None
        # The pipe stays open: the campaign ends when it closes.
        self._send(job)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for number in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, number)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_TIMEOUT_S)
                break
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        with contextlib.suppress(OSError):
            # Workers that are stopped during a flight write tracebacks.
            if self._stop_asked or self._log.stat().st_size == 0:
                self._log.unlink()

    def _send(self, data: Message) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(data).encode() + b"\n")
            self._process.stdin.flush()

    def ask_to_stop(self) -> None:
        """Make `results` end soon. May be called in a signal handler."""
        self._stop_asked = True

    def fly(self, flights: Sequence[Message]) -> Iterator[Message]:
        """Fly a batch of a job with `batches`; yield the result of each flight as it ends, until the last one or until asked to stop.

        Raises:
            CampaignError: as `results`.
        """
        self._send({"flights": list(flights)})
        yield from itertools.islice(self.results(), len(flights))

    def results(self) -> Iterator[Message]:
        """Yield the result of each flight as it ends, until the last one or until asked to stop.

        Raises:
            CampaignError: the campaign reported an error, died or is hanging.
        """
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        heard_s = time.monotonic()
        while not self._stop_asked:
            if not select.select([fd], [], [], _POLL_S)[0]:
                if time.monotonic() - heard_s > STALL_TIMEOUT_S:
                    raise CampaignError(
                        f"campaign: no flight has ended for {STALL_TIMEOUT_S:g} s; the campaign was stopped; see {self._log}"
                    )
                continue
            data = os.read(fd, 1 << 20)
            heard_s = time.monotonic()
            if not data:
                self._check_exit()
                return
            *lines, self._buffer = (self._buffer + data).split(b"\n")
            for line in lines:
                message = json.loads(line)
                if message["type"] == "error":
                    raise CampaignError(message["text"], bad_input=message["bad_input"])
                yield message

    def _check_exit(self) -> None:
        try:
            code = self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return  # its output is complete
        if code == 0:
            return
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = f": {lines[-1].strip()[:200]}" if lines else ""
        how = f"exit code {code}" if code > 0 else f"signal {-code}"
        raise CampaignError(f"campaign: ended by {how}{last}; see {self._log}")
