"""Child processes: default signals, termination, JSON lines from their pipes, and the reason for their exit."""

from __future__ import annotations

import contextlib
import io
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.runtime.files import write_whole

TMP_PREFIX = "tmp-"


class LaunchError(Exception):
    """A process of the flight could not be started. The text is one line for the user."""


def use_default_signals() -> None:
    """Restore signals that the parent process left ignored or blocked, so that Ctrl-C and `kill -INT` always work.

    A shell without job control starts `companion ... &` with SIGINT ignored, and children inherit that. With SIGCHLD ignored, the exit
    code of a child is lost. SIGHUP is left unchanged, because `nohup` relies on it. Does nothing outside the main thread, which alone
    can set handlers.
    """
    if threading.current_thread() is not threading.main_thread():
        return
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)


def prepare_streams() -> None:
    """Open the null device as each standard stream that is closed (`companion ... >&-`), and escape characters that standard output's
    encoding lacks, as Python does on standard error.

    In place of a closed stream a socket or a log file would get the stream's number, and child processes would print into it.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(descriptor, True)
            setattr(sys, name, os.fdopen(descriptor, mode, encoding="utf-8"))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def signals_call(numbers: Iterable[int], action: Callable[[], object]) -> Iterator[None]:
    """Call `action` at these signals instead of ending the process."""
    handlers = {number: signal.signal(number, lambda *_: action()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def captured(
    argv: Sequence[str], timeout_s: float, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a program that reads no input to its end, whatever its exit code; return it with its output as text.

    Raises:
        OSError: the program cannot be run.
        subprocess.TimeoutExpired: it did not end in time.
    """
    return subprocess.run(
        argv,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        timeout=timeout_s,
        check=False,
        env=env,
    )


def terminate(process: subprocess.Popen[bytes], patience_s: float = 3.0) -> None:
    """End a child: wait up to `patience_s` for it to exit, then send SIGTERM, then SIGKILL, waiting as long after each. The child
    is reaped and its pipes are closed.
    """
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
    """Write a file in the flight's folder atomically (`companion.runtime.files.write_whole`).

    Raises:
        LaunchError: the file cannot be written.
    """
    try:
        write_whole(path, text.encode())
    except OSError as error:
        raise LaunchError(f"{path}: cannot be written: {error.strerror}; choose another --out") from None


def remove_file(path: Path) -> None:
    """Remove a file with a process id from the flight's folder if possible: the system may assign that id again."""
    with contextlib.suppress(OSError):
        path.unlink()


@contextlib.contextmanager
def scratch_folder(out: Path) -> Iterator[Path]:
    """Create a folder for temporary files in `out`, yield its absolute path, and remove it with all its contents.

    The folder is always new, because an existing one would be removed with its contents.

    Raises:
        LaunchError: the folder cannot be created.
    """
    try:
        path = Path(tempfile.mkdtemp(prefix=TMP_PREFIX, dir=out))
    except OSError as error:
        raise LaunchError(f"{out}: cannot create a folder there: {error.strerror}; choose another --out") from None
    try:
        yield path.absolute()
    finally:
        shutil.rmtree(path, ignore_errors=True)


def how_it_ended(code: int) -> str:
    """Return a description of a return code of `subprocess`."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"was ended by signal {-code}"


class JsonLines:
    """JSON objects, one per line, that a child process writes to a pipe.

    Args:
        fd: read end of the pipe.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._buffer = b""
        self.ended = False
        """Whether the child has closed its end, which means that it has exited or is about to."""

    def read(self, deadline_s: float) -> Iterator[dict[str, Any]]:
        """Yield JSON objects until the deadline (`time.monotonic`; 0: those that have arrived) or the end of the pipe."""
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
    """Return whether the end of a log shows an internal error."""
    return "Traceback (most recent call last)" in _tail(path)


def last_line(path: Path) -> str:
    """Return the last non-empty line of a log, truncated, as ` (ValueError: text)`; empty if there is none."""
    lines = _tail(path).split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f" ({last[:_LINE_CHARACTERS]})" if last else ""
