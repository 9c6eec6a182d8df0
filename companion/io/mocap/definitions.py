"""NatNet model definitions (NAT_MODELDEF) since version 3.0; sources as in `companion.io.mocap.natnet`.

Since 4.0 a rigid body contains its markers' names, and since 4.2 the rotation of its pivot. Since 4.1 a definition states its size,
so that only the start of a rigid body (its name and id) is read; in earlier versions every type has to be known.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from companion.io.mocap.natnet import (
    COUNT_BYTES,
    SECTION_SIZES_SINCE,
    U32,
    VEC3_BYTES,
    Buffer,
    Malformed,
    Message,
    Version,
    payload_of,
    printable,
    skip_string,
)

_MARKER_NAMES_SINCE: Final[Version] = (4, 0)


class Descriptor(IntEnum):
    """Types of model definitions."""

    MARKER_SET = 0
    RIGID_BODY = 1
    SKELETON = 2
    FORCE_PLATE = 3
    DEVICE = 4
    CAMERA = 5
    ASSET = 6


@dataclass(frozen=True, slots=True)
class BodyDefinition:
    """Streaming id and name of a rigid body."""

    id: int
    name: str


def parse_model_definitions(datagram: Buffer, version: Version) -> tuple[BodyDefinition, ...] | Malformed:
    """Parse NAT_MODELDEF: ids and names of the rigid bodies, without those of skeletons and assets."""
    payload = payload_of(datagram, Message.MODELDEF)
    if isinstance(payload, Malformed):
        return payload
    try:
        return _model_definitions(payload, version)
    except (struct.error, ValueError) as error:
        return Malformed(f"model definitions of {len(payload)} bytes end early or have wrong sizes ({error})")


def _model_definitions(data: bytes, version: Version) -> tuple[BodyDefinition, ...]:
    bodies: list[BodyDefinition] = []
    count: int = U32.unpack_from(data)[0]
    offset = 4
    for _ in range(count):
        kind: int = U32.unpack_from(data, offset)[0]
        offset += 4
        if version >= SECTION_SIZES_SINCE:
            size: int = U32.unpack_from(data, offset)[0]
            offset += 4
            if kind == Descriptor.RIGID_BODY:
                bodies.append(_body_definition(data, offset))
            offset += size
            continue
        if kind == Descriptor.RIGID_BODY:
            bodies.append(_body_definition(data, offset))
        offset = _skip_description(kind, data, offset, named_markers=version >= _MARKER_NAMES_SINCE)
    if offset > len(data):
        raise ValueError("the last description is cut off")
    return tuple(bodies)


def _body_definition(data: bytes, offset: int) -> BodyDefinition:
    end = skip_string(data, offset)
    return BodyDefinition(U32.unpack_from(data, end)[0], printable(data[offset : end - 1]))


def _skip_description(kind: int, data: bytes, offset: int, *, named_markers: bool) -> int:
    if kind == Descriptor.RIGID_BODY:
        return _skip_body(data, offset, named_markers)
    if kind == Descriptor.SKELETON:
        offset = skip_string(data, offset)
        _, bones = COUNT_BYTES.unpack_from(data, offset)
        offset += COUNT_BYTES.size
        for _ in range(bones):
            offset = _skip_body(data, offset, named_markers)
        return offset
    if kind == Descriptor.MARKER_SET:
        return _skip_strings(data, skip_string(data, offset))
    if kind == Descriptor.FORCE_PLATE:
        # id, serial; width, length, origin, 12x12 calibration, 4 corners as floats; plate type, channel type; channel names
        return _skip_strings(data, skip_string(data, offset + 4) + 4 * (2 + 3 + 144 + 12) + 8)
    if kind == Descriptor.DEVICE:  # id, name, serial; device type, channel type; channel names
        return _skip_strings(data, skip_string(data, skip_string(data, offset + 4)) + 8)
    if kind == Descriptor.CAMERA:  # name, position, attitude
        return skip_string(data, offset) + 4 * 7
    raise ValueError(f"description of unknown type {kind}")


def _skip_body(data: bytes, offset: int, named_markers: bool) -> int:
    """Skip name, id, parent and offset, then position, active label and name of each marker (before 4.1)."""
    offset = skip_string(data, offset) + 8 + VEC3_BYTES
    markers: int = U32.unpack_from(data, offset)[0]
    offset += 4 + (VEC3_BYTES + 4) * markers
    return _skip_each_string(data, offset, markers) if named_markers else offset


def _skip_strings(data: bytes, offset: int) -> int:
    count: int = U32.unpack_from(data, offset)[0]
    return _skip_each_string(data, offset + 4, count)


def _skip_each_string(data: bytes, offset: int, count: int) -> int:
    for _ in range(count):
        offset = skip_string(data, offset)
    return offset
