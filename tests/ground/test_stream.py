from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from typing import Any

import jsonschema
import msgspec
import pytest

from companion.analysis.timing import timing_of
from companion.config.loader import load_flight
from companion.ground.protocol.messages import (
    EVENTS_KEPT,
    MESSAGE_MAX_BYTES,
    BallView,
    BarView,
    Events,
    HealthLevel,
    Stream,
    Topic,
    decode,
)
from companion.ground.telemetry.stream import TEXT_MAX, StreamBuilder, replay
from companion.model.codec import Record, to_json
from companion.model.frames import quat_from_euler_zyx, quat_multiply
from companion.model.markers import BallState
from companion.model.outputs import ActiveRule, Outputs, Sent
from companion.model.team import BarPose
from companion.model.types import AttitudeSetpoint, Event, Inputs, PhaseKind, SafetyAction, Severity, VehicleState
from companion.safety.rule import Lamp, Rule
from companion.safety.rules import RULES
from tests.analysis.synthetic_flight import synthetic_flight
from tests.safety.healthy import SLOW
from tests.support import CATCH, position_error_m
from tools.docs.telemetry import schema_of

Row = tuple[Inputs, Outputs, Sent]
CONFIG = load_flight(CATCH)
SAFETY = CONFIG.vehicle.safety
ROWS: list[Row] = list(synthetic_flight(end_s=9.0))
IN_FLIGHT = ROWS[1500]


def changed(row: Row, **values: Any) -> Row:
    """The row with fields replaced, by path: `mocap__latency_s=0.3`, `outputs__phase="x"`."""

    def put(record: Any, path: list[str], value: Any) -> Any:
        if not path:
            return value
        return msgspec.structs.replace(record, **{path[0]: put(getattr(record, path[0]), path[1:], value)})

    parts: dict[str, Any] = {"inputs": row[0], "outputs": row[1], "sent": row[2]}
    for name, value in values.items():
        path = name.split("__")
        if path[0] not in parts:
            path = ["inputs", *path]
        parts[path[0]] = put(parts[path[0]], path[1:], value)
    return parts["inputs"], parts["outputs"], parts["sent"]


def stream_of(*rows: Row) -> Stream:
    maker = StreamBuilder(CONFIG, "s")
    for row in rows:
        maker.add_tick(*row)
    return maker.build(1.7e9)


def light_of(stream: Stream, name: str) -> tuple[HealthLevel, str]:
    found = {health.name: health for health in stream.lights}
    return found[name].light, found[name].text


def test_a_message_is_the_tick_that_it_is_made_of() -> None:
    inputs, outputs, _ = IN_FLIGHT
    stream = stream_of(IN_FLIGHT)
    assert inputs.mocap is not None and inputs.arm is not None and outputs.reference is not None
    assert stream.position_world_m == pytest.approx(inputs.mocap.position_world_m, abs=6e-5)
    assert stream.attitude_wxyz == pytest.approx(inputs.mocap.attitude_wxyz, abs=6e-6)
    assert stream.arm_rad == pytest.approx(inputs.arm.angle_rad, abs=6e-6)
    assert stream.reference_world_m == pytest.approx(outputs.reference.position_world_m, abs=6e-5)
    assert (stream.phase, stream.kind, stream.action) == (outputs.phase, "flight", "nominal")
    assert (stream.pose_from, stream.armed, stream.mode) == ("mocap", True, "offboard")
    assert stream.control is not None and outputs.control is not None
    assert stream.control.tau == pytest.approx(outputs.control.tau[0:3], abs=6e-5)
    assert stream.control.arm_torque_nm == pytest.approx(outputs.control.tau[6:8], abs=6e-5)
    assert not stream.waits_for_start and stream.ball is None
    assert decode(Stream, to_json(stream)) == stream
    jsonschema.Draft202012Validator(schema_of(Topic.STREAM)).validate(json.loads(to_json(stream)))


def test_a_ball_is_shown_with_the_time_until_the_net_meets_it() -> None:
    t_s = IN_FLIGHT[0].t_s
    ball = BallState(position_world_m=(1.0, 2.0, 3.0), meeting_world_m=(0.5, 0.25, 1.0), meeting_s=t_s + 0.25)
    stream = stream_of(changed(IN_FLIGHT, outputs__ball=ball))
    assert stream.ball == BallView(position_world_m=(1.0, 2.0, 3.0), meeting_world_m=(0.5, 0.25, 1.0), meets_in_s=0.25)
    assert decode(Stream, to_json(stream)) == stream
    late = stream_of(changed(IN_FLIGHT, outputs__ball=msgspec.structs.replace(ball, meeting_s=t_s - 0.1))).ball
    assert late is not None and late.meets_in_s == 0.0


def test_a_bar_is_shown_while_motion_capture_sees_it() -> None:
    level = (1.0, 0.0, 0.0, 0.0)
    bar = BarPose(
        stamp_s=IN_FLIGHT[0].t_s - 0.05, position_world_m=(1.0, 2.0, 0.6), attitude_wxyz=level, tracking_valid=True
    )
    stream = stream_of(changed(IN_FLIGHT, bar=bar))
    assert stream.bar == BarView(position_world_m=(1.0, 2.0, 0.6), attitude_wxyz=level)
    assert decode(Stream, to_json(stream)) == stream
    jsonschema.Draft202012Validator(schema_of(Topic.STREAM)).validate(json.loads(to_json(stream)))
    changes: tuple[dict[str, Any], ...] = (
        {"tracking_valid": False},
        {"stamp_s": bar.stamp_s - 0.1},
        {"position_world_m": (1.0, math.nan, 0.6)},
    )
    for change in changes:
        assert stream_of(changed(IN_FLIGHT, bar=msgspec.structs.replace(bar, **change))).bar is None


def test_the_position_error_is_that_of_the_metrics_also_of_an_old_frame_in_motion() -> None:
    moving = changed(
        IN_FLIGHT,
        outputs__reference__velocity_world_m_s=(1.0, -0.5, 0.25),
        mocap__stamp_s=IN_FLIGHT[0].t_s - 0.03,
        mocap__latency_s=0.02,
    )
    for row in (*ROWS[300::100], moving):
        if row[1].reference is not None:
            assert stream_of(row).e_p_m == pytest.approx(position_error_m(row[0], row[1]), abs=6e-6)
    at_the_tick = math.dist(moving[0].mocap.position_world_m, moving[1].reference.position_world_m)  # type: ignore[union-attr]
    assert abs((stream_of(moving).e_p_m or 0.0) - at_the_tick) > 0.02


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_the_attitude_error_is_the_angle_to_the_setpoint(axis: tuple[float, float, float]) -> None:
    attitude = quat_from_euler_zyx(0.1, -0.2, 2.0)
    half = math.radians(7.0) / 2.0
    turned = quat_multiply(attitude, (math.cos(half), *(math.sin(half) * a for a in axis)))  # type: ignore[arg-type]
    for sign in (1.0, -1.0):  # both quaternions are the same attitude
        setpoint = AttitudeSetpoint(tuple(sign * c for c in turned), 0.5)  # type: ignore[arg-type]
        stream = stream_of(changed(IN_FLIGHT, mocap__attitude_wxyz=attitude, outputs__attitude=setpoint))
        assert stream.e_q_deg == pytest.approx(7.0, abs=1e-3)


def _states(t_s: float) -> VehicleState:
    state = IN_FLIGHT[0].vehicle
    assert state is not None
    return msgspec.structs.replace(state, position_world_m=(0.5, 0.5, 0.5), position_stamp_s=t_s)


@pytest.mark.parametrize(
    "loss",
    [
        {"mocap": None},
        {"mocap__stamp_s": IN_FLIGHT[0].t_s - 0.11},
        {"mocap__tracking_valid": False},
        {"outputs__mocap_trusted": False},
    ],
)
def test_without_motion_capture_the_pose_is_that_of_px4_and_says_so(loss: dict[str, Any]) -> None:
    stream = stream_of(changed(IN_FLIGHT, vehicle=_states(IN_FLIGHT[0].t_s), **loss))
    assert (stream.pose_from, stream.position_world_m) == ("px4", (0.5, 0.5, 0.5))
    reference = IN_FLIGHT[1].reference
    assert reference is not None
    assert stream.e_p_m == pytest.approx(math.dist((0.5, 0.5, 0.5), reference.position_world_m), abs=6e-6)


def test_without_device_data_every_value_is_none_and_the_lights_are_off() -> None:
    row = changed(
        ROWS[0], vehicle=None, status=None, mocap=None, arm=None, force=None, outputs__reference=None, outputs__attitude=None
    )  # fmt: skip
    stream = stream_of(row)
    assert [health.name for health in stream.lights] == list(Lamp)
    assert (stream.pose_from, stream.position_world_m, stream.e_p_m, stream.e_q_deg) == (None, None, None, None)
    lights = {health.name: health.light for health in stream.lights}
    assert {name for name, light in lights.items() if light is not HealthLevel.OFF} == {"loop", "recorder"}
    with pytest.raises(LookupError):
        StreamBuilder(CONFIG, "s").build(0.0)


BAD_NUMBERS = [math.nan, math.inf, -math.inf, 1e308]


@pytest.mark.parametrize("bad", BAD_NUMBERS)
def test_values_that_are_not_finite_make_a_message_that_every_parser_reads(bad: float) -> None:
    def corrupted(value: Any) -> Any:
        if isinstance(value, float):
            return bad
        if isinstance(value, tuple):
            return tuple(map(corrupted, value))
        if isinstance(value, Record):
            return type(value)(**{name: corrupted(getattr(value, name)) for name in value.__struct_fields__})
        return value

    event = Event(t_s=1.0, id="e", severity=Severity.INFO, action=SafetyAction.NOMINAL, text="text")
    row = changed(IN_FLIGHT, outputs__events=(event,), **tether())
    maker = StreamBuilder(CONFIG, "s")
    maker.add_tick(*IN_FLIGHT)
    maker.add_tick(*(corrupted(record) for record in row))

    def no_constants(text: str) -> Any:
        raise AssertionError(text)

    for topic, record in ((Topic.STREAM, maker.build(1.7e9)), (Topic.EVENTS, maker.events_message())):
        data = json.loads(to_json(record), parse_constant=no_constants)
        jsonschema.Draft202012Validator(schema_of(topic)).validate(data)


def test_timings_are_the_worst_since_the_message_before() -> None:
    def asked(row: Row) -> Row:
        """Every seventh read takes longer."""
        assert row[0].arm is not None
        return changed(row, arm__asked_s=row[0].arm.stamp_s - (0.0009 if row[0].tick % 7 == 0 else 0.0004))

    maker = StreamBuilder(CONFIG, "s")
    timings = []
    rows = [asked(row) for row in ROWS]
    for k, row in enumerate(rows):
        maker.add_tick(*row)
        if k % 10 == 9 or k == len(rows) - 1:
            timings.append(maker.build(0.0).timing)
    whole = timing_of(rows)
    for name, values_s in (
        ("core_ms", whole.core_s),
        ("whole_ms", whole.whole_s),
        ("bus_read_ms", whole.bus_read_s),
        ("lateness_ms", whole.lateness_s),
        ("mocap_to_setpoint_ms", whole.mocap_to_setpoint_s),
        ("joint_read_to_write_ms", whole.joint_read_to_write_s),
    ):
        told = [value for timing in timings if (value := getattr(timing, name)) is not None]
        assert max(told) == pytest.approx(values_s.max() * 1e3, abs=1e-3)
    assert len({timing.lateness_ms for timing in timings}) > 100
    assert stream_of(IN_FLIGHT).timing.bus_read_ms is None


def test_late_ticks_and_lost_records_are_counted() -> None:
    maker = StreamBuilder(CONFIG, "s")
    for k in range(100):
        maker.add_tick(*changed(ROWS[k], sent__lateness_s=0.0051 if k % 20 == 3 else 0.0049))
    stream = maker.build(0.0, dropped=3)
    assert (stream.timing.missed, stream.timing.dropped) == (5, 3)
    assert light_of(stream, "recorder") == (HealthLevel.WARN, "3 records lost")
    maker.add_tick(*changed(ROWS[100], recorder_dropped=7))
    assert maker.build(0.0, dropped=3).timing.dropped == 7
    assert light_of(maker.build(0.0, recorder_error="the disk is full"), "recorder") == (
        HealthLevel.BAD,
        "the disk is full",
    )


def test_the_newest_events_are_kept_and_all_are_counted() -> None:
    maker = StreamBuilder(CONFIG, "s")
    for k in range(EVENTS_KEPT + 30):
        event = Event(t_s=0.1 * k, id=f"e{k}", severity=Severity.WARNING, action=SafetyAction.HOLD, text=f"text {k}")
        maker.add_tick(
            *changed(ROWS[k], outputs__events=(event,), outputs__t_s=0.1 * k + 0.02, outputs__mission_t_s=0.05 * k)
        )
    record = maker.events_message()
    assert record.count == EVENTS_KEPT + 30
    assert [line.id for line in record.lines] == [f"e{k}" for k in range(30, EVENTS_KEPT + 30)]
    assert record.lines[0].mission_t_s == pytest.approx(1.48), "the event is dated back by 20 ms"
    assert (record.lines[-1].severity, record.lines[-1].action) == ("warning", "hold")
    assert decode(Events, to_json(record)) == record


def test_what_repeats_for_ever_pushes_no_event_out() -> None:
    maker = StreamBuilder(CONFIG, "s")
    maker.add_line(1.0, "warning", "px4", "something once")
    for k in range(5 * EVENTS_KEPT):
        maker.add_line(2.0 + k, "warning", "noise", f"the {k}th", replace_last=True)
    assert [line.text for line in maker.events] == ["something once", f"the {5 * EVENTS_KEPT - 1}th"]
    assert maker.count == 5 * EVENTS_KEPT + 1


def test_the_longest_events_fit_into_a_message() -> None:
    maker = StreamBuilder(CONFIG, "s")
    for _ in range(EVENTS_KEPT):
        maker.add_line(1e5 / 3, "critical", "x" * 40, "\N{PILE OF POO}\x00" * TEXT_MAX)
    assert len(to_json(maker.events_message())) <= MESSAGE_MAX_BYTES


def tether(**values: Any) -> dict[str, Any]:
    usual = {"slack_m": 1.0, "stop_slack_m": 0.9, "clearance_m": 0.5}
    return {"outputs__tether": msgspec.structs.replace(SLOW, **{**usual, **values})}


def old(device: str, limit_s: float) -> Callable[[float], dict[str, Any]]:
    """Return a row with a device's data at an age, as a share of its limit."""
    stamps = {"vehicle": ("position_stamp_s", "attitude_stamp_s", "imu_stamp_s")}.get(device, ("stamp_s",))
    return lambda share: {f"{device}__{stamp}": IN_FLIGHT[0].t_s - share * limit_s for stamp in stamps}


@pytest.mark.parametrize(
    ("absent", "name", "text"),
    [
        (["devices.force=null"], "force sensor", "none on this vehicle"),
        (["devices.force=null", "force_source=observer"], "force sensor", "momentum observer"),
        (["tether=null"], "tether", "none on this vehicle"),
    ],
)
def test_an_absent_device_is_shown_as_absent(absent: list[str], name: str, text: str) -> None:
    maker = StreamBuilder(load_flight(CATCH, overrides=[f"vehicle.{key}" for key in absent]), "s")
    maker.add_tick(*changed(IN_FLIGHT, force=None, outputs__tether=None))
    stream = maker.build(1.7e9)
    assert light_of(stream, name) == (HealthLevel.OFF, text)
    assert stream.tether is None and stream.control is not None
    assert (stream.control.force_ext_world_n is None) == (absent == ["devices.force=null"])


AGES = [
    ("PX4", old("vehicle", SAFETY.vehicle_timeout_s)),
    ("motion capture", old("mocap", SAFETY.mocap_timeout_s)),
    ("arm", old("arm", SAFETY.arm_timeout_s)),
    ("force sensor", old("force", SAFETY.force_timeout_s)),
]


@pytest.mark.parametrize(("name", "aged"), AGES)
def test_a_light_warns_from_half_the_age_limit_of_its_device(
    name: str, aged: Callable[[float], dict[str, Any]]
) -> None:
    for share, light in ((0.1, HealthLevel.OK), (0.7, HealthLevel.WARN), (1.1, HealthLevel.BAD)):
        assert light_of(stream_of(changed(IN_FLIGHT, **aged(share))), name)[0] is light


@pytest.mark.parametrize(
    ("name", "values", "light", "text"),
    [
        ("PX4", {}, HealthLevel.OK, "4 ms old, OFFBOARD, armed"),
        ("PX4", {"status": None}, HealthLevel.BAD, "no heartbeat"),
        ("estimate", {"vehicle__position_world_m": (9.0, 0.0, 1.0)}, HealthLevel.BAD, "cm"),
        ("estimate", {"vehicle__attitude_wxyz": quat_from_euler_zyx(0.0, 0.0, 0.3)}, HealthLevel.BAD, "17."),
        ("estimate", {"mocap__tracking_valid": False}, HealthLevel.OFF, "no fresh pose to compare with"),
        ("motion capture", {"mocap__tracking_valid": False}, HealthLevel.BAD, "not tracked"),
        ("motion capture", {"outputs__mocap_trusted": False}, HealthLevel.BAD, "poses are rejected"),
        ("arm", {}, HealthLevel.OK, "31 / 30 degC"),
        ("guardian", {}, HealthLevel.OFF, "no guardian"),
        ("guardian", {"guardian_ready": True}, HealthLevel.OK, "standby"),
        ("guardian", {"guardian_ready": False}, HealthLevel.BAD, "dead"),
        ("battery", {}, HealthLevel.OK, "15.8 V, 90 %"),
        (
            "battery",
            {"status__battery_voltage_v": None, "status__battery_remaining": None},
            HealthLevel.OFF,
            "not reported",
        ),
        ("flight", {}, HealthLevel.OK, "m off the reference"),
        ("flight", {"outputs__phase_kind": PhaseKind.GROUND}, HealthLevel.OFF, "on the ground"),
        ("loop", {"sent__lateness_s": 0.06}, HealthLevel.OK, "60.0 ms late at worst, 1 ticks missed"),
        ("tether", {}, HealthLevel.OFF, "not measured"),
        ("tether", tether(), HealthLevel.OK, "1.00 m left"),
        ("tether", tether(stop_slack_m=0.2), HealthLevel.WARN, "m left"),
    ],
)
def test_a_light_shows_what_is_measured(name: str, values: dict[str, Any], light: HealthLevel, text: str) -> None:
    found = light_of(stream_of(changed(IN_FLIGHT, **values)), name)
    assert found[0] is light and text in found[1], found


def test_the_rate_of_motion_capture_is_counted() -> None:
    maker = StreamBuilder(CONFIG, "s")
    rows = [changed(row, mocap__stamp_s=0.025 * (row[0].tick // 5)) for row in ROWS[:500]]  # 40 Hz
    for row in rows[:100]:
        maker.add_tick(*row)
    assert "Hz" not in light_of(maker.build(0.0), "motion capture")[1]
    for row in rows[100:]:
        maker.add_tick(*row)
    text = light_of(maker.build(0.0), "motion capture")[1]
    assert "40 Hz" in text or "41 Hz" in text


@pytest.mark.parametrize(
    "rule", [rule for rule in RULES if rule.air not in (None, SafetyAction.NOMINAL)], ids=lambda rule: rule.id
)
def test_each_active_rule_turns_its_light_and_no_other(rule: Rule) -> None:
    assert rule.air is not None
    active = ActiveRule(id=rule.id, action=rule.air, text="the text")
    before, after = stream_of(IN_FLIGHT), stream_of(changed(IN_FLIGHT, outputs__active=(active,)))
    level = HealthLevel.BAD if rule.air.rank >= SafetyAction.HOLD.rank else HealthLevel.WARN
    assert light_of(after, rule.lamp) == (level, "the text")
    assert [a.name for a, b in zip(after.lights, before.lights, strict=True) if a != b] == [rule.lamp]


def test_of_two_active_rules_a_light_shows_the_more_severe() -> None:
    mild = ActiveRule(id="battery_warn", action=SafetyAction.WARN, text="mild")
    grave = ActiveRule(id="battery_low", action=SafetyAction.LAND, text="grave")
    for active in ((mild, grave), (grave, mild)):
        assert light_of(stream_of(changed(IN_FLIGHT, outputs__active=active)), "battery") == (HealthLevel.BAD, "grave")


def test_the_worst_lateness_of_the_last_second_is_shown() -> None:
    maker = StreamBuilder(CONFIG, "s")
    seen_s = []
    for k, row in enumerate(ROWS[:600]):
        maker.add_tick(*changed(row, sent__lateness_s=0.06 if k == 200 else 0.0))
        if k % 10 == 9 and "60.0 ms" in light_of(maker.build(0.0), "loop")[1]:
            seen_s.append(row[0].t_s)
    assert 0.9 < seen_s[-1] - seen_s[0] < 1.1


def test_a_flight_that_waits_for_its_start_says_so() -> None:
    assert stream_of(changed(ROWS[0], outputs__phase="waits for start")).waits_for_start


def test_a_log_is_replayed_at_the_rate_of_the_stream_from_its_first_tick_to_its_last() -> None:
    records, events = replay(iter(ROWS), CONFIG, "log", 1.7e9)
    assert [records[0].t_s, records[-1].t_s] == pytest.approx([ROWS[0][0].t_s, ROWS[-1][0].t_s])
    steps_s = [b.t_s - a.t_s for a, b in itertools.pairwise(records)]
    assert steps_s[:-1] == pytest.approx([0.05] * (len(steps_s) - 1), abs=1e-6)
    assert [record.seq for record in records] == list(range(1, len(records) + 1))
    assert records[-1].wall_s == pytest.approx(1.7e9 + ROWS[-1][0].t_s, abs=1e-3)
    assert [line.id for line in events.lines] == [e.id for row in ROWS for e in row[1].events]
    assert {record.session for record in records} == {events.session} == {"log"}


@pytest.mark.parametrize("max_records", [2, 50, 200, 201])
def test_a_long_log_is_replayed_at_a_lower_rate_and_keeps_its_worst_moment(max_records: int) -> None:
    late = [changed(row, sent__lateness_s=0.123) if row[0].tick == 777 else row for row in ROWS]
    records, events = replay(iter(late), CONFIG, "log", 0.0, max_records=max_records)
    assert len(records) <= max_records + 1  # the last tick is added at the end
    assert [records[0].t_s, records[-1].t_s] == pytest.approx([ROWS[0][0].t_s, ROWS[-1][0].t_s])
    assert max(record.timing.lateness_ms for record in records) == pytest.approx(123.0)
    assert events.count == sum(len(row[1].events) for row in ROWS)
    steps_s = [b.t_s - a.t_s for a, b in itertools.pairwise(records)][:-1]
    assert not steps_s or max(steps_s) < 2.5 * (ROWS[-1][0].t_s / max_records)


def test_an_empty_log_is_replayed_to_nothing() -> None:
    assert replay(iter(()), CONFIG, "log", 0.0)[0] == []
