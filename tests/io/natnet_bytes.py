"""NatNet payloads that use all that a version has, written without the companion's parser and the simulated server's encoder."""

from __future__ import annotations

import struct
from typing import get_args

from companion.config.devices import NatNetVersion
from companion.io.mocap.natnet import Message, Version, encode_message

LATER = "4.9"
"""A version that no SDK describes."""
DESCRIBED: tuple[str, ...] = get_args(NatNetVersion)
VERSIONS = (*DESCRIBED, LATER)


def numbers(version: str) -> Version:
    """Return major and minor number."""
    major, minor = version.split(".")
    return int(major), int(minor)


def full_frame(version: str, unknown: tuple[bytes, ...] = (), more_suffix: bytes = b"") -> bytes:
    """Return a frame with two elements in every section.

    Its bodies are 3 at (30, 2, 3) m and 1 at (10, 2, 3) m; those of its skeletons and assets have the same ids and other positions.
    Its stamps are 1000, 1500 and 3000 ticks.

    Args:
        version: bitstream version.
        unknown: contents of additional sections before the suffix.
        more_suffix: additional field of the suffix, behind its stamps.
    """
    sized = numbers(version) >= (4, 1)

    def section(parts: list[bytes]) -> bytes:
        content = b"".join(parts)
        return struct.pack("<I", len(parts)) + (struct.pack("<I", len(content)) if sized else b"") + content

    def body(number: int, x_m: float) -> bytes:
        return struct.pack("<IffffffffH", number, x_m, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.001, 1)

    def channels(number: int) -> bytes:
        return struct.pack("<II", number, 2) + struct.pack("<I2f", 2, 1.0, 2.0) + struct.pack("<If", 1, 3.0)

    marker = struct.pack("<IffffHf", 65537, 1.0, 2.0, 3.0, 0.014, 2, 0.0)
    payload = struct.pack("<I", 4242)
    payload += section([name + struct.pack("<I3f", 1, 7.0, 7.0, 7.0) for name in (b"a longer name\0", b"\0")])
    payload += section([struct.pack("<3f", 1.0, 1.0, 1.0)] * 2)
    payload += section([body(3, 30.0), body(1, 10.0)])
    payload += section([struct.pack("<II", k, 2) + body(1, 99.0) + body(2, 99.0) for k in (1, 2)])  # skeletons
    if sized:
        payload += section(
            [struct.pack("<II", k, 1) + body(1, 98.0) + struct.pack("<I", 1) + marker for k in (1, 2)]
        )  # assets
    payload += section([marker] * 2)
    payload += section([channels(1), channels(2)]) * 2  # force plates, devices
    payload += b"".join(section([content]) for content in unknown)
    payload += struct.pack("<IIdQQQ", 0, 0, 12.5, 1000, 1500, 3000) + more_suffix
    payload += struct.pack("<II", 12, 0) if sized else b""
    return encode_message(Message.FRAME, payload + struct.pack("<H", 2) + bytes(4))


def all_definitions(version: str) -> bytes:
    """Return model definitions of every type that the version has; the only rigid body outside a skeleton is 1, "quad"."""
    sized = numbers(version) >= (4, 1)
    pivot = struct.pack("<Ii3f", 1, -1, 0.0, 0.0, 0.0) + (bytes(16) if numbers(version) >= (4, 2) else b"")
    labels = b"left\0right\0" if numbers(version) >= (4, 0) else b""
    markers = struct.pack("<I", 2) + struct.pack("<6f", *range(6)) + struct.pack("<2I", 0, 0) + labels
    body = b"quad\0" + pivot + markers
    channels = struct.pack("<I", 2) + b"Fx\0Fy\0"
    descriptions = [
        (0, b"set\0" + struct.pack("<I", 1) + b"m1\0"),
        (2, b"skeleton\0" + struct.pack("<II", 1, 2) + body * 2),
        (
            3,
            struct.pack("<I", 1)
            + b"serial\0"
            + struct.pack("<161f", *range(161))
            + struct.pack("<II", 1, 0)
            + channels,
        ),
        (4, struct.pack("<I", 1) + b"daq\0serial\0" + struct.pack("<II", 1, 0) + channels),
        (5, b"camera\0" + struct.pack("<7f", *range(7))),
        *([(6, b"asset\0" + struct.pack("<III", 0, 1, 1) + body), (66, b"unknown")] if sized else []),
        (1, body),
    ]
    payload = struct.pack("<I", len(descriptions))
    for kind, content in descriptions:
        payload += struct.pack("<I", kind) + (struct.pack("<I", len(content)) if sized else b"") + content
    return encode_message(Message.MODELDEF, payload)
