from __future__ import annotations

import dataclasses
import json
import math
import re
import struct
from typing import Any

import hypothesis.strategies as st
import jsonschema
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from companion.model import types
from companion.model.codec import (
    RecordError,
    differences,
    from_jsonable,
    json_schema,
    json_text,
    pack,
    pack_plain,
    plain,
    restore,
    to_jsonable,
    unpack,
    unpack_plain,
)
from tests.support import ROOT

RECORDS: list[type] = [
    value
    for value in vars(types).values()
    if isinstance(value, type) and dataclasses.is_dataclass(value) and value is not types.LinkIdentity
]
"""The guardian's heartbeat has a layout of its own, and with it `LinkIdentity`."""

st.register_type_strategy(float, st.floats(allow_nan=False, allow_infinity=False))
st.register_type_strategy(int, st.integers(-(2**62), 2**62))
st.register_type_strategy(str, st.text(st.characters(codec="utf-8"), max_size=8))


def test_marshal_is_decoded_only_where_the_flight_process_itself_has_written_it() -> None:
    """Its decoder is not made for data that may be forged, so no packet of a process that faces a network gets there."""
    package = ROOT / "companion"
    users = {
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if re.search(r"\bunpack_plain\(|\bmarshal\.load", path.read_text(encoding="utf-8"))
    }
    assert users == {"model/codec.py", "recorder/main.py", "recorder/telemetry_session.py"}


def test_all_records_of_the_types_module_are_covered() -> None:
    assert {"Inputs", "Outputs", "Sent", "ControlLog"} <= {cls.__name__ for cls in RECORDS}


@pytest.mark.parametrize("cls", RECORDS)
@settings(suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_record_survives_both_trips_bit_for_bit(cls: type, data: st.DataObject) -> None:
    record = data.draw(st.from_type(cls))
    assert differences(record, unpack(cls, pack(record))) is None
    document = json.loads(json_text(to_jsonable(record)))
    assert differences(record, from_jsonable(cls, document)) is None
    jsonschema.Draft202012Validator(json_schema(cls)).validate(document)


@pytest.mark.parametrize("value", [-0.0, 5e-324, 1.7976931348623157e308, 0.1 + 0.2, math.inf, -math.inf, math.nan])
def test_awkward_floats_survive_json_text_that_any_parser_accepts(value: float) -> None:
    record = types.ForceSample(value, (value, 1.0, 2.0), (0.0, value, 0.0), False)
    text = json_text(to_jsonable(record))
    restored = from_jsonable(types.ForceSample, json.loads(text, parse_constant=lambda name: pytest.fail(name)))
    assert differences(record, restored) is None
    assert differences(record, unpack(types.ForceSample, pack(record))) is None


def test_numpy_values_that_slip_into_a_record_are_restored_as_python_values() -> None:
    record = types.ForceSample(
        np.float64(0.1),
        (np.float64(1.5), 2.0, np.float64(-0.0)),
        np.array([1.0, 2.0, 3.0]),  # type: ignore[arg-type]
        np.bool_(True),  # type: ignore[arg-type]
    )
    wanted = types.ForceSample(0.1, (1.5, 2.0, -0.0), (1.0, 2.0, 3.0), True)
    sent = unpack_plain(pack_plain(plain(record)))
    assert differences(wanted, restore(types.ForceSample, sent)) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamp_s": "soon"}, "ForceSample.stamp_s: expected float, found 'soon'"),
        ({"overload": 1}, "ForceSample.overload: expected bool, found 1"),
        ({"force_sensor_n": [1.0, 2.0]}, "ForceSample.force_sensor_n: expected 3 values"),
        ({"extra": 1}, "ForceSample: unknown field 'extra'"),
    ],
)
def test_data_of_another_shape_is_refused_by_field(change: dict[str, Any], message: str) -> None:
    data = {**to_jsonable(types.ForceSample(1.0, (1.0, 2.0, 3.0), (1.0, 2.0, 3.0), False)), **change}
    with pytest.raises(RecordError) as caught:
        from_jsonable(types.ForceSample, data)
    assert message in str(caught.value)


def test_a_missing_field_and_an_unknown_enum_value_are_refused() -> None:
    with pytest.raises(RecordError, match="field 'attitude_wxyz' is missing"):
        from_jsonable(types.AttitudeSetpoint, {"thrust": 0.5})
    with pytest.raises(RecordError, match=r"Event.severity: 'dire' is none of info, warning, critical"):
        from_jsonable(types.Event, {"t_s": 0.0, "id": "x", "severity": "dire", "action": "warn", "text": ""})


def test_the_schema_names_units_and_requires_what_cannot_be_none() -> None:
    schema = json_schema(types.Outputs)
    assert schema["title"] == "companion.Outputs"
    assert schema["properties"]["reference"]["properties"]["position_world_m"] == {
        "type": "array",
        "items": {"type": "number"},
        "minItems": 3,
        "maxItems": 3,
    }
    assert "reference" not in schema["required"]
    assert "mission_t_s" in schema["required"]


def test_differences_tells_the_field_and_sees_the_last_bit() -> None:
    value = 0.3
    next_value = struct.unpack("<d", struct.pack("<q", struct.unpack("<q", struct.pack("<d", value))[0] + 1))[0]
    one = types.AttitudeSetpoint((1.0, 0.0, 0.0, value), 0.5)
    other = types.AttitudeSetpoint((1.0, 0.0, 0.0, next_value), 0.5)
    assert differences(one, other) == ("attitude_wxyz[3]", value, next_value)
    assert differences(-0.0, 0.0) is not None
    assert differences(1, 1.0) is not None


def test_a_state_of_a_log_from_before_the_imu_was_summed_is_read() -> None:
    zero = (0.0, 0.0, 0.0)
    state = types.VehicleState(1.0, 1.0, 1.0, zero, zero, (1.0, 0.0, 0.0, 0.0), zero, (0.0, 0.0, 9.81))
    old = to_jsonable(state)
    assert old.keys().isdisjoint({"boot_s", "imu_boot_s", "delta_velocity_body_m_s"})
    assert from_jsonable(types.VehicleState, old) == state
