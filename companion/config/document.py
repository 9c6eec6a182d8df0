"""What was read, before any model looks at it: plain data, and where each piece of it was written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from companion.config.base import Location

Data: TypeAlias = "bool | int | float | str | list[Data] | dict[str, Data] | None"


LINE_MAX = 1000
"""Characters of one line for the user; what is cut off is the end of what the user wrote there."""


class ConfigError(Exception):
    """The user's input is not usable. `lines` holds one clear line per problem, the most important one first."""

    def __init__(self, lines: Sequence[str]) -> None:
        self.lines = tuple(map(_shown, lines))
        super().__init__("\n".join(self.lines))


def _shown(line: str) -> str:
    """Keys and values are quoted as they were written: nothing in them may break the line, steer the terminal or flood it."""
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
    return line if len(line) <= LINE_MAX else line[: LINE_MAX - 3] + "..."


@dataclass(frozen=True, slots=True, order=True)
class Origin:
    """Where a value was written: a place in a file (line and column count from 1), or an option of the command line (line 0)."""

    source: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


RANK_KEY, RANK_VALUE, RANK_MISSING = range(3)
"""Importance of a problem: a misspelt key is the cause of the missing one."""


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """One line for the user."""

    rank: int
    origin: Origin
    text: str

    def __str__(self) -> str:
        return f"{self.origin}: {self.text}"


def problem_lines(problems: Sequence[Problem]) -> list[str]:
    """Every problem once, the most important first, in the order of the file."""
    return [str(problem) for problem in sorted(set(problems))]


def key_path(location: Location) -> str:
    """`phases[2].duration_s` of ("phases", 2, "duration_s")."""
    text = ""
    for step in location:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


@dataclass(slots=True)
class Document:
    """A document as read and overridden. Mutable: overrides act on it; nothing outside the configuration's loading sees it."""

    source: str
    """File, as the user wrote it."""
    data: dict[str, Data]
    values: dict[Location, Origin] = field(default_factory=dict)
    """Where values stand; a location that is not in here stands where its nearest parent stands."""
    keys: dict[Location, Origin] = field(default_factory=dict)
    """Where keys stand."""
    problems: list[Problem] = field(default_factory=list)
    """Found on reading, beside what models find."""

    def origin(self, location: Location) -> Origin:
        """Where the value at a location was written."""
        for end in range(len(location), -1, -1):
            found = self.values.get(location[:end])
            if found is not None:
                return found
        return Origin(self.source)

    def key_origin(self, location: Location) -> Origin:
        """Where the key of a location was written."""
        return self.keys.get(location) or self.origin(location)

    def replace(self, location: Location, value: Data, origin: Origin) -> None:
        """Put a value from the command line at a location whose parent exists."""
        parent: Data = self.data
        for step in location[:-1]:
            parent = _child(parent, step)
        step = location[-1]
        match parent, step:
            case dict(), str():
                parent[step] = value
            case list(), int():
                parent[step] = value
            case _:
                raise TypeError(f"{key_path(location)} has no parent")
        for origins in (self.values, self.keys):
            for known in [known for known in origins if known[: len(location)] == location]:
                del origins[known]
            origins[location] = origin

    def get(self, location: Location) -> Data:
        """The value at a location.

        Raises:
            KeyError, IndexError: if there is none.
        """
        value: Data = self.data
        for step in location:
            value = _child(value, step)
        return value


def _child(parent: Data, step: str | int) -> Data:
    if isinstance(parent, dict) and isinstance(step, str):
        return parent[step]
    if isinstance(parent, list) and isinstance(step, int):
        return parent[step]
    raise KeyError(step)
