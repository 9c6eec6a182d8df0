"""The log file under the MCAP writer."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


class Disk:
    """The log file under the MCAP writer: appends whole pieces, and after the first failure swallows everything.

    On a failure the file is cut back to where it was whole the last time (`commit`), so that it stays readable.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._path = path
        self._whole_bytes = 0
        self._told_bytes = 0
        self.error: str | None = None

    def write(self, data: bytes | bytearray) -> int:
        """Append all of it, or note the error; says that it is written either way."""
        self._told_bytes += len(data)
        if self.error is None:
            rest = memoryview(data)
            try:
                while rest:
                    rest = rest[os.write(self._fd, rest) :]
            except OSError as error:
                self._fail(error)
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Only tells the position: the writer is asked not to seek."""
        if (offset, whence) not in ((0, os.SEEK_CUR), (self._told_bytes, os.SEEK_SET)):
            raise OSError(f"cannot seek to {offset} ({whence})")
        return self._told_bytes

    def flush(self) -> None:
        """Nothing is buffered here."""

    def commit(self) -> None:
        """What is written so far is a whole log."""
        if self.error is None:
            self._whole_bytes = self._told_bytes

    def sync(self) -> None:
        """Bring what is written onto the medium: a fallen vehicle may lose its power."""
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
        self.error = f"recorder: {self._path}: {error.strerror}; the log ends here, the flight goes on without it"
        with contextlib.suppress(OSError):
            os.ftruncate(self._fd, self._whole_bytes)
