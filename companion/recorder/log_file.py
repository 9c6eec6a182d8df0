"""The file that the MCAP writer writes to."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class LogFile:
    """File object for the MCAP writer: appends complete writes, and discards everything after the first failure.

    On a failure the file is truncated to the last complete log (`commit`), so that it stays readable.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._path = path
        self._committed_bytes = 0
        self._position_bytes = 0
        self.error: str | None = None
        self.failure: OSError | None = None

    def write(self, data: bytes | bytearray) -> int:
        """Append all data, or record the error; return the length in both cases."""
        self._position_bytes += len(data)
        if self.error is None:
            rest = memoryview(data)
            try:
                while rest:
                    rest = rest[os.write(self._fd, rest) :]
            except OSError as error:
                self._fail(error)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Return the position; the writer is configured not to seek.

        Raises:
            OSError: a seek to a position other than the current one was requested.
        """
        if (offset, whence) not in ((0, os.SEEK_CUR), (self._position_bytes, os.SEEK_SET)):
            raise OSError(f"cannot seek to {offset} ({whence})")
        return self._position_bytes

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def commit(self) -> None:
        """Mark the data so far as a complete log."""
        if self.error is None:
            self._committed_bytes = self._position_bytes

    def sync(self) -> None:
        """Write the data to the medium: a vehicle that crashes may lose its power."""
        if self.error is None:
            try:
                os.fdatasync(self._fd)
            except OSError as error:
                self._fail(error)

    def close(self) -> None:
        """Close the file."""
        self.sync()
        os.close(self._fd)

    def _fail(self, error: OSError) -> None:
        error.filename = str(self._path)
        self.failure = error
        self.error = f"recorder: {self._path}: {error.strerror}; the log ends here and the flight continues"
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._committed_bytes)
