"""Parameters of the PX4 stub: types, byte-wise encoding, what is refused, and that the facts' names are there."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.sitl_config.loader import load_sitl
from sitl.autopilot.backend import stub_of
from sitl.autopilot.params import MAV_PARAM_TYPE_INT32, Params, decode_bytewise, encode_bytewise
from tests.support import HOVER


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_survive_the_float_field_of_the_wire(value: int) -> None:
    on_the_wire = struct.unpack("<f", struct.pack("<f", encode_bytewise(value)))[0]
    if math.isnan(encode_bytewise(value)):
        return  # a signalling NaN may be quietened by the float conversion, on PX4's side of the wire too
    assert decode_bytewise(on_the_wire, MAV_PARAM_TYPE_INT32) == value


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [("NO_SUCH_PARAM", 1, KeyError), ("EKF2_EV_CTRL", 2**31, ValueError), ("MPC_THR_HOVER", math.nan, ValueError)],
)
def test_bad_values_are_refused(name: str, value: float, error: type[Exception]) -> None:
    with pytest.raises(error):
        Params({name: value})


def test_the_stub_imitates_the_version_of_the_world_file() -> None:
    config = load_sitl(HOVER, overrides=['world.px4_version="1.18"'])
    assert stub_of(config.world, config.vehicle.airframe).params.release == (1, 18)
