"""The companion's end of a campaign: `python -m sitl.campaigns.flights` or another as a child, its results as they come."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

STALL_TIMEOUT_S = 300.0
"""A flight takes seconds; a campaign that says nothing for so long hangs."""
STOP_TIMEOUT_S = 3.0
_POLL_S = 0.2
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Message = dict[str, Any]


class CampaignError(Exception):
    """The campaign did not come to its end; one line."""

    def __init__(self, text: str, *, bad_input: bool = False) -> None:
        super().__init__(text)
        self.bad_input = bad_input
        """What the user asked for cannot be had; nothing was flown."""


class CampaignProcess:
    """A running campaign, with a process group of its own for its workers; a context manager, at whose end nobody is left.

    Args:
        job: as on standard input of the module.
        log: where its standard error goes; removed again if it holds nothing of interest.
        module: what is to be run.
    """

    def __init__(self, job: Message, log: Path, module: str = "sitl.campaigns.flights") -> None:
        self._log = log
        self._buffer = b""
        self._stop_asked = False
        # Flights run beside each other, one per core: threads inside of them would only fight.
        environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        with open(log, "wb") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                env=environment,
                start_new_session=True,
            )
        assert self._process.stdin is not None
        # The pipe stays open: its end tells the campaign that we are gone.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(job).encode() + b"\n")
            self._process.stdin.flush()

    def __enter__(self) -> CampaignProcess:
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
            # Workers that were stopped half way complain of it.
            if self._stop_asked or self._log.stat().st_size == 0:
                self._log.unlink()

    def ask_to_stop(self) -> None:
        """`results` ends soon; safe in a signal handler."""
        self._stop_asked = True

    def results(self) -> Iterator[Message]:
        """Flights as they end, until the last one or until asked to stop.

        Raises:
            CampaignError: the campaign gave up, died or hangs.
        """
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        heard_s = time.monotonic()
        while not self._stop_asked:
            if not select.select([fd], [], [], _POLL_S)[0]:
                if time.monotonic() - heard_s > STALL_TIMEOUT_S:
                    raise CampaignError(f"campaign: no flight has ended within {STALL_TIMEOUT_S:g} s; see {self._log}")
                continue
            data = os.read(fd, 1 << 20)
            heard_s = time.monotonic()
            if not data:
                self._check_end()
                return
            self._buffer += data
            while b"\n" in self._buffer:
                line, _, self._buffer = self._buffer.partition(b"\n")
                message = json.loads(line)
                if message["type"] == "error":
                    raise CampaignError(message["text"], bad_input=message["bad_input"])
                yield message

    def _check_end(self) -> None:
        try:
            code = self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return  # it has said all it had to say
        if code == 0:
            return
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = f": {lines[-1].strip()[:200]}" if lines else ""
        how = f"exit code {code}" if code > 0 else f"signal {-code}"
        raise CampaignError(f"campaign: ended by {how}{last}; see {self._log}")
