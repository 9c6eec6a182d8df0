"""Compares a parameter file with PX4's values and writes the file's values to PX4. Prints nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from companion.io.protocols import DeviceError
from companion.model.types import AutopilotStatus
from companion.px4.defaults import PX4_DEFAULTS
from companion.px4.params_file import Value, same
from companion.px4.required import BY_NAME
from companion.px4.versions import varies


class ParamLink(Protocol):
    """The part of the autopilot driver that parameter transfer needs."""

    def status(self) -> AutopilotStatus | None:
        """Return the latest status, or None before the first heartbeat."""

    async def read_params(self, names: Iterable[str]) -> dict[str, Value]:
        """Return values by name; absent names are left out."""

    async def write_param(self, name: str, value: Value) -> Value:
        """Write a value, read it back and return the value that PX4 now holds."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One parameter whose value in PX4 differs from the file's."""

    name: str
    px4: Value
    file: Value

    @property
    def reboot(self) -> bool | None:
        """Return whether a new value takes effect only after a reboot, or None if that is not known."""
        wanted = BY_NAME.get(self.name)
        return None if wanted is None else wanted.reboot

    @property
    def type_problem(self) -> str | None:
        """Return why the value cannot be written (the types in the file and in PX4 differ), or None if it can."""
        if isinstance(self.px4, int) is isinstance(self.file, int):
            return None
        names = ("a REAL32", "an INT32")
        return f"PX4 has {names[isinstance(self.px4, int)]}, but the file has {names[isinstance(self.file, int)]}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of comparing a file with a PX4."""

    differences: tuple[Difference, ...]
    absent: tuple[str, ...]
    """Parameters in the file that PX4 does not have, except those that only some versions of PX4 have."""
    absent_port: tuple[str, ...]
    """Absent parameters of a serial port that this PX4 does not have (a simulator, or a board without TELEM2). This is not an error."""
    measured: tuple[Difference, ...] = ()
    """Values that differ from the file's because they are measured on each installation. They are kept; this is not an error."""

    skipped: Mapping[tuple[int, int], list[str]] = field(default_factory=dict)
    """Names in the file that are not of this PX4, by vehicle and component id."""

    @property
    def same(self) -> bool:
        """Return whether PX4 has the file's values."""
        return not self.differences and not self.absent


@dataclass(frozen=True, slots=True)
class WriteResult:
    """Result of writing parameters."""

    written: tuple[Difference, ...]
    problem: str | None
    """Reason why writing ended early, as one line; None if everything was written and read back."""


def compare(
    wanted: Mapping[str, Value], found: Mapping[str, Value], skipped: Mapping[tuple[int, int], list[str]] | None = None
) -> Comparison:
    """Compare a file's values with PX4's. Pure."""
    differences: list[Difference] = []
    measured: list[Difference] = []
    absent, absent_port = [], []
    of_port = {name for name in wanted if name in BY_NAME and BY_NAME[name].hardware}
    has_port = of_port <= found.keys()
    for name, value in wanted.items():
        if name in of_port and not has_port:
            absent_port.append(name)
        elif name in found:
            if not same(value, found[name]):
                difference = Difference(name, found[name], value)
                (measured if _is_measured(difference) else differences).append(difference)
        elif not varies(name):
            absent.append(name)
    return Comparison(tuple(differences), tuple(absent), tuple(absent_port), tuple(measured), skipped or {})


def _is_measured(difference: Difference) -> bool:
    """Return whether PX4's value was measured while the file has the project's initial value."""
    wanted = BY_NAME.get(difference.name)
    if wanted is None or not wanted.measured or wanted.value is None or not isinstance(wanted.limits, tuple):
        return False
    low, high = wanted.limits
    begun = same(difference.file, wanted.value) and not same(difference.px4, PX4_DEFAULTS[difference.name])
    return begun and low <= difference.px4 <= high


async def write(link: ParamLink, differences: Iterable[Difference]) -> WriteResult:
    """Write each value and verify it by reading it back; stop at the first failure, or as soon as PX4 is armed."""
    written: list[Difference] = []
    for difference in differences:
        status = link.status()
        if status is None or status.armed:
            return WriteResult(
                tuple(written), "PX4 is armed or silent; parameters are written only while it is disarmed"
            )
        if difference.type_problem is not None:
            return WriteResult(tuple(written), f"{difference.name}: {difference.type_problem}; correct the file")
        try:
            await link.write_param(difference.name, difference.file)
        except DeviceError as error:
            return WriteResult(tuple(written), str(error))
        written.append(difference)
    return WriteResult(tuple(written), None)
