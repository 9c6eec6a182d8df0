"""NatNet frames of data (NAT_FRAMEOFDATA) since version 3.0; sources, units and axes as in `companion.io.mocap.natnet`.

A frame consists of its number, sections and a suffix with the time stamps. The sections are marker sets, other markers, rigid
bodies, skeletons, assets (since 4.1), labelled markers, force plates and devices. Each starts with `u32 count`, followed since 4.1
by `u32 bytes`, so that its content need not be known. 3.0, 3.1 and 4.0 have the same frame; 4.1 to 4.4 have the same frame.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

from companion.io.mocap.natnet import (
    COUNT_BYTES,
    NEWEST_DESCRIBED_VERSION,
    SECTION_SIZES_SINCE,
    U32,
    VEC3_BYTES,
    Buffer,
    Malformed,
    Message,
    Version,
    payload_of,
    skip_string,
)
from companion.model.types import IDENTITY_QUAT, Quat, Vec3

RIGID_BODY_BYTES: Final = 38
LABELLED_MARKER_BYTES: Final = 26
SUFFIX_BYTES: Final = 54
"""Size of the whole suffix since 4.1: stamps, precision time stamp, parameters and end-of-data tag."""
LATER_LATENCY_MAX_S: Final = 1.0
"""If a version later than the newest described one yields a longer latency than this, its suffix has a different layout."""
_RIGID_BODY = struct.Struct("<I7ffH")
_SUFFIX = struct.Struct("<IIdQQQ")
_LABELLED_MARKER = struct.Struct("<I3ffHf")
_VEC3 = struct.Struct("<3f")
_PARAM_TRACKING_VALID = 0x01
_MARKER_OCCLUDED, _MARKER_HAS_BODY, _MARKER_UNLABELLED = 0x01, 0x08, 0x10
_MARKER_MAX_M = 1000.0
_QUAT_NORM_TOLERANCE = 0.02


class RigidBody(NamedTuple):
    """One rigid body of a frame, in the axes that the server streams."""

    id: int
    position_m: Vec3
    quat_wxyz: Quat
    error_m: float
    tracking_valid: bool


class Frame(NamedTuple):
    """The data of one frame that the companion uses."""

    number: int
    timestamp_s: float
    """Time of the frame on the server's own time base."""
    latency_s: float | None
    """Time from mid-exposure to transmission; None if the server has no exposure stamp or no clock frequency, or if the suffix of a
    version later than the newest described one is not understood."""
    exposure_s: float | None
    """Time of mid-exposure on the server's own clock; None in the same cases as `latency_s`."""
    body: RigidBody | None
    """The requested rigid body; None if it is not in this frame."""
    body_ids: tuple[int, ...]
    age_s: float | None = None
    """Time from mid-exposure to arrival, which the client adds."""
    markers: tuple[Vec3, ...] = ()
    """Markers that belong to no rigid body, in the axes that the server streams; empty if they were not requested."""
    bad_markers: int = 0
    """Number of such markers that are not finite or more than 1000 m from the origin, and therefore dropped."""


def parse_frame(
    datagram: Buffer, version: Version, body_id: int, clock_frequency_hz: int | None, *, markers: bool = False
) -> Frame | Malformed:
    """Parse the requested rigid body and the suffix of a NAT_FRAMEOFDATA datagram; all other sections are skipped.

    Args:
        datagram: the datagram including its header.
        version: the server's NatNet version.
        body_id: streaming id of the requested rigid body.
        clock_frequency_hz: from `ServerInfo`, for the latency.
        markers: whether markers that belong to no rigid body are requested, too.
    """
    payload = payload_of(datagram, Message.FRAME)
    if isinstance(payload, Malformed):
        return payload
    try:
        return _frame(payload, version, body_id, clock_frequency_hz, markers)
    except (struct.error, ValueError) as error:
        # Every read past the end and every missing terminator ends up here, so no field needs a check of its own.
        return Malformed(f"frame of {len(payload)} bytes ends early or has wrong section sizes ({error})")


def _frame(
    data: bytes, version: Version, body_id: int, clock_frequency_hz: int | None, with_markers: bool
) -> Frame | Malformed:
    sized = version >= SECTION_SIZES_SINCE
    number: int = U32.unpack_from(data)[0]
    others = _skip_marker_sets(data, 4, sized)
    offset = _skip_fixed(data, others, sized, VEC3_BYTES)  # other (unlabelled) markers

    count, start = _section(data, offset, sized)
    offset = start + RIGID_BODY_BYTES * count
    if offset > len(data):
        return Malformed(f"{count} rigid bodies do not fit into {len(data)} bytes")
    if sized and U32.unpack_from(data, start - 4)[0] != RIGID_BODY_BYTES * count:
        return Malformed(f"{count} rigid bodies are not {RIGID_BODY_BYTES} bytes each: a different bitstream version")
    ids = tuple(U32.unpack_from(data, start + RIGID_BODY_BYTES * i)[0] for i in range(count))
    body: RigidBody | None = None
    if body_id in ids:
        found = _rigid_body(data, start + RIGID_BODY_BYTES * ids.index(body_id))
        if isinstance(found, Malformed):
            return found
        body = found

    if sized:
        labelled = offset = _skip_sized(data, _skip_sized(data, offset))  # skeletons, assets
        for _ in range(3):  # labelled markers, force plates, devices
            offset = _skip_sized(data, offset)
        if version > NEWEST_DESCRIBED_VERSION:
            offset = _skip_unknown(data, offset)
    else:
        labelled = offset = _skip_skeletons(data, offset)
        offset = _skip_fixed(data, offset, sized, LABELLED_MARKER_BYTES)
        offset = _skip_channels(data, offset)  # force plates
        offset = _skip_channels(data, offset)  # devices
    _, _, timestamp_s, exposure, _, transmit = _SUFFIX.unpack_from(data, offset)
    latency_s: float | None = None
    exposure_s: float | None = None
    if clock_frequency_hz and exposure and transmit >= exposure:
        latency_s = (transmit - exposure) / clock_frequency_hz
        exposure_s = exposure / clock_frequency_hz
        if version > NEWEST_DESCRIBED_VERSION and latency_s > LATER_LATENCY_MAX_S:
            latency_s = exposure_s = None
    markers, bad = _single_markers(data, others, labelled, sized) if with_markers else ((), 0)
    return Frame(
        number=number,
        timestamp_s=timestamp_s,
        latency_s=latency_s,
        exposure_s=exposure_s,
        body=body,
        body_ids=ids,
        markers=markers,
        bad_markers=bad,
    )


def _single_markers(data: bytes, others: int, labelled: int, sized: bool) -> tuple[tuple[Vec3, ...], int]:
    """Return the markers that belong to no rigid body, and the number of those that are dropped. Depending on its settings Motive lists
    them as other markers, as labelled markers without a label, or as both; they are the same to the last bit then.

    Args:
        data: the payload of a frame that has been read to its end.
        others: offset of the section of other markers.
        labelled: offset of the section of labelled markers.
        sized: whether sections state their sizes.
    """
    count, start = _section(data, others, sized)
    found: list[Vec3] = list(_VEC3.iter_unpack(data[start : start + VEC3_BYTES * count]))
    count, start = _section(data, labelled, sized)
    if not sized or U32.unpack_from(data, start - 4)[0] == LABELLED_MARKER_BYTES * count:  # else of a later version
        for _, x, y, z, _, params, _ in _LABELLED_MARKER.iter_unpack(
            data[start : start + LABELLED_MARKER_BYTES * count]
        ):
            single = params & _MARKER_UNLABELLED or not params & _MARKER_HAS_BODY
            if single and not params & _MARKER_OCCLUDED:
                found.append((x, y, z))
    good = dict.fromkeys(point for point in found if all(abs(value) <= _MARKER_MAX_M for value in point))
    return tuple(good), sum(not all(abs(value) <= _MARKER_MAX_M for value in point) for point in found)


def _rigid_body(data: bytes, offset: int) -> RigidBody | Malformed:
    number, x, y, z, qx, qy, qz, qw, error_m, params = _RIGID_BODY.unpack_from(data, offset)
    valid = bool(params & _PARAM_TRACKING_VALID)
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    pose_ok = math.isfinite(x + y + z + error_m) and abs(norm - 1.0) < _QUAT_NORM_TOLERANCE
    if pose_ok:
        return RigidBody(
            id=number,
            position_m=(x, y, z),
            quat_wxyz=(qw / norm, qx / norm, qy / norm, qz / norm),
            error_m=error_m,
            tracking_valid=valid,
        )
    if valid:
        return Malformed(
            f"rigid body {number}: tracked, but its pose is not finite or its quaternion's norm is {norm:g}"
        )
    # Motive fills an untracked body with arbitrary values, zeros included.
    return RigidBody(id=number, position_m=(0.0, 0.0, 0.0), quat_wxyz=IDENTITY_QUAT, error_m=0.0, tracking_valid=False)


def _section(data: bytes, offset: int, sized: bool) -> tuple[int, int]:
    """Return the count of a section and the offset of its first element."""
    count: int = U32.unpack_from(data, offset)[0]
    return count, offset + (8 if sized else 4)


def _skip_sized(data: bytes, offset: int) -> int:
    _, size = COUNT_BYTES.unpack_from(data, offset)
    return offset + COUNT_BYTES.size + int(size)


def _skip_unknown(data: bytes, offset: int) -> int:
    """Return the suffix's offset after unknown sections at `offset`; if they do not end in one of known size, `offset`."""
    end = offset
    while len(data) - end > SUFFIX_BYTES:
        end = _skip_sized(data, end)
    return end if len(data) - end == SUFFIX_BYTES else offset


def _skip_marker_sets(data: bytes, offset: int, sized: bool) -> int:
    if sized:
        return _skip_sized(data, offset)
    count, start = _section(data, offset, sized=False)
    for _ in range(count):
        start = skip_string(data, start)
        markers: int = U32.unpack_from(data, start)[0]
        start += 4 + VEC3_BYTES * markers
    return start


def _skip_fixed(data: bytes, offset: int, sized: bool, element_bytes: int) -> int:
    count, start = _section(data, offset, sized)
    return start + element_bytes * count


def _skip_skeletons(data: bytes, offset: int) -> int:
    count, offset = _section(data, offset, sized=False)
    for _ in range(count):
        _, bones = COUNT_BYTES.unpack_from(data, offset)
        offset += 8 + RIGID_BODY_BYTES * bones
    return offset


def _skip_channels(data: bytes, offset: int) -> int:
    """Skip force plates or devices: an id and channels, each with its own number of floats."""
    count, offset = _section(data, offset, sized=False)
    for _ in range(count):
        _, channels = COUNT_BYTES.unpack_from(data, offset)
        offset += 8
        for _ in range(channels):
            values: int = U32.unpack_from(data, offset)[0]
            offset += 4 + 4 * values
    return offset
