"""A proposed change to the vehicle file: printed for users and scripts, written only with `--write`."""

from __future__ import annotations

import difflib
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.commissioning.yaml_edit import EditError, edited
from companion.config.base import Location
from companion.config.document import ConfigError, Data, Document, Origin, key_path, problem_lines
from companion.config.loader import vehicle_of
from companion.config.yaml_strict import parse_document, read_document
from companion.runtime.files import write_whole

_BOM = "\ufeff"


@dataclass(frozen=True, slots=True)
class Change:
    """A value that changes."""

    location: Location
    old: Data
    """Old value; None if the file does not have the key."""
    new: Data
    origin: Origin | None
    """Place of the old value; None if the file does not have the key."""

    @property
    def key(self) -> str:
        """Return the location as `arm.joints[1].sign`."""
        return key_path(self.location)

    def as_json(self) -> dict[str, Any]:
        """Return the change as part of the JSON document."""
        at = self.origin
        return {
            "key": self.key,
            "old": self.old,
            "new": self.new,
            "line": at.line if at else None,
            "column": at.column if at else None,
        }


@dataclass(frozen=True, slots=True)
class Patch:
    """Changes to a vehicle file; falsy if the file already has all of these values."""

    path: Path
    shown: str
    """The file's name as the user wrote it."""
    changes: tuple[Change, ...]
    before: bytes
    """The file as it was when the patch was made."""
    after: bytes

    def __bool__(self) -> bool:
        return bool(self.changes)

    @property
    def text(self) -> str:
        """Return the change as a unified diff."""
        if not self.changes:
            return f"# {self.shown}: nothing to change"
        old, new = (data.decode("utf-8-sig").splitlines() for data in (self.before, self.after))
        return "\n".join(difflib.unified_diff(old, new, self.shown, self.shown, n=1, lineterm=""))

    def as_json(self) -> dict[str, Any]:
        """Return the patch as part of the JSON document."""
        return {"file": self.shown, "changes": [change.as_json() for change in self.changes], "text": self.text}

    def write(self) -> Path:
        """Write the file and keep the old one beside it; return the path of that backup.

        Raises:
            ConfigError: the file has changed since it was read or cannot be written; it is left unchanged.
        """
        path = self.path.resolve()
        try:
            if path.read_bytes() != self.before:
                raise ConfigError(
                    f"{self.shown}: has changed since it was read; nothing was written; run the tool again"
                )
            backup = _back_up(path, self.before)
            write_whole(path, self.after, mode=stat.S_IMODE(path.stat().st_mode), durable=True)
        except OSError as error:
            raise ConfigError(
                f"{self.shown}: cannot be written: {error.strerror or error}; change it by hand as printed"
            ) from None
        return backup


def propose(vehicle_path: str | Path, changes: Mapping[Location, Data]) -> Patch:
    """Return the patch that sets values in the vehicle file. Nothing is written.

    Args:
        changes: new values by location, in the file's units: `{("arm", "joints", 0, "sign"): -1}`. Values that the file already has
            are left out; missing keys are added. Round the values first: they are written as given.

    Raises:
        ConfigError: the file cannot be read, or would become invalid; one line per problem.
    """
    path, shown = Path(vehicle_path), str(vehicle_path)
    document = read_document(path)
    if document.problems:
        raise ConfigError(problem_lines(document.problems))
    before = path.read_bytes()
    found = tuple(_change(document, location, new) for location, new in changes.items())
    wanted = tuple(change for change in found if change.origin is None or not _same(change.old, change.new))
    text = before.decode("utf-8-sig")
    try:
        new_text = edited(text, {change.location: change.new for change in wanted})
    except EditError as error:
        raise ConfigError(f"{shown}: {error}") from None
    _check(shown, new_text, wanted)
    bom = _BOM if before.startswith(_BOM.encode()) else ""
    return Patch(path=path, shown=shown, changes=wanted, before=before, after=(bom + new_text).encode())


def _change(document: Document, location: Location, new: Data) -> Change:
    try:
        old = document.get(location)
    except (KeyError, IndexError):
        return Change(location, None, new, None)
    return Change(location, old, new, document.origin(location))


def _same(old: Data, new: Data) -> bool:
    return old == new and isinstance(old, bool) == isinstance(new, bool)


def _check(shown: str, text: str, changes: tuple[Change, ...]) -> None:
    document, lines = parse_document(text, shown), list[str]()
    for change in changes:
        if not _same(document.get(change.location), change.new):
            raise ConfigError(f"{shown}: {change.key} cannot be changed by this tool; write it by hand: {change.new}")
    if vehicle_of(document, lines) is None:
        raise ConfigError([f"{line} (after the proposed change)" for line in lines])


def _back_up(path: Path, data: bytes) -> Path:
    number = 0
    while True:
        backup = path.with_name(f"{path.name}.bak{number or ''}")
        try:
            with backup.open("xb") as file:
                file.write(data)
        except FileExistsError:
            number += 1
            continue
        return backup
