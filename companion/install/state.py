"""What stands at a path: read it, put it there, compare."""

from __future__ import annotations

import base64
import contextlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.runtime.files import write_whole


class InstallError(Exception):
    """It cannot be done; one line. What had been done is put back already, unless the line says otherwise."""


@dataclass(frozen=True, slots=True)
class State:
    """A file, a symbolic link, or nothing at all."""

    content: bytes | None = None
    link: str | None = None
    mode: int = 0
    """Permission bits of a file."""
    owner: tuple[int, int] | None = None
    """User and group id of a file that was there before; None: whoever installs."""

    @property
    def absent(self) -> bool:
        """Nothing stands there."""
        return self.content is None and self.link is None

    def same(self, other: State) -> bool:
        """Equal as far as both say it."""
        owners = self.owner is None or other.owner is None or self.owner == other.owner
        return owners and (self.content, self.link, self.mode) == (other.content, other.link, other.mode)

    def as_json(self) -> dict[str, Any] | None:
        """None for nothing."""
        if self.absent:
            return None
        if self.link is not None:
            return {"link": self.link}
        assert self.content is not None
        content = {"base64": base64.b64encode(self.content).decode()}
        with contextlib.suppress(UnicodeDecodeError):
            content = {"text": self.content.decode()}
        return {**content, "mode": f"{self.mode:04o}", "owner": self.owner}

    @staticmethod
    def from_json(data: dict[str, Any] | None) -> State:
        """What `as_json` made.

        Raises:
            KeyError, TypeError, ValueError: it did not make this.
        """
        if data is None:
            return State()
        if "link" in data:
            return State(link=str(data["link"]))
        content = data["text"].encode() if "text" in data else base64.b64decode(data["base64"], validate=True)
        owner = data["owner"]
        return State(
            content=content, mode=int(data["mode"], 8), owner=None if owner is None else (int(owner[0]), int(owner[1]))
        )


def read(path: Path) -> State:
    """What stands there.

    Raises:
        InstallError: neither a file nor a link; or it cannot be read.
    """
    try:
        found = path.lstat()
        if stat.S_ISLNK(found.st_mode):
            return State(link=os.readlink(path))
        if not stat.S_ISREG(found.st_mode):
            raise InstallError(f"{path}: expected a file or nothing, found something else; move it away")
        return State(content=path.read_bytes(), mode=stat.S_IMODE(found.st_mode), owner=(found.st_uid, found.st_gid))
    except FileNotFoundError:
        return State()
    except OSError as error:
        raise InstallError(f"{path}: cannot be read: {error.strerror}") from None


def put(path: Path, state: State) -> None:
    """Bring a path to a state, whole or not at all, also through a loss of power.

    Raises:
        OSError: it cannot be done; the path is as it was.
    """
    if state.link is not None:
        beside = path.with_name(f".{path.name}.companion-new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(state.link)
        beside.replace(path)
    elif state.content is not None:
        owner = None if state.owner == (os.geteuid(), os.getegid()) else state.owner
        write_whole(path, state.content, mode=state.mode, owner=owner, durable=True)
    else:
        path.unlink(missing_ok=True)
