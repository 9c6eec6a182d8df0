"""What differs between a parameter file and a PX4, and bringing PX4 to the file. Talks to the autopilot edge, prints nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from companion.config.px4_defaults import PX4_DEFAULTS
from companion.io.protocols import DeviceError
from companion.model.types import AutopilotStatus
from companion.px4.params_file import Value, same
from companion.px4.wanted import BY_NAME, NO_VEHICLE


class ParamLink(Protocol):
    """What is needed of the autopilot edge."""

    def status(self) -> AutopilotStatus | None:
        """Latest slow state."""

    async def read_params(self, names: Iterable[str]) -> dict[str, Value]:
        """Values by name; absent names are left out."""

    async def write_param(self, name: str, value: Value) -> Value:
        """Write, read back; what PX4 now holds."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One parameter that PX4 holds otherwise than the file."""

    name: str
    px4: Value
    file: Value

    @property
    def reboot(self) -> bool | None:
        """It takes effect after a reboot; None: not known of this one."""
        wanted = BY_NAME.get(self.name)
        return None if wanted is None else wanted.reboot

    @property
    def type_problem(self) -> str | None:
        """Why it cannot be written: the file says another type than PX4; None: it can."""
        if isinstance(self.px4, int) is isinstance(self.file, int):
            return None
        names = ("a REAL32", "an INT32")
        return f"PX4 has {names[isinstance(self.px4, int)]}, the file says {names[isinstance(self.file, int)]}"


@dataclass(frozen=True, slots=True)
class Comparison:
    """A file against a PX4."""

    differences: tuple[Difference, ...]
    absent: tuple[str, ...]
    """In the file, but PX4 does not have them; those of another version of PX4 (`Wanted.only`) do not count."""
    absent_port: tuple[str, ...]
    """The same, of a serial port that this PX4 does not have: a simulator, or a board without TELEM2. Nothing is wrong with that."""
    measured: tuple[Difference, ...] = ()
    """Accepted values other than the file's, of what is measured on each installation: left as they are. Nothing is wrong with that."""

    @property
    def same(self) -> bool:
        """PX4 is as the file says."""
        return not self.differences and not self.absent


@dataclass(frozen=True, slots=True)
class WriteResult:
    """What became of the writing."""

    written: tuple[Difference, ...]
    problem: str | None
    """Why it ended early, one line; None: everything was written, and read back."""


def compare(wanted: Mapping[str, Value], found: Mapping[str, Value]) -> Comparison:
    """A file's values against PX4's. Pure."""
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
        elif name not in BY_NAME or not BY_NAME[name].only:
            absent.append(name)
    return Comparison(tuple(differences), tuple(absent), tuple(absent_port), tuple(measured))


def _is_measured(difference: Difference) -> bool:
    """Somebody measured what PX4 holds, and the file only has the project's value to begin with."""
    wanted = BY_NAME.get(difference.name)
    if wanted is None or not wanted.measured or wanted.value is None or wanted.limits is None:
        return False
    low, high = wanted.limits(NO_VEHICLE)
    begun = same(difference.file, wanted.value) and not same(difference.px4, PX4_DEFAULTS[difference.name])
    return begun and low <= difference.px4 <= high


async def write(link: ParamLink, differences: Iterable[Difference]) -> WriteResult:
    """Write each, verified by reading back; stops at the first that fails, and as soon as PX4 is armed."""
    written: list[Difference] = []
    for difference in differences:
        status = link.status()
        if status is None or status.armed:
            return WriteResult(tuple(written), "PX4 is armed, or silent: parameters are written on the ground")
        if difference.type_problem is not None:
            return WriteResult(tuple(written), f"{difference.name}: {difference.type_problem}; correct the file")
        try:
            await link.write_param(difference.name, difference.file)
        except DeviceError as error:
            return WriteResult(tuple(written), str(error))
        written.append(difference)
    return WriteResult(tuple(written), None)
