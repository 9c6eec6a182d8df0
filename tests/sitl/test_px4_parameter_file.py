"""PX4's parameter file: an incomplete file is rejected, and the complete one is restored after PX4's end."""

from __future__ import annotations

import asyncio
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.autopilot.params import Value
from sitl.px4.hil_link import Px4Error
from sitl.px4.parameter_file import NAME, decode, restore, stored
from tests.support import DEADLINE_S

NAMES = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_", min_size=1, max_size=16)
VALUES = st.one_of(st.integers(-(2**31), 2**31 - 1), st.floats(allow_nan=False, allow_infinity=False))


def document(values: dict[str, Value]) -> bytes:
    """As PX4 writes it (tinybson): bsonspec.org."""
    body = b""
    for name, value in values.items():
        kind, data = (
            (b"\x10", struct.pack("<i", value)) if isinstance(value, int) else (b"\x01", struct.pack("<d", value))
        )
        body += kind + name.encode() + b"\0" + data
    return struct.pack("<i", len(body) + 5) + body + b"\0"


@given(st.dictionaries(NAMES, VALUES))
def test_it_reads_what_was_written(values: dict[str, Value]) -> None:
    assert decode(document(values)) == values


@given(st.dictionaries(NAMES, VALUES, min_size=1), st.data())
def test_a_file_that_is_not_whole_is_rejected(values: dict[str, Value], data: st.DataObject) -> None:
    whole = document(values)
    assert decode(whole[: data.draw(st.integers(0, len(whole) - 1))]) is None


@given(st.binary(max_size=64))
def test_whatever_is_in_it_does_no_harm(junk: bytes) -> None:
    decode(struct.pack("<i", len(junk) + 4) + junk)


async def test_it_waits_for_the_values_and_not_for_their_names(tmp_path: Path) -> None:
    file = tmp_path / NAME
    waiting = asyncio.create_task(stored(tmp_path, {"EKF2_EV_CTRL": 11, "MPC_THR_HOVER": 0.43}))
    for data in (b"", document({"EKF2_EV_CTRL": 0, "MPC_THR_HOVER": 0.43}), document({"EKF2_EV_CTRL": 11})):
        file.write_bytes(data)
        done, _ = await asyncio.wait((waiting,), timeout=0.15)
        assert not done
    whole = document({"MPC_THR_HOVER": struct.unpack("<f", struct.pack("<f", 0.43))[0], "EKF2_EV_CTRL": 11})
    file.write_bytes(whole)
    assert await asyncio.wait_for(waiting, DEADLINE_S) == whole


def test_parameters_that_px4_never_stores_are_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sitl.px4.parameter_file.STORED_DEADLINE_S", 0.2)
    with pytest.raises(Px4Error, match="expected the changed parameters in"):
        asyncio.run(stored(tmp_path, {"EKF2_EV_CTRL": 11}))


def test_a_file_that_was_cut_at_the_end_of_px4_is_made_whole(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b"")
    restore(tmp_path, document({"EKF2_EV_CTRL": 11}))
    assert decode((tmp_path / NAME).read_bytes()) == {"EKF2_EV_CTRL": 11}
