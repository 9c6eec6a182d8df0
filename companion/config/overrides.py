"""Parses and applies options `--set section.key[index].key=value`, each of which replaces one value of a file before validation."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from companion.config.base import Location
from companion.config.document import ConfigError, Data, Document, Origin, key_path
from companion.config.explain import nearest
from companion.config.yaml_strict import parse_value

Section = Literal["mission", "vehicle", "controller", "world"]
SECTIONS: tuple[Section, ...] = ("mission", "vehicle", "controller", "world")

_STEP = re.compile(r"\.?([A-Za-z_][A-Za-z0-9_]*)|\[(0|[1-9][0-9]{0,5})\]")
_EXAMPLE = "expected SECTION.KEY=VALUE, for example --set world.payload_kg=0.2"


@dataclass(frozen=True, slots=True)
class Override:
    """A parsed `--set` option."""

    section: Section
    location: Location
    value: Data
    origin: Origin

    def __str__(self) -> str:
        """Return the option."""
        return f"{self.section}.{key_path(self.location)}={json.dumps(self.value)}"


def parse_overrides(texts: Iterable[str | Override]) -> list[Override]:
    """Parse `--set` options; those that are parsed already, as from a team file, stay as they are.

    Raises:
        ConfigError: options are invalid; the exception has one message for each.
    """
    overrides: list[Override] = []
    lines: list[str] = []
    for text in texts:
        try:
            overrides.append(text if isinstance(text, Override) else _parse(text))
        except ConfigError as error:
            lines += error.lines
    if lines:
        raise ConfigError(lines)
    return overrides


def apply_overrides(document: Document, section: Section, overrides: Iterable[Override]) -> None:
    """Apply the overrides of one section to its document in the given order; the document records their origins.

    Raises:
        ConfigError: locations do not exist; the exception has one message for each. The model checks the keys later.
    """
    lines: list[str] = []
    for override in overrides:
        if override.section != section:
            continue
        try:
            _make_way(document, override)
            document.replace(override.location, override.value, override.origin)
        except ConfigError as error:
            lines += error.lines
    if lines:
        raise ConfigError(lines)


def _parse(text: str) -> Override:
    name, equals, value_text = text.partition("=")
    name = name.strip()
    origin = Origin(f"--set {name}")
    if not equals:
        raise ConfigError(f"{origin}: no '='; {_EXAMPLE}")
    section, location = _location(name, origin)
    if not value_text.strip():
        raise ConfigError(f"{origin}: no value; {_EXAMPLE}")
    return Override(section, location, parse_value(value_text, origin), origin)


def override_of(name: str, value: Data, origin: Origin) -> Override:
    """Return the override of a key that a file gives.

    Raises:
        ConfigError: the key cannot be read.
    """
    section, location = _location(name, origin)
    return Override(section, location, value, origin)


def _location(name: str, origin: Origin) -> tuple[Section, Location]:
    steps: list[str | int] = []
    end = 0
    while end < len(name):
        match = _STEP.match(name, end)
        if match is None or (match[0].startswith(".") != bool(steps) and match[1] is not None):
            index = re.match(r"\.([0-9]+)\b", name[end:])
            hint = f"write {name[:end]}[{index[1]}]{name[end + index.end() :]}" if index and steps else _EXAMPLE
            raise ConfigError(f"{origin}: cannot read the key from column {end + 1}; {hint}")
        steps.append(match[1] if match[1] is not None else int(match[2]))
        end = match.end()
    if not steps:
        raise ConfigError(f"{origin}: no key; {_EXAMPLE}")
    section = steps[0]
    if section not in SECTIONS:
        close = nearest(str(section), list(SECTIONS))
        hint = f"did you mean {close}?" if close else f"available: {', '.join(SECTIONS)}"
        raise ConfigError(f"{origin}: unknown section '{section}'; {hint}")
    if len(steps) == 1:
        raise ConfigError(f"{origin}: the key names a whole section; {_EXAMPLE}")
    return section, tuple(steps[1:])


def _make_way(document: Document, override: Override) -> None:
    """Create the parent mappings that are missing in the file, whose keys then have their defaults; reject indices beyond it."""
    value: Data = document.data
    for depth, step in enumerate(override.location):
        last = depth == len(override.location) - 1
        here = key_path((override.section, *override.location[:depth]))
        if isinstance(step, int):
            if not isinstance(value, list):
                raise ConfigError(f"{override.origin}: {here} is not a list")
            if step >= len(value):
                known = f"0 to {len(value) - 1}" if value else "none"
                raise ConfigError(f"{override.origin}: {here} has no index {step}; available: {known}")
            value = value[step]
        else:
            if not isinstance(value, dict):
                raise ConfigError(
                    f"{override.origin}: {here} has no keys; it is {'a list' if isinstance(value, list) else 'a single value'}"
                )
            if last:
                return
            if value.get(step) is None:
                document.replace(override.location[: depth + 1], {}, override.origin)
            value = value[step]
