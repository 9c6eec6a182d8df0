"""Files with secrets of the ground stations: operators with their keys, and a login at a broker. Only their owner may read them.

    version: 1
    operators:
      - name: anna
        key: base64 of 32 random bytes
        may: all        # or safer: hold, land and abort only

The vehicle's file lists all operators who may command it; the file of a ground computer lists its own operators. If a user has no
file, one is created on first use; vehicle and ground station on one computer share it.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import getpass
import os
import re
import secrets
import stat
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from companion.config.base import Model, refuse
from companion.config.document import ConfigError, problem_lines
from companion.config.explain import validate
from companion.config.yaml_strict import read_document
from companion.model.commands import SAFER_COMMANDS
from companion.model.types import OperatorCommand
from companion.runtime.files import write_whole

OPERATOR_NAME = re.compile(r"[A-Za-z0-9_.-]{1,40}")
KEY_BYTES = 32
OPERATORS_MAX = 100

M = TypeVar("M", bound=Model)


class Permission(StrEnum):
    """Commands that an operator may give."""

    SAFER_COMMANDS = "safer"
    """Hold, land and abort only."""
    ALL = "all"


def _checked_name(name: str) -> str:
    if OPERATOR_NAME.fullmatch(name) is None:
        raise ValueError("expected 1 to 40 letters, digits, '_', '-' or '.'")
    return name


# Messages about a secret must not show it.
def _checked_text(value: object) -> object:
    if not isinstance(value, str):
        raise ValueError("expected text; put it in quotes")
    return value


def _checked_key(text: str) -> str:
    try:
        size = len(base64.b64decode(text, validate=True))
    except (binascii.Error, ValueError):
        raise ValueError(f"expected base64 of {KEY_BYTES} random bytes") from None
    if size != KEY_BYTES:
        raise ValueError(f"expected base64 of {KEY_BYTES} random bytes; found {size} bytes")
    return text


class OperatorEntry(Model):
    """An operator in the file."""

    name: Annotated[str, AfterValidator(_checked_name)]
    key: Annotated[str, AfterValidator(_checked_key), BeforeValidator(_checked_text), Field(repr=False)]
    """base64 of 32 random bytes"""
    may: Literal["safer", "all"] = "all"
    """safer: hold, land and abort; all: resume and start too"""


class OperatorsFile(Model):
    """Content of an operators file."""

    version: Literal[1]
    operators: tuple[OperatorEntry, ...]

    @model_validator(mode="after")
    def _check_unique(self) -> Self:
        problems: list[tuple[tuple[str | int, ...], str]] = []
        if not 0 < len(self.operators) <= OPERATORS_MAX:
            problems.append((("operators",), f"expected 1 to {OPERATORS_MAX} operators, found {len(self.operators)}"))
        for index, entry in enumerate(self.operators):
            before = self.operators[:index]
            if any(other.name == entry.name for other in before):
                problems.append((("operators", index, "name"), f"{entry.name} is in the file twice; remove one"))
            elif any(_decoded(other.key) == _decoded(entry.key) for other in before):
                text = "another operator has the same key, so their commands cannot be distinguished; give each operator their own key"
                problems.append((("operators", index, "key"), text))
        refuse("operators", problems)
        return self


class Login(Model):
    """A login at a broker."""

    username: Annotated[str, Field(min_length=1, max_length=100)]
    password: Annotated[str, BeforeValidator(_checked_text), Field(repr=False)]


@dataclass(frozen=True, slots=True, repr=False)
class Operator:
    """An operator with key and permission."""

    name: str
    key: bytes
    permission: Permission = Permission.ALL

    def __repr__(self) -> str:
        return f"Operator({self.name}, {self.permission})"


class Operators:
    """The operators of one file. Immutable; its repr does not show keys."""

    def __init__(self, operators: Sequence[Operator], source: str) -> None:
        self._by_name = {operator.name: operator for operator in operators}
        self.source = source
        """Path of the file as the user wrote it."""

    def __repr__(self) -> str:
        return f"Operators({', '.join(self.names)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the order of the file."""
        return tuple(self._by_name)

    @property
    def keys(self) -> tuple[bytes, ...]:
        """Keys in the order of the file."""
        return tuple(operator.key for operator in self._by_name.values())

    def key(self, name: str) -> bytes:
        """Return the 32 bytes of an operator's key.

        Raises:
            ConfigError: the operator does not exist; the message lists the existing ones.
        """
        operator = self._by_name.get(name)
        if operator is None:
            raise ConfigError(f"{self.source}: no operator {name!r:.60}; expected one of {', '.join(self.names)}")
        return operator.key

    def find_key(self, name: str) -> bytes | None:
        """Return the key, or None if the operator does not exist."""
        operator = self._by_name.get(name)
        return None if operator is None else operator.key

    def is_allowed(self, name: str, command: OperatorCommand) -> bool:
        """Whether an operator may give a command."""
        operator = self._by_name.get(name)
        return operator is not None and (operator.permission is Permission.ALL or command in SAFER_COMMANDS)


def load_operators(path: str | Path | None = None) -> Operators:
    """Read an operators file.

    Args:
        path: the file, with ``~`` for the home folder; None for the user's own, created with one operator if it does not exist.

    Raises:
        ConfigError: one line per problem: the file is missing, readable by others, invalid, or cannot be created.
    """
    if path is None:
        path = default_operators_file()
        if not path.exists():
            _create_default(path)
    parsed = _read(OperatorsFile, path)
    operators = [Operator(entry.name, _decoded(entry.key), Permission(entry.may)) for entry in parsed.operators]
    return Operators(operators, str(path))


def load_login(path: str | Path) -> Login:
    """Read a login file.

    Raises:
        ConfigError: one line per problem: the file is missing, readable by others, or invalid.
    """
    return _read(Login, path)


def default_operators_file() -> Path:
    """Return this user's operators file: ``$XDG_CONFIG_HOME/companion/operators.yaml``, by default below ``~/.config``.

    Raises:
        ConfigError: the user has no home folder.
    """
    named = os.environ.get("XDG_CONFIG_HOME", "")
    if named.startswith("/"):  # a relative path counts as not set: XDG Base Directory Specification
        return Path(named) / "companion/operators.yaml"
    try:
        return Path.home() / ".config/companion/operators.yaml"
    except RuntimeError:
        raise ConfigError(
            "operators: this user has no home folder; give a file (operators_file, --operators)"
        ) from None


def new_key() -> bytes:
    """Return a new operator key."""
    return secrets.token_bytes(KEY_BYTES)


def operators_text(operators: Sequence[Operator]) -> str:
    """Return the text of an operators file."""
    lines = [
        "# Keys of operators: every holder of a key can command the vehicle. Keep this file private: chmod 600.",
        "version: 1",
        "operators:",
    ]
    for operator in operators:
        key = base64.b64encode(operator.key).decode("ascii")
        # Quoted, because a name may look like a number.
        lines += [f'  - name: "{operator.name}"', f'    key: "{key}"', f"    may: {operator.permission.value}"]
    return "\n".join(lines) + "\n"


def write_private(path: Path, data: bytes) -> None:
    """Write a new file of mode 0600; it appears complete or not at all.

    Raises:
        FileExistsError: the file exists; it is left unchanged.
        OSError: the file cannot be written.
    """
    write_whole(path, data, mode=0o600, replace=False, durable=True)


def _create_default(path: Path) -> None:
    """Create a file with one operator, named after the user. If several processes try at once, they all use the first one's file."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            write_private(path, operators_text([Operator(user_name(), new_key())]).encode())
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(
            f"{path}: cannot be created: {reason}; give another file (operators_file, --operators)"
        ) from None


def user_name() -> str:
    """Return this user's name as an operator name; characters that are not allowed become '-'."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        name = ""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name)[:40] or "operator"


def _read(model: type[M], path: str | Path) -> M:
    """Read a file as a model; reject a file that others may read."""
    shown = str(path)
    try:
        expanded = Path(path).expanduser()
        mode = stat.S_IMODE(expanded.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{shown}: no such file") from None
    except RuntimeError:
        raise ConfigError(f"{shown}: '~' cannot be expanded: this user has no home folder") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{shown}: not readable: {reason}") from None
    if mode & 0o077 and not expanded.is_dir():
        raise ConfigError(
            f"{shown}: contains secrets and is accessible to others (mode {mode:04o}); run: chmod 600 {shown}"
        )
    document = read_document(expanded, shown)
    built = validate(model, document)
    if built is None:
        # The value found is not quoted: it may be the secret.
        raise ConfigError([line.split(", got ")[0] for line in problem_lines(document.problems)])
    return built


def _decoded(key: str) -> bytes:
    return base64.b64decode(key, validate=True)
