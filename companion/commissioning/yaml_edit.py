"""Replaces or adds single values of a YAML text; comments, order and everything else remain unchanged. Pure functions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import yaml

from companion.config.base import Location
from companion.config.document import Data, key_path
from companion.config.yaml_strict import composed
from companion.config.yaml_text import flow_text


class EditError(Exception):
    """The text cannot be edited at this location. The message is one line without the file's name."""


class Edit(NamedTuple):
    """Replacement of the characters from `begin` to `end` by `text`."""

    begin: int
    end: int
    text: str


def edited(text: str, changes: Mapping[Location, Data]) -> str:
    """Return the text with all changes.

    Args:
        text: YAML whose top level is a mapping, as `read_document` accepts it.
        changes: new values by location; missing keys, and mappings on the way to them, are added.

    Raises:
        EditError: a location leads through a missing list index or through a single value, or a list in block style would
            change its length.
    """
    for location, value in changes.items():
        # One after the other, because each change moves the text after it.
        text = _edited(text, location, value)
    return text


def _edited(text: str, location: Location, value: Data) -> str:
    node = composed(text)
    if not isinstance(node, yaml.MappingNode):
        raise EditError("expected a mapping (key: value) at the top level")
    found: yaml.Node = node
    for depth, step in enumerate(location):
        below = _child(found, step)
        if below is not None:
            found = below
            continue
        if not isinstance(found, yaml.MappingNode) or not isinstance(step, str):
            raise EditError(f"{key_path(location[: depth + 1])}: there is no such key; change it by hand")
        return _added(text, found, location[depth:], value)
    edits = _replaced(text, found, value, location)
    for begin, end, new in sorted(edits, reverse=True):
        text = text[:begin] + new + _aligned(text, end, len(new) - (end - begin))
    return text


def _child(node: yaml.Node, step: str | int) -> yaml.Node | None:
    if isinstance(node, yaml.MappingNode) and isinstance(step, str):
        return next((value for key, value in node.value if key.value == step), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(step, int) and 0 <= step < len(node.value):
        item: yaml.Node = node.value[step]
        return item
    return None


def _replaced(text: str, node: yaml.Node, value: Data, location: Location) -> list[Edit]:
    if _is_flow(node):
        begin, end = node.start_mark.index, node.end_mark.index
        new = flow_text(value)
        if end > begin and text[end - 1] == "\n":  # a block of text ends with its line
            new += "\n"
        if begin == end:  # a key without a value
            new = f" {new}" if text[begin - 1] == ":" else new
        return [Edit(begin, end, new)]
    if isinstance(node, yaml.SequenceNode) and isinstance(value, list) and len(value) == len(node.value):
        pairs = [(item, value[index], (*location, index)) for index, item in enumerate(node.value)]
        return [edit for item, new, at in pairs for edit in _replaced(text, item, new, at)]
    raise EditError(f"{key_path(location)}: the value in the file has a different structure; edit it by hand")


def _aligned(text: str, end: int, longer: int) -> str:
    """Return the text after a value, with its comment moved back to its column if there is room."""
    rest = text[end:]
    comment = re.match(r"( {2,})#", rest)
    if comment is None or longer == 0:
        return rest
    width = max(2, len(comment[1]) - longer)
    return " " * width + rest[len(comment[1]) :]


def _added(text: str, parent: yaml.MappingNode, steps: Location, value: Data) -> str:
    for step in reversed(steps[1:]):
        if not isinstance(step, str):
            raise EditError(f"{key_path(steps)}: there is no such list; change it by hand")
    if parent.flow_style:
        for step in reversed(steps[1:]):
            value = {str(step): value}
        end = parent.end_mark.index - 1
        comma = ", " if parent.value else ""
        before = text[:end].rstrip(" ")
        return before + f"{comma}{flow_text(steps[0])}: {flow_text(value)}" + text[len(before) :]
    newline = "\r\n" if "\r\n" in text else "\n"
    column = parent.value[0][0].start_mark.column
    lines = [f"{' ' * (column + 2 * depth)}{flow_text(step)}:" for depth, step in enumerate(steps)]
    lines[-1] += f" {flow_text(value)}"
    at = _line_end(text, _last_line_of_plain_values(parent))
    separator = newline if at == len(text) and not text.endswith("\n") else ""
    return text[:at] + separator + newline.join(lines) + newline + text[at:]


def _last_line_of_plain_values(parent: yaml.MappingNode) -> int:
    """Return the index of a character on the line after which a new key is added: the line of the last value that is not a block."""
    plain = [value for _, value in parent.value if _is_flow(value)]
    last: yaml.Node = (plain or [parent.value[-1][1]])[-1]
    while not _is_flow(last):
        item = last.value[-1]
        last = item[1] if isinstance(item, tuple) else item
    return max(last.start_mark.index, last.end_mark.index - 1)


def _is_flow(node: yaml.Node) -> bool:
    """Return whether the node ends at its end mark; a block's end mark comes after the comments that follow the block."""
    return isinstance(node, yaml.ScalarNode) or (isinstance(node, yaml.CollectionNode) and bool(node.flow_style))


def _line_end(text: str, index: int) -> int:
    end = text.find("\n", index)
    return len(text) if end < 0 else end + 1
