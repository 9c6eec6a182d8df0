"""Record of passed hand tests: the motion-capture set-ups that an IMU has confirmed.

The file is `$XDG_STATE_HOME/companion/hand-tests.json`, or else `~/.local/state/companion/hand-tests.json`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from companion.config.vehicle import Vehicle
from companion.model.check_row import Row
from companion.runtime.files import write_whole

SCHEMA_VERSION = 1
FILE = "companion/hand-tests.json"


class RecordError(Exception):
    """The record cannot be read or written. The text is one line for the operator."""


@dataclass(frozen=True, slots=True)
class Setup:
    """Settings for which a passed test is valid. A change of any of them invalidates it."""

    vehicle: str
    server: str
    """devices.mocap.server."""
    rigid_body_id: int
    up_axis: str
    natnet_version: str
    """NatNet version as reported by the server."""

    @classmethod
    def of(cls, vehicle: Vehicle, natnet_version: str) -> Setup:
        """Return the set-up given by a vehicle file and by the NatNet version that the server reports."""
        device = vehicle.devices.mocap
        return cls(
            vehicle=vehicle.name,
            server=device.server,
            rigid_body_id=device.rigid_body_id,
            up_axis=device.up_axis,
            natnet_version=natnet_version,
        )


@dataclass(frozen=True, slots=True)
class Passed:
    """One passed test."""

    setup: Setup
    at: str
    """UTC, ISO 8601."""
    measured: Mapping[str, str]
    """Measured text of each row, by the row's id."""


def record_path(environment: Mapping[str, str] = os.environ) -> Path:
    """Return the path of the record."""
    state = environment.get("XDG_STATE_HOME", "")
    # The XDG specification requires a relative path to be ignored.
    folder = Path(state) if state and Path(state).is_absolute() else Path.home() / ".local/state"
    return folder / FILE


def on_record(setup: Setup, tests: Sequence[Passed]) -> tuple[str, str]:
    """Return when the test was passed with this set-up, and what has changed since it was passed with another one of the same vehicle;
    one of the texts, or both, are empty (`Observations.hand_test`, `hand_test_changed`).
    """
    for test in reversed(tests):
        if test.setup == setup:
            return f"passed on {test.at}", ""
    for test in reversed(tests):
        if test.setup.vehicle == setup.vehicle:
            then, now = asdict(test.setup), asdict(setup)
            changes = [f"{key} changed from {then[key]} to {now[key]}" for key in now if then[key] != now[key]]
            return "", f"passed on {test.at}, but since then {', '.join(changes)}"
    return "", ""


def with_passed(tests: Sequence[Passed], setup: Setup, at: datetime, rows: Sequence[Row]) -> list[Passed]:
    """Return the tests plus a newly passed one, which replaces an older test with the same set-up."""
    measured = {row.id: row.read for row in rows}
    return [*(test for test in tests if test.setup != setup), Passed(setup, at.isoformat(timespec="seconds"), measured)]


def load(path: Path) -> list[Passed]:
    """Return all passed tests; an empty list if there is no record.

    Raises:
        RecordError: the record exists but cannot be parsed.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["schema_version"] != SCHEMA_VERSION:
            raise RecordError(
                f"{path}: schema_version {document['schema_version']}, expected {SCHEMA_VERSION}; remove the file"
            )
        return [Passed(_setup(test["setup"]), str(test["at"]), dict(test["measured"])) for test in document["passed"]]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordError(f"{path}: cannot be read ({error.strerror}); correct its permissions") from None
    except (ValueError, TypeError, KeyError) as error:
        raise RecordError(f"{path}: is not a record of hand tests ({error!r}); remove the file") from None


def save(path: Path, tests: Sequence[Passed]) -> None:
    """Replace the whole record.

    Raises:
        RecordError: the record cannot be written.
    """
    document = {"schema_version": SCHEMA_VERSION, "passed": [asdict(test) for test in tests]}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(document, indent=1).encode())
    except OSError as error:
        raise RecordError(f"{path}: cannot be written ({error.strerror}); correct its permissions") from None


def _setup(values: Mapping[str, Any]) -> Setup:
    known = {field.name for field in fields(Setup)}
    if set(values) != known:
        raise ValueError(f"setup has {sorted(values)}")
    return Setup(**values)
