"""Child processes: the signals that they inherit, ended for sure, and what can be said of one that ended by itself."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.runtime.files import write_whole

TMP_PREFIX = "tmp-"


class LaunchError(Exception):
    """A process of the flight could not be started; one line."""


def use_default_signals() -> None:
    """Undo which signals the parent left ignored or blocked, so that Ctrl-C and `kill -INT` work however we were started.

    A shell without job control starts `companion ... &` with SIGINT ignored, and children inherit that. With SIGCHLD ignored, the
    exit code of a child is lost. SIGHUP stays as it is: `nohup` means it. Does nothing in a thread other than the main one, which
    cannot set handlers: there the program around it decides.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)


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


def write_text(path: Path, text: str) -> None:
    """Write a file of the flight's folder whole (`companion.runtime.files.write_whole`).

    Raises:
        LaunchError: the file cannot be written.
    """
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise LaunchError(f"{path}: cannot be written: {error.strerror}; choose another --out") from None


def remove_file(path: Path) -> None:
    """Remove a file of the flight's folder, if it can be removed: the number of a process that is gone may become another's."""
    with contextlib.suppress(OSError):
        path.unlink()


@contextlib.contextmanager
def scratch_folder(out: Path) -> Iterator[Path]:
    """Make a new folder for temporary files in `out`, yield its absolute path, and remove it with all that children left in it.

    A folder that was there before is never taken, whatever its name: it would be removed.

    Raises:
        LaunchError: it cannot be made.
    """
    try:
        path = Path(tempfile.mkdtemp(prefix=TMP_PREFIX, dir=out))
    except OSError as error:
        raise LaunchError(f"{out}: a folder in it cannot be made: {error.strerror}; choose another --out") from None
    try:
        yield path.absolute()
    finally:
        shutil.rmtree(path, ignore_errors=True)


def how_it_ended(code: int) -> str:
    """What a return code of `subprocess` says, for people."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


class JsonLines:
    """JSON objects, one a line, that a child process writes to a pipe.

    Args:
        fd: read end of the pipe.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._buffer = b""
        self.ended = False
        """The child has closed its end: it has exited or is about to."""

    def read(self, deadline_s: float) -> Iterator[dict[str, Any]]:
        """Yield objects until the deadline (`time.monotonic`; 0 for those that have arrived) or the end of the pipe."""
        while not self.ended:
            while b"\n" in self._buffer:
                line, _, self._buffer = self._buffer.partition(b"\n")
                with contextlib.suppress(ValueError):
                    message = json.loads(line)
                    if isinstance(message, dict):
                        yield message
            if not select.select([self._fd], [], [], max(0.0, deadline_s - time.monotonic()))[0]:
                return
            data = os.read(self._fd, 65536)
            self.ended = not data
            self._buffer += data


_LOG_TAIL_BYTES = 65536
_LINE_CHARACTERS = 200


def _tail(path: Path) -> str:
    with contextlib.suppress(OSError), open(path, "rb") as log:
        log.seek(max(0, log.seek(0, os.SEEK_END) - _LOG_TAIL_BYTES))
        return log.read().decode(errors="replace")
    return ""


def holds_traceback(path: Path) -> bool:
    """The end of a log shows an internal error."""
    return "Traceback (most recent call last)" in _tail(path)


def last_line(path: Path) -> str:
    """` (ValueError: what it said)`: the last line of a log, if there is one."""
    lines = _tail(path).split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f" ({last[:_LINE_CHARACTERS]})" if last else ""
