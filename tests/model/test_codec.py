from __future__ import annotations

import json
import math
import struct
from typing import Any

import hypothesis.strategies as st
import jsonschema
import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from companion.model import outputs, packets, types
from companion.model.codec import (
    Record,
    RecordError,
    differences,
    fingerprint,
    from_json,
    from_jsonable,
    from_packet,
    json_schema,
    to_json,
    to_jsonable,
    to_packet,
)
from companion.model.contact import ContactState
from companion.phases.contact.force import begun

RECORDS = [types.Inputs, outputs.Outputs, outputs.Sent, types.GroundCommand]
"""With the records in them."""

st.register_type_strategy(float, st.floats())
st.register_type_strategy(int, st.integers(-(2**62), 2**62))
st.register_type_strategy(str, st.text(st.characters(codec="utf-8"), max_size=8))

HEALTHY = types.ForceSample(
    stamp_s=1.0, force_sensor_n=(1.0, 2.0, 3.0), torque_sensor_nm=(1.0, 2.0, 3.0), overload=False
)


def reject(name: str) -> float:
    pytest.fail(f"the text holds {name}")


@pytest.mark.parametrize("cls", RECORDS)
@settings(suppress_health_check=list(HealthCheck), max_examples=50)
@given(data=st.data())
def test_any_record_survives_packet_and_json_bit_for_bit(cls: type[Record], data: st.DataObject) -> None:
    record = data.draw(st.from_type(cls))
    assert differences(record, from_packet(cls, to_packet(record))) is None
    text = to_json(record)
    assert differences(record, from_json(cls, text)) is None
    document = json.loads(text, parse_constant=reject)
    if math.isfinite(float_sum(to_jsonable(record))):
        assert from_jsonable(cls, document) == record
        jsonschema.Draft202012Validator(json_schema(cls)).validate(document)


def test_a_field_that_is_left_out_because_it_has_its_default_is_not_required() -> None:
    contact = begun(1.0, (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    document = json.loads(to_json(contact))
    assert set(document) < set(contact.__struct_fields__)
    jsonschema.Draft202012Validator(json_schema(ContactState)).validate(document)


def float_sum(value: Any) -> float:
    """Infinite or NaN if a float in nested data is."""
    if isinstance(value, float):
        return 0.0 * value
    if isinstance(value, dict):
        return sum(map(float_sum, value.values()))
    return sum(map(float_sum, value)) if isinstance(value, (list, tuple)) else 0.0


@pytest.mark.parametrize("value", [-0.0, 5e-324, 1.7976931348623157e308, 0.1 + 0.2, math.inf, -math.inf, math.nan])
def test_awkward_floats_survive_json_text_that_any_parser_accepts(value: float) -> None:
    record = msgspec.structs.replace(HEALTHY, stamp_s=value, force_sensor_n=(value, 1.0, 2.0))
    text = to_json(record)
    json.loads(text, parse_constant=reject)
    assert differences(record, from_json(types.ForceSample, text)) is None
    assert differences(record, from_packet(types.ForceSample, to_packet(record))) is None


def test_not_finite_is_a_string_in_logs_and_refused_in_telemetry() -> None:
    text = to_json(msgspec.structs.replace(HEALTHY, stamp_s=math.nan))
    assert b'"stamp_s":"nan"' in text
    with pytest.raises(RecordError, match=r"Expected `float`, got `str` - at `\$\.stamp_s`"):
        from_jsonable(types.ForceSample, json.loads(text))


def test_a_text_may_hold_the_word_null_and_half_a_character() -> None:
    line = packets.LogLine(t_s=math.inf, severity=types.Severity.INFO, source="null", text="half \ud800")
    mended = msgspec.structs.replace(line, text="half ?")
    assert from_json(packets.LogLine, to_json(line)) == mended
    assert packets.read_packet(to_packet(msgspec.structs.replace(line, number=3))) == msgspec.structs.replace(
        mended, number=3
    )


def test_numpy_values_that_slip_into_a_record_arrive_as_python_values() -> None:
    record = types.ForceSample(
        stamp_s=np.float64(0.1),
        force_sensor_n=(np.float64(1.5), 2.0, np.float64(-0.0)),
        torque_sensor_nm=np.array([1.0, 2.0, 3.0]),  # type: ignore[arg-type]
        overload=np.bool_(True),  # type: ignore[arg-type]
    )
    wanted = types.ForceSample(
        stamp_s=0.1, force_sensor_n=(1.5, 2.0, -0.0), torque_sensor_nm=(1.0, 2.0, 3.0), overload=True
    )
    assert differences(wanted, from_packet(types.ForceSample, to_packet(record))) is None
    assert differences(wanted, from_json(types.ForceSample, to_json(record))) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamp_s": "soon"}, r"Expected `float`, got `str` - at `$.stamp_s`"),
        ({"overload": 1}, r"Expected `bool`, got `int` - at `$.overload`"),
        ({"force_sensor_n": [1.0, 2.0]}, r"Expected `array` of length 3, got 2 - at `$.force_sensor_n`"),
        ({"extra": 1}, "Object contains unknown field `extra`"),
    ],
)
def test_data_of_another_shape_is_refused_by_field(change: dict[str, Any], message: str) -> None:
    data = {**to_jsonable(HEALTHY), **change}
    with pytest.raises(RecordError) as caught:
        from_jsonable(types.ForceSample, data)
    assert str(caught.value) == f"ForceSample: {message}"


def test_a_missing_field_and_an_unknown_enum_value_are_refused() -> None:
    with pytest.raises(RecordError, match="missing required field `attitude_wxyz`"):
        from_json(types.AttitudeSetpoint, b'{"thrust":0.5}')
    with pytest.raises(RecordError, match=r"Invalid enum value 'dire' - at `\$\.severity`"):
        from_json(types.Event, b'{"t_s":0.0,"id":"x","severity":"dire","action":"warn","text":""}')


@given(
    st.binary(max_size=64)
    | st.builds(lambda cut: to_packet(packets.Metadata(7, "a", {"b": "c"}))[:cut], st.integers(0, 20))
)
@settings(max_examples=50)
def test_damaged_packets_are_refused(data: bytes) -> None:
    with pytest.raises(RecordError):
        packets.read_packet(data)


def test_the_schema_names_units_and_requires_what_cannot_be_none() -> None:
    schema = json_schema(outputs.Outputs)
    assert schema["title"] == "companion.Outputs"
    assert schema["properties"]["reference"]["properties"]["position_world_m"] == {
        "type": "array",
        "items": {"type": "number"},
        "minItems": 3,
        "maxItems": 3,
    }
    assert "reference" not in schema["required"]
    assert "mission_t_s" in schema["required"]


def test_the_fingerprint_of_a_tick_is_that_of_the_logs_there_are() -> None:
    """Whoever changes a field of these records changes it here, knowing that no log written before can be replayed."""
    assert fingerprint(types.Inputs, outputs.Outputs, outputs.Sent) == "88db4ceb27214e04"


@pytest.mark.parametrize("cls", [*RECORDS, *(hint for hint in packets.Packet.__args__)])
def test_only_what_may_be_none_has_a_default(cls: type[Record]) -> None:
    """A field that equals its default is left out: a viewer would miss it."""
    assert all(field.default in (None, msgspec.NODEFAULT) for field in msgspec.structs.fields(cls))


def test_differences_shows_the_field_and_sees_the_last_bit() -> None:
    value = 0.3
    next_value = struct.unpack("<d", struct.pack("<q", struct.unpack("<q", struct.pack("<d", value))[0] + 1))[0]
    one = types.AttitudeSetpoint((1.0, 0.0, 0.0, value), 0.5)
    other = types.AttitudeSetpoint((1.0, 0.0, 0.0, next_value), 0.5)
    assert differences(one, other) == ("attitude_wxyz[3]", value, next_value)
    assert differences(-0.0, 0.0) is not None
    assert differences(1, 1.0) is not None


def test_a_state_of_a_log_from_before_the_imu_was_summed_is_read() -> None:
    zero = (0.0, 0.0, 0.0)
    state = types.VehicleState(
        position_stamp_s=1.0,
        attitude_stamp_s=1.0,
        imu_stamp_s=1.0,
        position_world_m=zero,
        velocity_world_m_s=zero,
        attitude_wxyz=types.IDENTITY_QUAT,
        angular_rate_body_rad_s=zero,
        specific_force_body_m_s2=(0.0, 0.0, 9.81),
    )
    old = to_json(state)
    assert b"boot_s" not in old
    assert from_json(types.VehicleState, old) == state
