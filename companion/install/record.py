"""Record of an installation, kept on the vehicle's computer so that it can be reverted exactly.

It is written before the first change (with `complete` false) and again after the last one.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.install.state import InstallError, PathState, write_state

RECORD_PATH = "/var/lib/companion/installed.json"
SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True)
class Entry:
    """Content of one path before and after the installation."""

    before: PathState
    after: PathState


@dataclass(frozen=True, slots=True)
class Record:
    """An installation, including later changes to it."""

    entries: Mapping[str, Entry] = field(default_factory=dict)
    """Entries by path on the vehicle's computer."""
    folders: tuple[str, ...] = ()
    """Folders that the installation created, outermost first."""
    users: tuple[str, ...] = ()
    joined: tuple[str, ...] = ()
    """Existing users that the installation added to the dialout group."""
    complete: bool = False


def under_root(root: Path, path: str) -> Path:
    """Return where a path of the vehicle's computer lies below `root`."""
    return root / path.lstrip("/")


def load(root: Path) -> Record | None:
    """Read the record; None if nothing is installed.

    Raises:
        InstallError: the file is not a valid record, or users other than root can change it.
    """
    path = under_root(root, RECORD_PATH)
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_uid not in (0, os.geteuid()) or found.st_mode & 0o022:
            raise InstallError(f"{path}: expected a file that only root can change; this one is not trusted")
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema_version"] != SCHEMA_VERSION:
            raise InstallError(
                f"{path}: schema_version {data['schema_version']}, expected {SCHEMA_VERSION}; use the companion version that wrote it"
            )
        entries = {
            str(name): Entry(PathState.from_json(entry["before"]), PathState.from_json(entry["after"]))
            for name, entry in data["files"].items()
        }
        folders, users, joined = (tuple(map(str, data[key])) for key in ("folders", "users", "joined"))
        return Record(entries=entries, folders=folders, users=users, joined=joined, complete=bool(data["complete"]))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InstallError(f"{path}: cannot be read: {error.strerror}; run this command as root") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InstallError(f"{path}: not a valid record of an installation; it has been edited by hand") from None


def save(root: Path, record: Record) -> None:
    """Write the record.

    Raises:
        OSError: the record cannot be written.
    """
    data: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "complete": record.complete,
        "users": record.users,
        "joined": record.joined,
        "folders": record.folders,
        "files": {
            name: {"before": e.before.as_json(), "after": e.after.as_json()} for name, e in record.entries.items()
        },
    }
    write_state(
        under_root(root, RECORD_PATH), PathState(content=(json.dumps(data, indent=1) + "\n").encode(), mode=0o600)
    )
