"""Content of a path (a file, a symbolic link or nothing): reading, writing and comparing it."""

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
    """The installation failed. The text is one line; changes were rolled back unless the text states otherwise."""


@dataclass(frozen=True, slots=True)
class PathState:
    """A file, a symbolic link, or nothing."""

    content: bytes | None = None
    link: str | None = None
    mode: int = 0
    """Permission bits of a file."""
    owner: tuple[int, int] | None = None
    """User and group id of a file that existed before; None for the user who runs the installation."""

    @property
    def absent(self) -> bool:
        """Whether nothing exists at the path."""
        return self.content is None and self.link is None

    def matches(self, other: PathState) -> bool:
        """Return whether both are equal; an unknown owner matches any owner."""
        owners = self.owner is None or other.owner is None or self.owner == other.owner
        return owners and (self.content, self.link, self.mode) == (other.content, other.link, other.mode)

    def as_json(self) -> dict[str, Any] | None:
        """Return the state as JSON data; None if nothing exists at the path."""
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
    def from_json(data: dict[str, Any] | None) -> PathState:
        """Parse the data that `as_json` returned.

        Raises:
            KeyError, TypeError, ValueError: the data is invalid.
        """
        if data is None:
            return PathState()
        if "link" in data:
            return PathState(link=str(data["link"]))
        content = data["text"].encode() if "text" in data else base64.b64decode(data["base64"], validate=True)
        owner = data["owner"]
        return PathState(
            content=content, mode=int(data["mode"], 8), owner=None if owner is None else (int(owner[0]), int(owner[1]))
        )


def read_state(path: Path) -> PathState:
    """Return the content of a path.

    Raises:
        InstallError: the path is neither a file nor a link, or cannot be read.
    """
    try:
        found = path.lstat()
        if stat.S_ISLNK(found.st_mode):
            return PathState(link=os.readlink(path))
        if not stat.S_ISREG(found.st_mode):
            raise InstallError(f"{path}: expected a file, a link or nothing; move it away")
        return PathState(
            content=path.read_bytes(), mode=stat.S_IMODE(found.st_mode), owner=(found.st_uid, found.st_gid)
        )
    except FileNotFoundError:
        return PathState()
    except OSError as error:
        raise InstallError(f"{path}: cannot be read: {error.strerror}") from None


def write_state(path: Path, state: PathState) -> None:
    """Write, replace or remove a path atomically, even across a loss of power.

    Raises:
        OSError: the change failed; the path is unchanged.
    """
    if state.link is not None:
        new_path = path.with_name(f".{path.name}.companion-new")
        new_path.unlink(missing_ok=True)
        new_path.symlink_to(state.link)
        new_path.replace(path)
    elif state.content is not None:
        owner = None if state.owner == (os.geteuid(), os.getegid()) else state.owner
        write_whole(path, state.content, mode=state.mode, owner=owner, durable=True)
    else:
        path.unlink(missing_ok=True)
