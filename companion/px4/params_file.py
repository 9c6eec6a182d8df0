"""Parameter files in QGroundControl's format: tab-separated Vehicle-Id, Component-Id, Name, Value and Type; `#` begins a comment.

The types are those of MAV_PARAM_TYPE: 6 is INT32 and 9 is REAL32; PX4 has no others. Errors are reported with file and line. Spaces or
commas between columns, padded cells and a byte order mark are read, as other tools write them. Only component 1 is PX4; the rows
of other components, such as CAN nodes, have names and types of their own and are skipped. A written value reads back as the original.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from companion.config.document import ConfigError
from companion.config.shipped import FILES

PACKAGED = FILES / "px4/indoor_mocap.params"
"""The project's parameter file."""
INT32, REAL32 = 6, 9
COLUMNS = "# Vehicle-Id\tComponent-Id\tName\tValue\tType"
VEHICLE_ID = COMPONENT_ID = 1
"""Ids of PX4 as delivered; component 1 is the autopilot."""

_NAME = re.compile(r"[A-Z0-9_]{1,16}")
_INTEGER = re.compile(r"[+-]?\d+")
_REAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_INT32_MIN, _INT32_MAX = -(2**31), 2**31 - 1

Value = float | int


@dataclass(frozen=True, slots=True)
class ParamsFile:
    """Contents of a parameter file."""

    source: str
    values: dict[int, dict[str, Value]]
    """Values of PX4 (component 1) by vehicle id and name: an int for INT32, a float in single precision for REAL32."""
    others: dict[tuple[int, int], list[str]]
    """Names of the parameters of other components, by vehicle and component id."""

    def of_vehicle(self, vehicle_id: int) -> tuple[dict[str, Value], dict[tuple[int, int], list[str]]]:
        """Return the values of one vehicle's PX4 by name, and the names of all other parameters by vehicle and component id.

        Raises:
            ConfigError: the file has no parameters of that vehicle.
        """
        if Path(self.source).resolve().parent == PACKAGED.resolve().parent:
            vehicle_id = VEHICLE_ID  # the project's own files are for any vehicle
        if vehicle_id not in self.values:
            found = ", ".join(map(str, self.values))
            text = (
                f"expected parameters of vehicle {vehicle_id} (MAV_SYS_ID of this PX4), found those of vehicle {found}"
            )
            raise ConfigError(f"{self.source}: {text}; export them from this vehicle, or correct the first column")
        skipped = {(vehicle, COMPONENT_ID): list(of) for vehicle, of in self.values.items() if vehicle != vehicle_id}
        return self.values[vehicle_id], skipped | self.others


def read(path: str | Path) -> ParamsFile:
    """Read a parameter file.

    Raises:
        ConfigError: the file is unreadable or invalid; the exception has one line per problem, `file:line: problem`.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: expected UTF-8 text, found byte {error.object[error.start]:#04x}") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from None
    return parse(text, str(path))


def parse(text: str, source: str) -> ParamsFile:
    """Parse the text of a parameter file. `source` is the file name used in messages.

    Raises:
        ConfigError: the text is invalid; the exception has one line per problem.
    """
    values: dict[int, dict[str, Value]] = {}
    others: dict[tuple[int, int], list[str]] = {}
    lines: dict[tuple[int, str], int] = {}
    problems: list[str] = []
    for number, line in enumerate(text.split("\n"), 1):
        row = line.strip()
        if not row or row.startswith("#"):
            continue
        try:
            vehicle, component, name, cell, kind = _cells(row)
            if component != COMPONENT_ID:
                others.setdefault((vehicle, component), []).append(name)
                continue
            value = _value(name, cell, kind)
            if (first := lines.setdefault((vehicle, name), number)) != number:
                raise _WrongError(f"{name} is already set in line {first}")
            values.setdefault(vehicle, {})[name] = value
        except _WrongError as error:
            problems.append(f"{source}:{number}: {error}")
    if not problems and not values:
        found = "; ".join(skipped_lines(others)) or "none"
        problems.append(f"{source}: expected parameters of component {COMPONENT_ID} (PX4), found {found}")
    if problems:
        raise ConfigError(problems)
    return ParamsFile(source, values, others)


def skipped_lines(names: Mapping[tuple[int, int], Iterable[str]]) -> list[str]:
    """Return one line of text for each component whose parameters are skipped."""
    return [f"vehicle {vehicle}, component {component}: {', '.join(of)}" for (vehicle, component), of in names.items()]


class _WrongError(Exception):
    """A line is invalid; the text states the problem."""


def _cells(row: str) -> tuple[int, int, str, str, str]:
    """Return vehicle id, component id, name, value and type of a row; the last three are not checked."""
    cells = [cell.strip() for cell in row.split("\t")] if "\t" in row else re.split(r"[\s,]+", row)
    if len(cells) != 5:
        raise _WrongError(f"expected 5 fields (vehicle, component, name, value, type), found {len(cells)}")
    for title, cell in (("vehicle id", cells[0]), ("component id", cells[1])):
        if not (_INTEGER.fullmatch(cell) and 1 <= int(cell) <= 255):
            raise _WrongError(f"expected a {title} from 1 to 255, found {cell!r}")
    return int(cells[0]), int(cells[1]), cells[2], cells[3], cells[4]


def _value(name: str, cell: str, kind: str) -> Value:
    if _NAME.fullmatch(name) is None:
        raise _WrongError(f"expected a name with 1 to 16 of the characters A-Z, 0-9 and _, found {name!r}")
    if kind not in (str(INT32), str(REAL32)):
        raise _WrongError(f"{name}: expected type {INT32} (INT32) or {REAL32} (REAL32), found {kind!r}")
    return _int32(name, cell) if kind == str(INT32) else _real32(name, cell)


def _int32(name: str, cell: str) -> int:
    if _INTEGER.fullmatch(cell) is None:
        raise _WrongError(f"{name}: expected a whole number (type {INT32}), found {cell!r}")
    if not _INT32_MIN <= int(cell) <= _INT32_MAX:
        raise _WrongError(f"{name}: expected a whole number that fits into 32 bits, found {cell}")
    return int(cell)


def _real32(name: str, cell: str) -> float:
    if _REAL.fullmatch(cell) is None:
        raise _WrongError(f"{name}: expected a number (type {REAL32}), found {cell!r}")
    try:
        return single(float(cell))
    except OverflowError:
        raise _WrongError(f"{name}: expected a number that fits into single precision, found {cell}") from None


def single(value: float) -> float:
    """Return the value rounded to single precision, as PX4 stores it.

    Raises:
        OverflowError: the value is too large for single precision.
    """
    if math.isinf(value):
        raise OverflowError("infinite")
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def same(one: Value, other: Value) -> bool:
    """Return whether two parameter values have the same type and are equal as PX4 stores them."""
    if isinstance(one, int) or isinstance(other, int):
        return isinstance(one, int) and isinstance(other, int) and one == other
    return single(one) == single(other)


def value_text(value: Value) -> str:
    """Return the value as text, with the fewest digits from which the same value is read back."""
    if isinstance(value, int):
        return str(value)
    stored = single(value)
    short = next(text for digits in range(1, 10) if _is(text := f"{stored:.{digits}g}", stored))
    if "e" in short and 1e-5 <= abs(stored) < 1e9:
        short = f"{Decimal(short):f}"
    return short if any(character in short for character in ".e") else f"{short}.0"


def _is(text: str, stored: float) -> bool:
    try:
        return single(float(text)) == stored
    except OverflowError:  # rounded up beyond the largest
        return False


def text(
    values: Mapping[str, Value],
    heading: Iterable[str] = (),
    comments: Mapping[str, Iterable[str]] | None = None,
    vehicle_id: int = VEHICLE_ID,
) -> str:
    """Return the text of a parameter file.

    Args:
        heading: comment lines at the top of the file, without `#`.
        comments: comment lines before a parameter, by its name, without `#`.
        vehicle_id: MAV_SYS_ID of the PX4 with these values.
    """
    lines = [_comment(line) for line in heading]
    lines.append(COLUMNS)
    for name, value in values.items():
        lines += [_comment(line) for line in (comments or {}).get(name, ())]
        kind = INT32 if isinstance(value, int) else REAL32
        lines.append(f"{vehicle_id}\t{COMPONENT_ID}\t{name}\t{value_text(value)}\t{kind}")
    return "\n".join(lines) + "\n"


def _comment(line: str) -> str:
    return f"# {line}".rstrip()
