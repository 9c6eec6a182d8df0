"""Strict YAML: the 1.2 core schema, no duplicate keys, and the origin of every value.

PyYAML implements YAML 1.1, where `1e3` is text, `on` is true, `12:30` is 750 and a duplicate key overwrites the first. Here, scalars
follow the core schema of YAML 1.2 (section 10.3.2), and only line feed and carriage return end a line; duplicate keys, aliases and tags
are rejected.
"""

from __future__ import annotations

import functools
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from companion.config.base import Location
from companion.config.document import (
    RANK_KEY,
    RANK_VALUE,
    ConfigError,
    Data,
    Document,
    Origin,
    Problem,
    key_path,
)

SIZE_MAX_BYTES = 256 * 1024
DEPTH_MAX = 32

_NULL = re.compile(r"~|null|Null|NULL|")
_BOOL = re.compile(r"true|True|TRUE|false|False|FALSE")
_INT = re.compile(r"[-+]?[0-9]+")
_OCTAL = re.compile(r"0o[0-7]+")
_HEX = re.compile(r"0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)")
_NAN = re.compile(r"\.(nan|NaN|NAN)")
_HALF_CHARACTER = "an escape (\\uD800 to \\uDFFF) for half a character; write the character itself"
_UNBROKEN = str.maketrans("\x85\u2028\u2029", "\U0001fffe\U0001ffff\U0002fffe")
"""Characters that end a line in YAML 1.1 but not in 1.2, where a comment may contain them; PyYAML sees noncharacters instead."""
_RESTORED = {hidden: shown for shown, hidden in _UNBROKEN.items()}
_STRANGE_SPACE = re.compile(r"^[ \-]*(?:\w+:)?([\u00a0\u1680\u2000-\u200b\u202f\u205f\u3000])", re.MULTILINE)
"""A space other than U+0020 in an indentation or after the colon of a key, where it looks right and is text."""
_DIGITS_MAX = 400  # Python refuses to convert integers of more than 4300 digits with a different exception.


class StrictLoader(yaml.SafeLoader):
    """Composes nodes; scalars are resolved by `_scalar`, not by PyYAML's YAML 1.1 rules."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.yaml_implicit_resolvers = {}
        self._depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Compose one node; reject aliases, tags and deep nesting early."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        mark: Any = event.start_mark
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases (*name) are not accepted; write the value out", problem_mark=mark
            )
        tag = getattr(event, "tag", None)
        if tag is not None:
            raise yaml.MarkedYAMLError(
                problem=f"tags ({tag}) are not accepted; write the plain value", problem_mark=mark
            )
        if self._depth >= DEPTH_MAX:
            raise yaml.MarkedYAMLError(problem=f"nested more than {DEPTH_MAX} levels deep", problem_mark=mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


def read_document(path: str | Path, shown_as: str | None = None) -> Document:
    """Read one YAML file whose top level is a mapping.

    Raises:
        ConfigError: the file cannot be read or is not YAML; the exception has one line. Other problems, such as duplicate keys,
            are collected in `Document.problems` and reported with the validation errors.
    """
    shown = shown_as or str(path)
    try:
        with Path(path).open("rb") as file:
            raw = file.read(SIZE_MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError(f"{shown}: no such file") from None
    except IsADirectoryError:
        raise ConfigError(f"{shown}: is a directory, expected a YAML file") from None
    except PermissionError:
        raise ConfigError(f"{shown}: not readable: permission denied") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ConfigError(f"{shown}: not readable: {reason}") from None
    if len(raw) > SIZE_MAX_BYTES:
        raise ConfigError(f"{shown}: larger than {SIZE_MAX_BYTES // 1024} KiB; expected a configuration file")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{shown}:{line}: not UTF-8 (byte 0x{raw[error.start]:02x}); save the file as UTF-8"
        ) from None
    return parse_document(text, shown)


def parse_document(text: str, shown: str) -> Document:
    """Parse the text of a file whose top level is a mapping.

    Raises:
        ConfigError: as `read_document`.
    """
    document = Document(shown, {})
    data = _parse(text, document, None)
    if data is None:
        raise ConfigError(f"{shown}: is empty")
    if not isinstance(data, dict):
        raise ConfigError(f"{document.origin(())}: expected a mapping (key: value) at the top level, got {_kind(data)}")
    document.data = data
    return document


def parse_value(text: str, origin: Origin) -> Data:
    """Parse the value of a command-line override by the rules of this module.

    Raises:
        ConfigError: the value is invalid; the exception has one line per problem.
    """
    if len(text) > SIZE_MAX_BYTES:
        raise ConfigError(f"{origin}: longer than {SIZE_MAX_BYTES // 1024} KiB")
    document = Document(origin.source, {})
    data = _parse(text, document, origin)
    if document.problems:
        raise ConfigError([str(problem) for problem in document.problems])
    return data


def _parse(text: str, document: Document, fixed: Origin | None) -> Data:
    """Convert text to plain data. `fixed`, as for an override, is the origin of all values in place of line and column."""

    def origin(mark: yaml.Mark | None) -> Origin:
        if fixed is not None or mark is None:
            return fixed or Origin(document.source)
        return Origin(document.source, mark.line + 1, mark.column + 1)

    strange = _STRANGE_SPACE.search(text)
    if strange is not None:
        start, name = strange.start(1), unicodedata.name(strange[1]).lower()
        mark = yaml.Mark("", start, text.count("\n", 0, start), start - text.rfind("\n", 0, start) - 1, None, 0)
        raise ConfigError(f"{origin(mark)}: not YAML: {name} (U+{ord(strange[1]):04X}); write an ordinary space")
    try:
        node = composed(text)
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        at = fixed or Origin(document.source, before.count("\n") + 1, error.position - (before.rfind("\n") + 1) + 1)
        code = error.character if isinstance(error.character, int) else ord(error.character)
        raise ConfigError(f"{at}: not YAML: control character U+{code:04X} is not allowed") from None
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{origin(error.problem_mark or error.context_mark)}: not YAML: {_syntax(error)}") from None
    return None if node is None else _Builder(document, origin).build(node, ())


@functools.lru_cache(maxsize=16)
def composed(text: str) -> yaml.Node | None:
    """Return the root node of the text, None if it is empty. A campaign reads the same few files for each of its cases.

    Raises:
        yaml.YAMLError: the text is not YAML.
    """
    loader = StrictLoader(text.translate(_UNBROKEN))
    try:
        return loader.get_single_node()
    except (ValueError, OverflowError) as error:  # PyYAML converts "\\U0011FFFF" and %YAML 1.999... without a check
        raise yaml.MarkedYAMLError(
            problem=f"an invalid escape or number ({error})", problem_mark=loader.get_mark()
        ) from None
    finally:
        loader.dispose()


class _Builder:
    """Converts composed nodes to plain data, with their origins and problems."""

    def __init__(self, document: Document, origin: Callable[[yaml.Mark | None], Origin]) -> None:
        self._document = document
        self._at = origin

    def _refuse(self, rank: int, mark: yaml.Mark, location: Location, text: str) -> None:
        where = f"{key_path(location)}: " if location else ""
        self._document.problems.append(Problem(rank, self._at(mark), where + text))

    def build(self, node: yaml.Node, location: Location) -> Data:
        """Return the data of a node and of its children."""
        self._document.values[location] = self._at(node.start_mark)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, location)
        if isinstance(node, yaml.SequenceNode):
            return [self.build(item, (*location, index)) for index, item in enumerate(node.value)]
        assert isinstance(node, yaml.ScalarNode)
        text: str = node.value.translate(_RESTORED)
        if not _is_unicode(text):
            self._refuse(RANK_VALUE, node.start_mark, location, _HALF_CHARACTER)
            return None
        if node.style is not None:  # quoted or block scalars are always text
            return text
        try:
            return _scalar(text)
        except ValueError as error:
            self._refuse(RANK_VALUE, node.start_mark, location, str(error))
            return None

    def _mapping(self, node: yaml.MappingNode, location: Location) -> dict[str, Data]:
        data: dict[str, Data] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                self._refuse(RANK_KEY, key_node.start_mark, location, "a key must be plain text")
                continue
            key: str = key_node.value.translate(_RESTORED)
            if key == "<<" and key_node.style is None:
                self._refuse(
                    RANK_KEY, key_node.start_mark, location, "merge keys (<<) are not accepted; write the keys out"
                )
                continue
            if not _is_unicode(key):
                self._refuse(RANK_KEY, key_node.start_mark, location, _HALF_CHARACTER)
                continue
            at = (*location, key)
            if key in data:
                first = self._document.keys[at]
                where = f" on line {first.line}" if first.line else ""
                self._refuse(
                    RANK_KEY, key_node.start_mark, at, f"duplicate key, already given{where}; remove one of the two"
                )
                continue
            self._document.keys[at] = self._at(key_node.start_mark)
            data[key] = self.build(value_node, at)
        return data


def _is_unicode(text: str) -> bool:
    """Return whether the text is valid Unicode; an escape such as "\ud800" leaves half of a UTF-16 pair, which JSON rejects."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _scalar(text: str) -> Data:
    """Return the value of a plain scalar by the core schema of YAML 1.2; raises ValueError for a number with too many digits."""
    if _NULL.fullmatch(text):
        return None
    if _BOOL.fullmatch(text):
        return text[0] in "tT"
    if len(text) > _DIGITS_MAX and (
        _INT.fullmatch(text) or _FLOAT.fullmatch(text) or _HEX.fullmatch(text) or _OCTAL.fullmatch(text)
    ):
        raise ValueError(f"a number with {len(text)} digits; at most {_DIGITS_MAX} are accepted")
    if _INT.fullmatch(text):
        return int(text)
    if _OCTAL.fullmatch(text) or _HEX.fullmatch(text):
        return int(text, 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    if _INFINITE.fullmatch(text):
        return float("-inf") if text[0] == "-" else float("inf")
    if _NAN.fullmatch(text):
        return float("nan")
    return text


def _syntax(error: yaml.MarkedYAMLError) -> str:
    """Return PyYAML's message as one line for the user."""
    problem = error.problem or "syntax error"
    if "'\\t'" in problem:
        return "a tab; indent with spaces"
    if "expected a single document" in (error.context or "") or "but found another document" in problem:
        return "a second document (---); only one per file is accepted"
    if "mapping values are not allowed here" in problem:
        return "an unexpected ':'; check the line above, the quotes and the indentation"
    if "could not find expected ':'" in problem:
        return "a key without ':'"
    if problem.startswith("expected <block end>"):
        return "the indentation does not match the lines above"
    if problem.startswith(("aliases", "tags", "nested")):
        return problem
    context = f" {error.context}" if error.context else ""
    return " ".join(f"{problem}{context}".split())


def _kind(data: Data) -> str:
    return "a list" if isinstance(data, list) else "a single value"
