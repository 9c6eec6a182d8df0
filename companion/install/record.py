"""What an installation changed, kept on the computer itself, so that it can be taken back exactly.

Written before anything is changed (`complete` false), and again when all of it is done.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.install.state import InstallError, State, put

PATH = "/var/lib/companion/installed.json"
SCHEMA_VERSION = 1


@dataclass(frozen=True, slots=True)
class Entry:
    """One path."""

    before: State
    after: State


@dataclass(frozen=True, slots=True)
class Record:
    """One installation, with everything that later ones changed of it."""

    entries: Mapping[str, Entry] = field(default_factory=dict)
    """By path on the vehicle's computer."""
    folders: tuple[str, ...] = ()
    """Folders that were not there before, outermost first."""
    users: tuple[str, ...] = ()
    """Users that were not there before."""
    joined: tuple[str, ...] = ()
    """Users who were there, but not in dialout."""
    complete: bool = False


def inside(root: Path, path: str) -> Path:
    """Where a path of the vehicle's computer is, seen from here."""
    return root / path.lstrip("/")


def load(root: Path) -> Record | None:
    """The record; None: nothing is installed.

    Raises:
        InstallError: it is not one, or not one that may be trusted.
    """
    path = inside(root, PATH)
    try:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_uid not in (0, os.geteuid()) or found.st_mode & 0o022:
            raise InstallError(f"{path}: expected a file that only its owner, root, can change; it is not trusted")
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema_version"] != SCHEMA_VERSION:
            raise InstallError(
                f"{path}: schema_version {data['schema_version']}, expected {SCHEMA_VERSION}; use the companion that wrote it"
            )
        entries = {
            str(name): Entry(State.from_json(entry["before"]), State.from_json(entry["after"]))
            for name, entry in data["files"].items()
        }
        folders, users, joined = (tuple(map(str, data[key])) for key in ("folders", "users", "joined"))
        return Record(entries, folders, users, joined, bool(data["complete"]))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InstallError(f"{path}: cannot be read: {error.strerror}; is this root?") from None
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InstallError(f"{path}: is no record of an installation; it was changed by hand") from None


def save(root: Path, record: Record) -> None:
    """Write it.

    Raises:
        OSError: it cannot be written.
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
    put(inside(root, PATH), State(content=(json.dumps(data, indent=1) + "\n").encode(), mode=0o600))
