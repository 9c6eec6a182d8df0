"""Decoder of protobuf messages by the descriptors in a log, as a viewer without generated code decodes them.

Wire format and descriptor.proto as published (protobuf.dev: Encoding; field numbers of FileDescriptorSet and below). proto3 only.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_FIXED = {1: "<d", 2: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
_SIGNED = (3, 5)
_BOOL, _STRING, _MESSAGE, _BYTES, _ENUM = 8, 9, 11, 12, 14
_REPEATED = 3
_DEFAULTS: dict[int, Any] = {1: 0.0, 2: 0.0, _BOOL: False, _STRING: "", _BYTES: b"", _MESSAGE: None}


class WireError(ValueError):
    """The bytes are not a message of that type."""


@dataclass(frozen=True)
class Field:
    name: str
    kind: int
    """FieldDescriptorProto.Type."""
    repeated: bool
    type_name: str


class Descriptors:
    """Message types of a binary FileDescriptorSet."""

    def __init__(self, descriptor_set: bytes) -> None:
        self._messages: dict[str, dict[int, Field]] = {}
        self._enums: dict[str, dict[int, str]] = {}
        for number, file in _records(descriptor_set):
            if number == 1:
                package = "".join(_text(value) for n, value in _records(file) if n == 2)
                self._take(file, package, message_number=4, enum_number=5)

    def decode(self, type_name: str, data: bytes) -> dict[str, Any]:
        """Return the message as nested dicts; an absent field has its default, an absent message is None."""
        fields = self._messages.get(type_name)
        if fields is None:
            raise WireError(f"{type_name}: not in the descriptor set, which has {sorted(self._messages)}")
        found: dict[str, Any] = {
            field.name: [] if field.repeated else _DEFAULTS.get(field.kind, 0) for field in fields.values()
        }
        for number, value in _records(data):
            field = fields.get(number)
            if field is None:
                raise WireError(f"{type_name}: unknown field {number}")
            for item in self._values(field, value):
                if field.repeated:
                    found[field.name].append(item)
                else:
                    found[field.name] = item
        return found

    def _take(self, data: bytes, scope: str, *, message_number: int, enum_number: int) -> None:
        for number, value in _records(data):
            if number == message_number:
                name = f"{scope}.{_name(value)}".lstrip(".")
                self._messages[name] = dict(_field(item) for n, item in _records(value) if n == 2)
                self._take(value, name, message_number=3, enum_number=4)
            elif number == enum_number:
                members = [dict(_records(item)) for n, item in _records(value) if n == 2]
                self._enums[f"{scope}.{_name(value)}".lstrip(".")] = {m.get(2, 0): _text(m[1]) for m in members}

    def _values(self, field: Field, value: Any) -> Iterator[Any]:
        if field.kind in _FIXED:
            layout = _FIXED[field.kind]
            size = struct.calcsize(layout)
            if not isinstance(value, bytes) or len(value) % size or (len(value) != size and not field.repeated):
                raise WireError(f"{field.name}: {value!r} is no {layout}")
            yield from (item for (item,) in struct.iter_unpack(layout, value))
        elif field.kind == _MESSAGE:
            yield self.decode(field.type_name, value)
        elif field.kind == _STRING:
            yield _text(value)
        elif field.kind == _BYTES:
            yield value
        elif isinstance(value, bytes):  # packed
            at = 0
            while at < len(value):
                number, at = _varint(value, at)
                yield self._number(field, number)
        else:
            yield self._number(field, value)

    def _number(self, field: Field, value: int) -> Any:
        if field.kind == _BOOL:
            return bool(value)
        if field.kind == _ENUM:
            if value not in self._enums[field.type_name]:
                raise WireError(f"{field.name}: {value} is none of {self._enums[field.type_name]}")
            return value
        return value - 2**64 if field.kind in _SIGNED and value >= 2**63 else value


def _field(data: bytes) -> tuple[int, Field]:
    values = dict(_records(data))
    type_name = _text(values.get(6, b"")).lstrip(".")
    return values[3], Field(_text(values[1]), values[5], values.get(4) == _REPEATED, type_name)


def _name(data: bytes) -> str:
    return next(_text(value) for number, value in _records(data) if number == 1)


def _text(value: Any) -> str:
    if not isinstance(value, bytes):
        raise WireError(f"{value!r} is no text")
    return value.decode()


def _records(data: bytes) -> Iterator[tuple[int, Any]]:
    """(field number, int or bytes) of one message."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number, wire = tag >> 3, tag & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == 2:
            size, at = _varint(data, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise WireError(f"wire type {wire}")
        if at + size > len(data):
            raise WireError("cut off")
        yield number, data[at : at + size]
        at += size


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise WireError("no varint")
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if not byte & 0x80:
            return value, at
        shift += 7
