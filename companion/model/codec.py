"""The base class of frozen records, and the only codec for sending them between processes and writing them to logs.

A record has two encodings, both by field name:

* A *packet* is MessagePack, for another process on the same computer. Floats keep all 64 bits. * *JSON* is for logs and telemetry. It
restores every finite float exactly. JSON has no NaN or infinity, so the text contains them as the
  strings "nan", "inf" and "-inf".

Both encodings omit a field that is None, so that a log's JSON Schema needs no union types, which viewers do not support. Decoding
rejects unknown fields, missing fields and wrong types.

A field that may be None has None as its default. No other field of an encoded record may have a default, because msgspec omits every
field that equals its default.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import types
import typing
from collections.abc import Hashable
from enum import Enum
from functools import cache
from typing import Any, TypeVar

import msgspec


class Record(msgspec.Struct, frozen=True, gc=False, omit_defaults=True, forbid_unknown_fields=True):
    """Base class of frozen records; subclasses inherit its settings.

    `gc=False` keeps records out of the cyclic garbage collector. A record contains numbers, strings, enums, tuples and other records,
    which cannot form a reference cycle.
    """


R = TypeVar("R")
_ERROR_CHARACTERS = 200


class RecordError(ValueError):
    """The data does not match the record class; the text names the field."""


def to_packet(record: Any) -> bytes:
    """Return the record as MessagePack.

    Raises:
        ValueError, TypeError, OverflowError: the record contains a value of a type that records do not support.
    """
    try:
        return _PACKETS.encode(record)
    except UnicodeEncodeError:
        return _PACKETS.encode(_mended(to_jsonable(record), spell_floats=False))


def from_packet(cls: Any, packet: bytes) -> Any:
    """Decode bytes from `to_packet` into a record of this class or, for a union, of one of its classes.

    Raises:
        RecordError: the bytes are corrupt or are not a record of this kind.
    """
    try:
        return _packet_decoder(cls).decode(packet)
    except (ValueError, RecursionError) as error:
        raise _refused(cls, error) from None


def to_json(record: Any) -> bytes:
    """Return the record as compact JSON text in UTF-8, with the fields in declaration order.

    Raises:
        ValueError, TypeError: the record contains a value of a type that records do not support.
    """
    try:
        text = _JSON.encode(record)
    except UnicodeEncodeError:
        text = b"null"
    # msgspec writes a non-finite float as null. No other value is written as null, but a text may contain the word.
    return _JSON.encode(_mended(to_jsonable(record), spell_floats=True)) if b"null" in text else text


def from_json(cls: type[R], text: bytes) -> R:
    """Decode text from `to_json` into a record.

    Raises:
        RecordError: the text is corrupt or is not a record of this class.
    """
    try:
        return typing.cast(R, _json_decoder(typing.cast(Hashable, cls)).decode(text))
    except (ValueError, RecursionError) as error:
        raise _refused(cls, error) from None


def to_jsonable(record: Any) -> Any:
    """Return the record as nested dicts, lists and scalars. Fields that are None are omitted; NaN remains a float."""
    return msgspec.to_builtins(record, enc_hook=_from_numpy)


def from_jsonable(cls: type[R], data: Any) -> R:
    """Convert nested dicts, as `json.loads` returns them, into a record.

    Raises:
        RecordError: a field is unknown or missing, or a value has the wrong type; a string is not accepted as a number.
    """
    try:
        return msgspec.convert(data, cls)
    except (ValueError, RecursionError) as error:
        raise _refused(cls, error) from None


def json_schema(cls: type[Record]) -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of the text from `to_json`; the units are part of the field names."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **_schema(cls),
        "title": f"companion.{cls.__name__}",
    }


def fingerprint(*classes: type[Record]) -> str:
    """Return a short hash of the classes' fields; a log with a different hash cannot be replayed."""
    text = json.dumps([json_schema(cls) for cls in classes], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def differences(a: object, b: object, path: str = "") -> tuple[str, object, object] | None:
    """Return the first field in which two values are not identical, as (path, value in a, value in b); None if there is none.

    Unlike with `==`, 0.0 and -0.0 differ, and so do 1 and 1.0, but any NaN is identical to any NaN.
    """
    if isinstance(a, Record) and type(a) is type(b):
        for name in a.__struct_fields__:
            found = differences(getattr(a, name), getattr(b, name), f"{path}.{name}".lstrip("."))
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


def _from_numpy(value: Any) -> Any:
    """Convert a NumPy scalar or array in a record to a Python number or list; raises TypeError for an unsupported type."""
    tolist = getattr(value, "tolist", None)
    if tolist is None:
        raise TypeError(f"a record cannot contain a {type(value).__name__}")
    return tolist()


_PACKETS = msgspec.msgpack.Encoder(enc_hook=_from_numpy)
_JSON = msgspec.json.Encoder(enc_hook=_from_numpy)


@cache
def _packet_decoder(cls: Hashable) -> msgspec.msgpack.Decoder[Any]:
    return msgspec.msgpack.Decoder(cls)


@cache
def _json_decoder(cls: Hashable) -> msgspec.json.Decoder[Any]:
    return msgspec.json.Decoder(cls, strict=False)  # a string may be a number: "nan"


def _refused(cls: Any, error: Exception) -> RecordError:
    """Return the error with its text as one printable line; the text may quote the decoded data."""
    text = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(error)[:_ERROR_CHARACTERS])
    return RecordError(f"{getattr(cls, '__name__', 'packet')}: {text}")


def _mended(value: Any, *, spell_floats: bool) -> Any:
    """Return the data for any parser: "?" for half of a surrogate pair and, with `spell_floats`, strings for non-finite floats."""
    if isinstance(value, float) and spell_floats and not math.isfinite(value):
        return repr(value)
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, dict):
        return {key: _mended(item, spell_floats=spell_floats) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_mended(item, spell_floats=spell_floats) for item in value]
    return value


def _schema(hint: Any) -> dict[str, Any]:
    """Return the JSON Schema of one field's type; raises TypeError for a type that a record's field cannot have."""
    if hint in _LEAVES:
        return {"type": _LEAVES[hint]}
    if isinstance(hint, type) and issubclass(hint, Enum):
        return {"type": "string", "enum": [member.value for member in hint]}
    if isinstance(hint, type) and issubclass(hint, msgspec.Struct):
        hints = typing.get_type_hints(hint)
        names = hint.__struct_fields__
        return {
            "type": "object",
            "properties": {name: _schema(_without_none(hints[name])) for name in names},
            "required": [
                field.name for field in msgspec.structs.fields(hint) if field.required
            ],  # a default is left out
            "additionalProperties": False,
        }
    if typing.get_origin(hint) is tuple:
        element, *others = typing.get_args(hint)
        if set(others) - {element, Ellipsis}:
            raise TypeError(f"{hint}: the elements of a record's tuple must have one type")
        size = len(others) + 1
        bounds = {} if others == [Ellipsis] else {"minItems": size, "maxItems": size}
        return {"type": "array", "items": _schema(element), **bounds}
    raise TypeError(f"{hint}: not a valid type for a record's field")


_LEAVES = {bool: "boolean", int: "integer", float: "number", str: "string"}


def _without_none(hint: Any) -> Any:
    """Return X for `X | None`. Return any other type unchanged."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        (hint,) = [arg for arg in typing.get_args(hint) if arg is not types.NoneType]
    return hint
