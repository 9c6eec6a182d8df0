"""The file in which a simulated PX4 stores its changed parameters; it is read while PX4 runs and restored after PX4 has ended.

PX4 writes the file some time after a change, in a separate thread. A SIGTERM before the write is complete leaves an empty file.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping
from pathlib import Path

from sitl.autopilot.params import Value
from sitl.px4.control_link import same
from sitl.px4.hil_link import Px4Error

NAME = "parameters.bson"
STORED_DEADLINE_S = 10.0
_LOOK_AGAIN_S = 0.05
_DOUBLE, _INT32, _END = 0x01, 0x10, 0x00


def decode(data: bytes) -> dict[str, Value] | None:
    """Return the parameters of a BSON document of doubles and 32-bit integers, or None if it is incomplete.

    Layout (bsonspec.org): int32 length of the whole document; for each element a type, a zero-terminated name and a value; then 0.
    """
    if len(data) < 5 or struct.unpack_from("<i", data)[0] != len(data):
        return None
    found: dict[str, Value] = {}
    at = 4
    while data[at] != _END:
        kind, name_end = data[at], data.find(b"\0", at + 1)
        size = {_DOUBLE: 8, _INT32: 4}.get(kind)
        if size is None or name_end < 0 or name_end + 1 + size >= len(data):
            return None
        value = data[name_end + 1 : name_end + 1 + size]
        found[data[at + 1 : name_end].decode(errors="replace")] = struct.unpack(
            "<d" if kind == _DOUBLE else "<i", value
        )[0]
        at = name_end + 1 + size
    return found


async def stored(folder: Path, values: Mapping[str, Value]) -> bytes:
    """Wait until the file contains these values, and return its bytes.

    Raises:
        Px4Error: PX4 did not store them within STORED_DEADLINE_S.
    """
    file = folder / NAME
    loop = asyncio.get_running_loop()
    end_s = loop.time() + STORED_DEADLINE_S
    while loop.time() < end_s:
        data = file.read_bytes() if file.exists() else b""
        held = decode(data)
        if held is not None and all(name in held and same(held[name], value) for name, value in values.items()):
            return data
        await asyncio.sleep(_LOOK_AGAIN_S)
    raise Px4Error(f"PX4: expected the changed parameters in {file} within {STORED_DEADLINE_S:g} s, found other values")


def restore(folder: Path, data: bytes) -> None:
    """Restore the last complete content of the file; call this function after PX4 has ended."""
    file = folder / NAME
    if file.read_bytes() != data:
        file.write_bytes(data)
