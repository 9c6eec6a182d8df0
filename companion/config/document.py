"""A configuration file before validation: plain data and the origin of each value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

from companion.config.base import Location

Data: TypeAlias = "bool | int | float | str | list[Data] | dict[str, Data] | None"


LINE_MAX = 1000
"""Maximum length of a message; a longer message is truncated."""


class ConfigError(Exception):
    """The input is invalid. `lines` contains one message per problem, the most important first; a text is one message."""

    def __init__(self, lines: Sequence[str]) -> None:
        self.lines = tuple(map(_shown, [lines] if isinstance(lines, str) else lines))
        super().__init__("\n".join(self.lines))


def _shown(line: str) -> str:
    """Escape and shorten a message: quoted keys and values must not break the line or control the terminal."""
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
    return line if len(line) <= LINE_MAX else line[: LINE_MAX - 3] + "..."


@dataclass(frozen=True, slots=True, order=True)
class Origin:
    """Origin of a value: a file with line and column, both counted from 1, or a command-line option, with line 0."""

    source: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


RANK_KEY, RANK_VALUE, RANK_MISSING = range(3)
"""Ranks of problems, the most important first. A misspelt key ranks before a missing key, because it often causes it."""


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """One problem of a file, shown to the user as one message."""

    rank: int
    origin: Origin
    text: str

    def __str__(self) -> str:
        return f"{self.origin}: {self.text}"


def problem_lines(problems: Sequence[Problem]) -> list[str]:
    """Return the message of each problem once, ordered by importance and then by position in the file."""
    return [str(problem) for problem in sorted(set(problems))]


def key_path(location: Location) -> str:
    """Return a location as text: `phases[2].duration_s` for ("phases", 2, "duration_s")."""
    text = ""
    for step in location:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


@dataclass(slots=True)
class Document:
    """Content of a file. It is mutable so that overrides can be applied, and it is used only while a configuration is being loaded."""

    source: str
    """Path of the file as the user gave it."""
    data: dict[str, Data]
    values: dict[Location, Origin] = field(default_factory=dict)
    """Origins of values; a value whose location is not listed has the origin of its nearest parent."""
    keys: dict[Location, Origin] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    """Problems found while the file was read; validation adds further problems."""

    def origin(self, location: Location) -> Origin:
        """Return the origin of the value at a location."""
        for end in range(len(location), -1, -1):
            found = self.values.get(location[:end])
            if found is not None:
                return found
        return Origin(self.source)

    def key_origin(self, location: Location) -> Origin:
        """Return the origin of the key at a location."""
        return self.keys.get(location) or self.origin(location)

    def replace(self, location: Location, value: Data, origin: Origin) -> None:
        """Set a value given on the command line.

        Raises:
            KeyError, IndexError, TypeError: the location has no parent.
        """
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

    def rename(self, parent: Location, old: str, new: str) -> None:
        """Move the value of a key's old spelling to its present one, unless the file has both; an option of the command line wins."""
        data = self.find(parent)
        if not isinstance(data, dict) or old not in data:
            return
        origin = self.key_origin((*parent, old))
        if new not in data or origin.line == 0:
            self.replace((*parent, new), data.pop(old), origin)

    def report(self, location: Location, text: str, rank: int = RANK_VALUE) -> None:
        """Add a problem with the value at a location."""
        self.problems.append(Problem(rank, self.origin(location), f"{key_path(location)}: {text}"))

    def find(self, location: Location) -> Data:
        """Return the value at a location; None if the location does not exist."""
        try:
            return self.get(location)
        except (KeyError, IndexError):
            return None

    def get(self, location: Location) -> Data:
        """Return the value at a location.

        Raises:
            KeyError, IndexError: the location does not exist.
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
