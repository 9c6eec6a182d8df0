"""Records of `companion.model.types` as plain nested data and back, bit for bit.

Three forms of one record:
    * the frozen dataclass;
    * *plain*: nested sequences in field order, enums by value; cheap to make in the control tick, carried by `marshal`
      between two processes of one interpreter (never stored);
    * *jsonable*: nested dicts by field name, for logs. A field that is ``None`` is left out, so that the JSON Schema needs
      no union types (viewers do not know them). A float that JSON cannot hold is the string "nan", "inf" or "-inf".
"""

from __future__ import annotations

import hashlib
import json
import marshal
import math
import struct
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from operator import attrgetter
from typing import Any, TypeVar

R = TypeVar("R")
Plain = Sequence[Any]
# Version 2 of the format writes floats in binary and spares the bookkeeping of shared references.
_MARSHAL_VERSION = 2
_LEAVES: tuple[type, ...] = (bool, int, float, str)


class RecordError(ValueError):
    """Data that is not the record it should be; names the field."""


def plain(record: object) -> Plain:
    """The record as nested sequences in field order."""
    return _codec(type(record)).plain(record)


def pack(record: object) -> bytes:
    """The record as bytes for another process of the same interpreter."""
    return pack_plain(_codec(type(record)).plain(record))


def pack_plain(values: Any) -> bytes:
    """Plain data as bytes, for packets that hold several records."""
    return marshal.dumps(values, _MARSHAL_VERSION)


def unpack_plain(data: bytes) -> Any:
    """Inverse of `pack_plain`; only for data from our own process pair."""
    return marshal.loads(data)


def unpack(cls: type[R], data: bytes) -> R:
    """Inverse of `pack`.

    Raises:
        RecordError: if the bytes hold something else.
    """
    return restore(cls, marshal.loads(data))


def restore(cls: type[R], values: Plain) -> R:
    """Inverse of `plain`."""
    return typing.cast(R, _codec(cls).restore(values))


def to_jsonable(record: object) -> dict[str, Any]:
    """The record as nested dicts, lists and scalars; ``None`` fields are left out."""
    codec = _codec(type(record))
    return codec.named(codec.plain(record))


def jsonable_from_plain(cls: type, values: Plain) -> dict[str, Any]:
    """`to_jsonable` of the record that `values` is the plain form of."""
    return _codec(cls).named(values)


def from_jsonable(cls: type[R], data: dict[str, Any]) -> R:
    """Inverse of `to_jsonable`, also after a trip through JSON text.

    Raises:
        RecordError: unknown or missing field, or a value of the wrong type; names the field.
    """
    return typing.cast(R, _codec(cls).from_json(data))


def json_text(jsonable: dict[str, Any]) -> str:
    """JSON text that every parser accepts and that restores each float exactly."""
    try:
        return json.dumps(jsonable, allow_nan=False, separators=(",", ":"))
    except ValueError:
        return json.dumps(_spelled(jsonable), allow_nan=False, separators=(",", ":"))


def json_schema(cls: type) -> dict[str, Any]:
    """JSON Schema of the jsonable form; field names carry the units."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_schema(cls),
        "title": f"companion.{cls.__name__}",
    }


def fingerprint(*classes: type) -> str:
    """Short hash of the shape of record classes: data of another shape cannot be restored faithfully."""
    text = json.dumps([json_schema(cls) for cls in classes], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differences(a: object, b: object, path: str = "") -> tuple[str, object, object] | None:
    """First field in which two values differ bit for bit: (path, value in a, value in b), or None.

    Stricter than ``==``: 0.0 and -0.0 differ, 1 and 1.0 differ, a NaN equals a NaN.
    """
    if is_dataclass(a) and not isinstance(a, type) and type(a) is type(b):
        for field in fields(a):
            found = differences(getattr(a, field.name), getattr(b, field.name), f"{path}.{field.name}".lstrip("."))
            if found is not None:
                return found
        return None
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            found = differences(one, other, f"{path}[{i}]")
            if found is not None:
                return found
        return None
    if type(a) is float and type(b) is float:
        same = struct.pack("<d", a) == struct.pack("<d", b) or (math.isnan(a) and math.isnan(b))
    else:
        same = type(a) is type(b) and a == b
    return None if same else (path, a, b)


@dataclass(frozen=True, slots=True)
class _Codec:
    """Converters of one record class."""

    plain: Callable[[Any], Plain]
    restore: Callable[[Any], Any]
    named: Callable[[Any], dict[str, Any]]
    from_json: Callable[[Any], Any]


_codecs: dict[type, _Codec] = {}


def _codec(cls: type) -> _Codec:
    codec = _codecs.get(cls)
    if codec is None:
        codec = _codecs[cls] = _make_codec(cls)
    return codec


def _hints(cls: type) -> dict[str, Any]:
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in fields(cls)}


def _make_codec(cls: type) -> _Codec:
    if not is_dataclass(cls):
        raise TypeError(f"{cls.__name__} is no record (dataclass)")
    hints = _hints(cls)
    names = tuple(hints)
    # attrgetter fetches every field in one call; `_value_` is Enum.value without its descriptor.
    getter = attrgetter(*(name + "._value_" if _is_enum(hint) else name for name, hint in hints.items()))
    if len(names) == 1:
        single = getter
        getter = typing.cast(Any, lambda record: (single(record),))
    nested = [
        (i, c) for i, hint in enumerate(hints.values()) if (c := _to_plain(hint)) is not None and not _is_enum(hint)
    ]
    from_plain = [(i, _from_plain(hint, f"{cls.__name__}.{name}")) for i, (name, hint) in enumerate(hints.items())]
    renamed = [(name, c) for name, hint in hints.items() if (c := _to_named(hint)) is not None]
    optional = tuple(name for name, hint in hints.items() if _optional(hint) is not None)
    required = frozenset(names) - frozenset(optional)
    known = frozenset(names)
    from_json = [(name, _from_json(hint, f"{cls.__name__}.{name}")) for name, hint in hints.items()]
    size = len(names)

    def plain_(record: Any) -> Plain:
        values = getter(record)
        if not nested:
            return typing.cast(Plain, values)
        out = list(values)
        for i, convert in nested:
            if out[i] is not None:
                out[i] = convert(out[i])
        return out

    def restore_(values: Any) -> Any:
        if len(values) != size:
            raise RecordError(f"{cls.__name__}: expected {size} fields, found {len(values)}")
        return cls(*[convert(values[i]) for i, convert in from_plain])

    def named_(values: Any) -> dict[str, Any]:
        out = dict(zip(names, values, strict=True))
        for name in optional:
            if out[name] is None:
                del out[name]
        for name, convert in renamed:
            if name in out:
                out[name] = convert(out[name])
        return out

    def from_json_(data: Any) -> Any:
        if not isinstance(data, dict):
            raise RecordError(f"{cls.__name__}: expected an object, found {data!r:.60}")
        if data.keys() - known:
            raise RecordError(f"{cls.__name__}: unknown field {min(data.keys() - known)!r}")
        if required - data.keys():
            raise RecordError(f"{cls.__name__}: field {min(required - data.keys())!r} is missing")
        get = data.get
        return cls(*[convert(get(name)) for name, convert in from_json])

    return _Codec(plain_, restore_, named_, from_json_)


def _is_enum(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Enum)


def _optional(hint: Any) -> Any | None:
    """X of `X | None`, or None if the hint is no such union."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        inner = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        if len(inner) == 1:
            return inner[0]
        raise TypeError(f"{hint}: only X | None is a record's field type")
    return None


def _tuple(hint: Any) -> tuple[Any, int | None] | None:
    """(element type, length or None if any) of a tuple hint, or None if it is no tuple."""
    if typing.get_origin(hint) is not tuple:
        return None
    args = typing.get_args(hint)
    if len(args) == 2 and args[1] is Ellipsis:
        return args[0], None
    if len(set(args)) != 1:
        raise TypeError(f"{hint}: elements of a record's tuple are of one type")
    return args[0], len(args)


def _to_plain(hint: Any) -> Callable[[Any], Any] | None:
    """Converter of a value that is not None; None where the value is plain already."""
    hint = _optional(hint) or hint
    if _is_enum(hint):
        return attrgetter("_value_")
    if is_dataclass(hint):
        return _codec(typing.cast(type, hint)).plain
    shape = _tuple(hint)
    if shape is not None:
        convert = _to_plain(shape[0])
        return None if convert is None else lambda items: [convert(item) for item in items]
    if hint not in _LEAVES:
        raise TypeError(f"{hint}: no type of a record's field")
    return None


def _to_named(hint: Any) -> Callable[[Any], Any] | None:
    """Plain value that is not None -> jsonable; None where they are the same."""
    hint = _optional(hint) or hint
    if is_dataclass(hint):
        return _codec(typing.cast(type, hint)).named
    shape = _tuple(hint)
    if shape is not None:
        convert = _to_named(shape[0])
        wrap = _sequence_of(shape[0])
        return wrap if convert is None else lambda items: [convert(item) for item in items]
    return _decoder(hint)


def _decoder(leaf: Any) -> Callable[[Any], Any] | None:
    """Converter of a numpy scalar, which `marshal` writes as its raw bytes, to the field's own type."""
    codes = {bool: {1: "?"}, int: {1: "b", 2: "h", 4: "i", 8: "q"}, float: {2: "e", 4: "f", 8: "d"}}.get(leaf)
    if codes is None:
        return None

    def decode(value: Any) -> Any:
        if type(value) is bytes and len(value) in codes:
            return struct.unpack("=" + codes[len(value)], value)[0]
        return value

    return decode


def _sequence_of(leaf: Any) -> Callable[[Any], Any]:
    """Converter of a tuple of leaves; an array arrives as bytes."""
    decode = _decoder(leaf)
    code = {bool: "?", int: "q", float: "d"}.get(leaf)

    def convert(items: Any) -> Any:
        if type(items) is bytes and code is not None:
            return list(struct.unpack(f"={len(items) // struct.calcsize(code)}{code}", items))
        if decode is None or bytes not in map(type, items):
            return items
        return [decode(item) for item in items]

    return convert


def _from_plain(hint: Any, where: str) -> Callable[[Any], Any]:
    return _converter(hint, where, lambda cls: _codec(cls).restore, text_floats=False)


def _from_json(hint: Any, where: str) -> Callable[[Any], Any]:
    return _converter(hint, where, lambda cls: _codec(cls).from_json, text_floats=True)


def _converter(
    hint: Any, where: str, of_record: Callable[[type], Callable[[Any], Any]], *, text_floats: bool
) -> Callable[[Any], Any]:
    inner = _optional(hint)
    if inner is not None:
        some = _converter(inner, where, of_record, text_floats=text_floats)
        return lambda value: None if value is None else some(value)
    if is_dataclass(hint):
        return of_record(typing.cast(type, hint))
    if _is_enum(hint):
        members = {member.value: member for member in hint}

        def member_of(value: Any) -> Any:
            try:
                return members[value]
            except (KeyError, TypeError):
                raise RecordError(f"{where}: {value!r:.60} is none of {', '.join(map(str, members))}") from None

        return member_of
    shape = _tuple(hint)
    if shape is not None:
        element, size = shape
        convert = _converter(element, where, of_record, text_floats=text_floats)
        unbox = _sequence_of(element)

        def tuple_of(value: Any) -> Any:
            if isinstance(value, (bytes, list, tuple)):
                value = unbox(value)
            if not isinstance(value, (list, tuple)) or (size is not None and len(value) != size):
                raise RecordError(
                    f"{where}: expected {size if size is not None else 'any number of'} values, found {value!r:.60}"
                )
            return tuple([convert(item) for item in value])

        return tuple_of
    accepted = (int, float) if hint is float else (hint,)
    decode = _decoder(hint)

    def leaf(value: Any) -> Any:
        if type(value) in accepted:
            return value
        if decode is not None and type(value) is bytes:
            value = decode(value)
        if text_floats and hint is float and value in ("nan", "inf", "-inf"):
            return float(value)
        if type(value) not in accepted:
            raise RecordError(f"{where}: expected {hint.__name__}, found {value!r:.60}")
        return value

    return leaf


def _spelled(value: Any) -> Any:
    """The same data with non-finite floats as strings."""
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    if isinstance(value, dict):
        return {key: _spelled(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_spelled(item) for item in value]
    return value


def _schema(hint: Any) -> dict[str, Any]:
    hint = _optional(hint) or hint
    if _is_enum(hint):
        return {"type": "string", "enum": [member.value for member in hint]}
    if is_dataclass(hint):
        hints = _hints(typing.cast(type, hint))
        return {
            "type": "object",
            "properties": {name: _schema(inner) for name, inner in hints.items()},
            "required": [name for name, inner in hints.items() if _optional(inner) is None],
            "additionalProperties": False,
        }
    shape = _tuple(hint)
    if shape is not None:
        element, size = shape
        bounds = {} if size is None else {"minItems": size, "maxItems": size}
        return {"type": "array", "items": _schema(element), **bounds}
    return {"type": {bool: "boolean", int: "integer", float: "number", str: "string"}[hint]}
