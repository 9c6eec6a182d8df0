"""Parameter files in QGroundControl's format: tab-separated Vehicle-Id, Component-Id, Name, Value and Type; `#` begins a comment.

The types are those of MAV_PARAM_TYPE: 6 is INT32 and 9 is REAL32; PX4 has no others. The reader rejects everything that QGroundControl
rejects and reports each error with file and line. A written value is equal to the original when it is read back.
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

_NAME = re.compile(r"[A-Z0-9_]{1,16}")
_INTEGER = re.compile(r"[+-]?\d+")
_REAL = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_INT32_MIN, _INT32_MAX = -(2**31), 2**31 - 1

Value = float | int


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the file."""

    name: str
    value: Value
    """Value of the parameter: an int for INT32, a float in single precision for REAL32."""
    line: int
    vehicle_id: int = VEHICLE_ID
    component_id: int = COMPONENT_ID


def read(path: str | Path) -> dict[str, Value]:
    """Return the values in the file by name, in the file's order.

    Raises:
        ConfigError: the file is unreadable or invalid; the exception has one line per problem, `file:line: problem`.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError([f"{path}: expected UTF-8 text, found byte {error.object[error.start]:#04x}"]) from None
    except OSError as error:
        raise ConfigError([f"{path}: cannot be read: {error.strerror or error}"]) from None
    return {entry.name: entry.value for entry in parse(text, str(path))}


def parse(text: str, source: str) -> list[Entry]:
    """Parse the text of a parameter file and return its entries. `source` is the file name used in messages.

    Raises:
        ConfigError: the text is invalid; the exception has one line per problem.
    """
    entries: dict[str, Entry] = {}
    problems: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            entry = _entry(line, number)
            if entry.name in entries:
                raise _WrongError(f"{entry.name} is already set in line {entries[entry.name].line}")
        except _WrongError as error:
            problems.append(f"{source}:{number}: {error}")
        else:
            entries[entry.name] = entry
    if not problems and not entries:
        problems.append(f"{source}: expected parameters, found none")
    if problems:
        raise ConfigError(problems)
    return list(entries.values())


class _WrongError(Exception):
    """A line is invalid; the text states the problem."""


def _entry(line: str, number: int) -> Entry:
    cells = line.split("\t")
    if len(cells) != 5:
        hint = "; separate them with tabs, not spaces" if len(line.split()) == 5 else ""
        raise _WrongError(f"expected 5 fields (vehicle, component, name, value, type), found {len(cells)}{hint}")
    vehicle, component, name, value, kind = cells
    for title, cell in (("vehicle id", vehicle), ("component id", component)):
        if not (_INTEGER.fullmatch(cell) and 1 <= int(cell) <= 255):
            raise _WrongError(f"expected a {title} from 1 to 255, found {cell!r}")
    if _NAME.fullmatch(name) is None:
        raise _WrongError(f"expected a name with 1 to 16 of the characters A-Z, 0-9 and _, found {name!r}")
    if kind not in (str(INT32), str(REAL32)):
        raise _WrongError(f"{name}: expected type {INT32} (INT32) or {REAL32} (REAL32), found {kind!r}")
    number_of = _int32 if kind == str(INT32) else _real32
    return Entry(
        name=name, value=number_of(name, value), line=number, vehicle_id=int(vehicle), component_id=int(component)
    )


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
    values: Mapping[str, Value], heading: Iterable[str] = (), comments: Mapping[str, Iterable[str]] | None = None
) -> str:
    """Return the text of a parameter file.

    Args:
        values: values by name.
        heading: comment lines at the top of the file, without `#`.
        comments: comment lines before a parameter, by its name, without `#`.
    """
    lines = [_comment(line) for line in heading]
    lines.append(COLUMNS)
    for name, value in values.items():
        lines += [_comment(line) for line in (comments or {}).get(name, ())]
        kind = INT32 if isinstance(value, int) else REAL32
        lines.append(f"{VEHICLE_ID}\t{COMPONENT_ID}\t{name}\t{value_text(value)}\t{kind}")
    return "\n".join(lines) + "\n"


def _comment(line: str) -> str:
    return f"# {line}".rstrip()
