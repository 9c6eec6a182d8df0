"""Atomic writing of a file: a reader finds either the old or the new content, never a part of it."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO


def write_whole(
    path: Path,
    data: bytes,
    *,
    mode: int | None = None,
    owner: tuple[int, int] | None = None,
    replace: bool = True,
    durable: bool = False,
) -> None:
    """Write a file as `whole_file` does.

    Args:
        durable: whether to wait until the content is on the storage medium, so that it survives a loss of power.

    Raises:
        FileExistsError: the file exists and `replace` is False; it is left unchanged.
        OSError: the file cannot be written; an existing one is left unchanged.
    """
    with whole_file(path, mode=mode, owner=owner, replace=replace) as file:
        file.write(data)
        if durable:
            file.flush()
            os.fsync(file.fileno())


@contextlib.contextmanager
def whole_file(
    path: Path, *, mode: int | None = None, owner: tuple[int, int] | None = None, replace: bool = True
) -> Iterator[IO[bytes]]:
    """Open a temporary file in the same folder that becomes the file at the end, so that a failure leaves no partial file.

    Args:
        mode: permission bits; None for the default of the process (umask).
        owner: user and group id; None for those of the process.
        replace: False refuses to replace an existing file.

    Raises:
        FileExistsError: the file exists and `replace` is False; it is left unchanged.
        OSError: the file cannot be written; an existing one is left unchanged.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(8)}.part")
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        with open(os.open(part, flags, 0o666 if mode is None else 0o600), "wb") as file:
            if owner is not None:
                os.fchown(file.fileno(), *owner)
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            yield file
        if replace:
            part.replace(path)
        else:
            os.link(part, path)
    except OSError as error:
        error.filename = str(path)  # a failed write has none, and a failed open that of the temporary file
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink()
