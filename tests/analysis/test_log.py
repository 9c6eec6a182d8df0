"""Logs are read back bit for bit, also cut or by another version, as data frames and in a replay; what is no log is refused."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace

from companion.analysis.log import FlightLog, LogError
from companion.analysis.replay import replay
from companion.model.codec import differences
from companion.model.outputs import Outputs
from companion.model.types import Inputs
from tests.analysis.synthetic_flight import CONFIG, record_flight, synthetic_flight
from tests.support import ROOT


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    """The beginning of `flight`, into the take-off."""
    path = tmp_path_factory.mktemp("brief") / "flight.mcap"
    record_flight(path, end_s=2.0)
    return FlightLog.read(path)


def test_a_log_gives_back_every_record_bit_for_bit(flight: FlightLog) -> None:
    rows = list(synthetic_flight())
    assert len(flight.inputs) == len(rows)
    for logged, row in zip(flight.rows(), rows, strict=True):
        assert differences(logged, row) is None
    assert flight.closed
    assert flight.end_missing is None
    assert flight.config == CONFIG
    assert flight.missing_ticks() == 0


def test_a_log_as_data_frames_holds_every_field_of_every_tick(flight: FlightLog) -> None:
    pytest.importorskip("pandas")
    frames = flight.to_pandas()
    for number in (0, len(flight.inputs) // 2, -1):
        inputs, outputs, sent = flight.inputs[number], flight.outputs[number], flight.sent[number]
        assert inputs.mocap is not None
        row = frames["/inputs"].iloc[number]
        assert row.name == inputs.t_s
        assert tuple(row[f"mocap.position_world_m[{axis}]"] for axis in range(3)) == inputs.mocap.position_world_m
        assert frames["/outputs"].iloc[number]["mission_t_s"] == outputs.mission_t_s
        assert frames["/sent"].iloc[number]["lateness_s"] == sent.lateness_s
    absent = [outputs.reference is None for outputs in flight.outputs]
    assert frames["/outputs"]["reference.position_world_m[2]"].isna().tolist() == absent
    events = [event for outputs in flight.outputs for event in outputs.events]
    assert frames["/events"].index.tolist() == [event.t_s for event in events]
    assert frames["/events"]["severity"].tolist() == [event.severity.value for event in events]


def test_the_example_of_the_page_on_logs_runs(flight: FlightLog, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pandas")
    (example,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs/logs.md").read_text(encoding="utf-8"), re.M | re.S)
    exec(example.replace("flights/A/flight.mcap", str(flight.path)), {})
    assert re.match(r"largest height error \d\.\d{4} m\n", capsys.readouterr().out)


def test_the_notebook_plots_error_and_force_around_the_catch(
    flight: FlightLog, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pandas")
    plt = pytest.importorskip("matplotlib.pyplot")
    notebook = json.loads((ROOT / "examples/notebook/flight.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in cells), "saved with its results"
    monkeypatch.chdir(flight.path.parent)
    plt.switch_backend("agg")
    names: dict[str, Any] = {}
    for cell in cells:
        exec("".join(cell["source"]), names)
    axes = names["figure"].axes
    plt.close(names["figure"])
    i = next(i for i, o in enumerate(flight.outputs) for event in o.events if event.id == "catch") + 100
    mocap, reference, control = flight.inputs[i].mocap, flight.outputs[i].reference, flight.outputs[i].control
    assert mocap is not None and reference is not None and control is not None
    at_s = flight.inputs[i].t_s - names["catch_s"]
    for k in range(3):
        error_mm = 1e3 * (mocap.position_world_m[k] - reference.position_world_m[k])
        for lines, expected in ((axes[0].lines, error_mm), (axes[1].lines, control.force_ext_world_n[k])):
            assert np.interp(at_s, *lines[k].get_data()) == pytest.approx(expected, abs=1e-9)
    assert re.match(r"largest position error \d+\.\d mm at .*\nlargest force \d+\.\d N\n", capsys.readouterr().out)


def test_without_pandas_one_line_says_what_to_install(flight: FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(LogError, match=r"^to_pandas: needs pandas: pip install '.*\[pandas\]'$"):
        flight.to_pandas()


def test_a_log_cut_anywhere_is_read_up_to_its_last_whole_chunk(flight: FlightLog, tmp_path: Path) -> None:
    data = flight.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    for share in (0.3, 0.501, 0.77, 0.9999):
        cut.write_bytes(data[: int(share * len(data))])
        log = FlightLog.read(cut)
        assert not log.closed
        last = f"its last whole tick is at t = {log.inputs[-1].t_s:.3f} s"
        assert log.end_missing == (
            f"the log was not closed: {last}, the outcome is in it"
            if share > 0.999
            else f"the log ends before the flight did: {last}, the outcome is not in it"
        )
        assert len(log.inputs) > 0.25 * len(flight.inputs)
        assert log.inputs == flight.inputs[: len(log.inputs)]
        assert len(log.outputs) == len(log.sent) == len(log.inputs)


def test_a_log_whose_first_bytes_are_all_that_is_left_has_no_ticks_or_is_refused(
    flight: FlightLog, tmp_path: Path
) -> None:
    data, cut, ends = flight.path.read_bytes(), tmp_path / "cut.mcap", set()
    for size in (1, 7, 8, 9, 100, 1000, 5000, 20_000):
        cut.write_bytes(data[:size])
        try:
            log = FlightLog.read(cut)
            ends.add(log.end_missing)
        except LogError as error:
            ends.add(str(error).removeprefix(f"{cut}: "))
    assert ends == {
        "not a flight log, or cut off at its beginning: it has no 'companion' metadata record",
        "the log was not closed and has no ticks",
    }


def test_a_file_that_is_no_flight_log_is_refused_in_one_line(flight: FlightLog, tmp_path: Path) -> None:
    text, empty, foreign, damaged = (tmp_path / name for name in ("a.txt", "empty", "foreign.mcap", "damaged.mcap"))
    text.write_text("not a log, but long enough to look at")
    empty.touch()
    with foxglove.open_mcap(foreign, context=foxglove.Context()) as writer:
        writer.write_metadata("someone", {"else": "1"})
    data = bytearray(flight.path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    damaged.write_bytes(data)
    for path, reason in (
        (tmp_path / "absent", "No such file"),
        (tmp_path, "is a folder"),
        (text, "not an MCAP file"),
        (empty, "is empty"),
        (foreign, "not a flight log"),
        (damaged, "damaged"),
    ):
        with pytest.raises(LogError) as refusal:
            FlightLog.read(path)
        assert str(refusal.value).startswith(f"{path}: "), refusal.value
        assert reason in str(refusal.value)
        assert "\n" not in str(refusal.value)


def rewritten(source: Path, target: Path, message: Callable[[str, dict[str, Any]], None], records: str) -> Path:
    """A log as a version with other records would have written it: each tick's data changed, and another fingerprint."""
    with source.open("rb") as file, target.open("wb") as out:
        reader, writer = make_reader(file), Writer(out)
        writer.start()
        for record in reader.iter_metadata():
            known = dict(record.metadata)
            writer.add_metadata(record.name, {**known, "records": records} if record.name == "companion" else known)
        channels: dict[str, int] = {}
        for schema, channel, row in reader.iter_messages(topics=["/inputs", "/outputs", "/sent"]):
            assert schema is not None
            if channel.topic not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", schema_id)
            data = json.loads(row.data)
            message(channel.topic, data)
            writer.add_message(
                channels[channel.topic],
                row.log_time,
                json.dumps(data, separators=(",", ":")).encode(),
                row.publish_time,
            )
        writer.finish()
    return target


def test_the_former_names_of_events_are_read_as_todays(brief: FlightLog, tmp_path: Path) -> None:
    former = ("reattached", "called_off", "arm_let_go")

    def renamed(topic: str, data: dict[str, Any]) -> None:
        if topic == "/outputs" and data.get("events"):
            data["events"] = [{**data["events"][0], "id": name} for name in former]

    log = FlightLog.read(rewritten(brief.path, tmp_path / "older.mcap", renamed, "0" * 16))
    ids = {event.id for outputs in log.outputs for event in outputs.events}
    assert ids == {"armed_externally", "takeoff_cancelled", "servo_watchdog_tripped"}


def test_a_log_from_before_a_field_that_may_be_none_opens_but_is_not_replayed(brief: FlightLog, tmp_path: Path) -> None:
    """`None` is left out of a log, so the ticks of such a log are those of today; what the core makes of them is not."""

    def same(topic: str, data: dict[str, Any]) -> None:
        assert "payload_estimate_kg" not in data.get("control", {})
        if topic == "/outputs":
            data["bent_by"] = data.pop("limited_by")

    log = FlightLog.read(rewritten(brief.path, tmp_path / "older.mcap", same, "0" * 16))
    assert log.outputs == brief.outputs
    with pytest.raises(
        LogError,
        match=r"^[^\n]*the fields of its records differ from those of this version[^\n]*replay it with that version$",
    ):
        replay(log, lambda _: Recited(log.outputs))


@pytest.mark.parametrize(
    ("field", "reason"), [("zeta", "missing required field `zeta`"), ("news", "unknown field `news`")]
)
def test_a_log_with_records_of_another_shape_is_refused_in_one_line(
    brief: FlightLog, tmp_path: Path, field: str, reason: str
) -> None:
    def change(topic: str, data: dict[str, Any]) -> None:
        if "control" in data:
            data["control"].pop(field, None)
            if field == "news":
                data["control"]["news"] = 1.0

    path = rewritten(brief.path, tmp_path / "other.mcap", change, "0" * 16)
    with pytest.raises(LogError) as refusal:
        FlightLog.read(path)
    assert str(refusal.value).startswith(f"{path}: its records' fields differ from this version's (Outputs: ")
    assert "at `$.control`" in str(refusal.value)
    assert reason in str(refusal.value)
    assert "written by companion " in str(refusal.value)
    assert "\n" not in str(refusal.value)


class Recited:
    """A core that gives back what was flown, but for one field of one tick."""

    def __init__(self, outputs: tuple[Outputs, ...], corrupt: Callable[[Outputs], Outputs] = lambda o: o) -> None:
        self._outputs = iter(outputs)
        self._corrupt = corrupt

    def step(self, inputs: Inputs) -> Outputs:
        return self._corrupt(next(self._outputs))


def test_replay_compares_every_tick_and_names_the_first_bit_that_differs(flight: FlightLog) -> None:
    configs: list[str] = []

    def same(config_json: str) -> Recited:
        configs.append(config_json)
        return Recited(flight.outputs)

    result = replay(flight, same)
    assert (result.ticks, result.first_difference) == (len(flight.inputs), None)
    assert json.loads(configs[0]) == CONFIG

    def corrupt(o: Outputs) -> Outputs:
        if o.tick < 1500 or o.control is None:
            return o
        h = o.control.h_hat
        return replace(o, control=replace(o.control, h_hat=(h[0], h[1], math.nextafter(h[2], 1.0), h[3])))

    result = replay(flight, lambda _: Recited(flight.outputs, corrupt))
    difference = result.first_difference
    assert difference is not None
    assert (difference.tick, difference.field) == (1500, "control.h_hat[2]")
    logged = flight.outputs[1500].control
    assert logged is not None
    assert difference.logged == logged.h_hat[2]
    assert difference.recomputed == math.nextafter(logged.h_hat[2], 1.0)


def test_a_log_that_cannot_be_replayed_says_why_in_one_line(flight: FlightLog) -> None:
    gap = dataclasses.replace(
        flight,
        inputs=flight.inputs[:100] + flight.inputs[103:],
        outputs=flight.outputs[:100] + flight.outputs[103:],
        sent=flight.sent[:100] + flight.sent[103:],
    )
    late = dataclasses.replace(flight, inputs=flight.inputs[5:], outputs=flight.outputs[5:], sent=flight.sent[5:])
    older = dataclasses.replace(flight, metadata={**flight.metadata, "companion": {"version_companion": "0.0.1"}})
    bare = dataclasses.replace(flight, metadata={"companion": flight.metadata["companion"]})
    empty = dataclasses.replace(flight, inputs=(), outputs=(), sent=())

    def refuse(config_json: str) -> Recited:
        raise ValueError("field x is unknown\nmore lines")

    for log, make, reason in (
        (gap, refuse, "3 of 3001 ticks are missing"),
        (late, refuse, "the first 5 ticks are missing"),
        (older, refuse, "recorded by companion 0.0.1"),
        (bare, refuse, "has no configuration"),
        (empty, refuse, "has no ticks"),
        (flight, refuse, "field x is unknown"),
    ):
        with pytest.raises(LogError) as refusal:
            replay(log, make)
        assert reason in str(refusal.value)
        assert "\n" not in str(refusal.value)
