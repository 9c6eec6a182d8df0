"""NatNet model definitions (NAT_MODELDEF) of versions 3.0 and 4.1; sources as in `companion.io.mocap.natnet`."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from companion.io.mocap.natnet import (
    COUNT_BYTES,
    U32,
    VEC3_BYTES,
    Buffer,
    Malformed,
    Message,
    NatNetVersion,
    payload_of,
    printable,
    skip_string,
)


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


def parse_model_definitions(datagram: Buffer, version: NatNetVersion) -> tuple[BodyDefinition, ...] | Malformed:
    """Parse NAT_MODELDEF: ids and names of the rigid bodies, without those of skeletons and assets."""
    payload = payload_of(datagram, Message.MODELDEF)
    if isinstance(payload, Malformed):
        return payload
    try:
        return _model_definitions(payload, version == "4.1")
    except (struct.error, ValueError) as error:
        return Malformed(f"model definitions of {len(payload)} bytes end early or have wrong sizes ({error})")


def _model_definitions(data: bytes, sized: bool) -> tuple[BodyDefinition, ...]:
    bodies: list[BodyDefinition] = []
    count: int = U32.unpack_from(data)[0]
    offset = 4
    for _ in range(count):
        kind: int = U32.unpack_from(data, offset)[0]
        offset += 4
        if sized:
            size: int = U32.unpack_from(data, offset)[0]
            offset += 4
            if kind == Descriptor.RIGID_BODY:
                bodies.append(_body_definition(data, offset))
            offset += size
            continue
        if kind == Descriptor.RIGID_BODY:
            bodies.append(_body_definition(data, offset))
        elif kind not in _SKIP_DESCRIPTION:
            raise ValueError(f"description of unknown type {kind}")
        offset = _SKIP_DESCRIPTION[kind](data, offset)
    if offset > len(data):
        raise ValueError("the last description is cut off")
    return tuple(bodies)


def _body_definition(data: bytes, offset: int) -> BodyDefinition:
    end = skip_string(data, offset)
    return BodyDefinition(U32.unpack_from(data, end)[0], printable(data[offset : end - 1]))


def _skip_strings(data: bytes, offset: int) -> int:
    count: int = U32.unpack_from(data, offset)[0]
    offset += 4
    for _ in range(count):
        offset = skip_string(data, offset)
    return offset


def _skip_body(data: bytes, offset: int) -> int:
    """Skip name, id, parent and offset, then position and active label of each marker (3.0)."""
    offset = skip_string(data, offset) + 8 + VEC3_BYTES
    markers: int = U32.unpack_from(data, offset)[0]
    return offset + 4 + (VEC3_BYTES + 4) * markers


def _skip_marker_set_description(data: bytes, offset: int) -> int:
    return _skip_strings(data, skip_string(data, offset))


def _skip_skeleton_description(data: bytes, offset: int) -> int:
    offset = skip_string(data, offset)
    _, bones = COUNT_BYTES.unpack_from(data, offset)
    offset += 8
    for _ in range(bones):
        offset = _skip_body(data, offset)
    return offset


def _skip_force_plate(data: bytes, offset: int) -> int:
    # id, serial; width, length, origin, 12x12 calibration, 4 corners as floats; plate type, channel type; channel names
    return _skip_strings(data, skip_string(data, offset + 4) + 4 * (2 + 3 + 144 + 12) + 8)


def _skip_device(data: bytes, offset: int) -> int:
    return _skip_strings(data, skip_string(data, skip_string(data, offset + 4)) + 8)


def _skip_camera(data: bytes, offset: int) -> int:
    return skip_string(data, offset) + 4 * 7


_SKIP_DESCRIPTION: Final = {
    int(Descriptor.MARKER_SET): _skip_marker_set_description,
    int(Descriptor.RIGID_BODY): _skip_body,
    int(Descriptor.SKELETON): _skip_skeleton_description,
    int(Descriptor.FORCE_PLATE): _skip_force_plate,
    int(Descriptor.DEVICE): _skip_device,
    int(Descriptor.CAMERA): _skip_camera,
}
