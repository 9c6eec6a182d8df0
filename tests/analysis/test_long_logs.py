"""A log of an hour is graded in little memory: thinned-out ticks, but the timing of all of them."""

from __future__ import annotations

import json
import select
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from companion.analysis import tables
from companion.analysis.export import write_lerobot, write_tables
from companion.analysis.hover_fit import fit_hover_thrust
from companion.analysis.log import TICKS_KEPT, FlightLog, Row, _Rows
from companion.analysis.metrics import catch_index
from companion.analysis.replay import replay
from companion.analysis.report import write_report
from companion.analysis.summary import summarise
from companion.cli.main import main
from companion.commissioning.identify import samples
from companion.launcher.run import TICKS_MAX
from companion.model.exit_codes import EXIT_OK
from companion.model.outputs import Outputs
from companion.model.types import Inputs
from companion.recorder.client import RecorderProcess
from companion.recorder.viewer_file import write_viewer_file
from tests.analysis.synthetic_flight import CONFIG, record_flight, synthetic_flight

TICKS = 350


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    record_flight(path, rate_hz=100.0)
    return path


@pytest.fixture(scope="module")
def whole(path: Path) -> FlightLog:
    return FlightLog.read(path)


@pytest.fixture(scope="module")
def thin(path: Path) -> FlightLog:
    return FlightLog.read(path, ticks_max=TICKS)


def test_so_many_ticks_are_kept_evenly_spread(whole: FlightLog, thin: FlightLog) -> None:
    assert len(whole.inputs) > 4 * TICKS
    assert TICKS / 2 <= len(thin.inputs) <= TICKS + 10
    assert thin.stride > 1
    regular = [inputs.tick for inputs in thin.inputs if inputs.tick % thin.stride == 0]
    assert regular == list(range(0, whole.inputs[-1].tick + 1, thin.stride))


def test_every_event_is_kept_and_so_is_the_outcome(whole: FlightLog, thin: FlightLog) -> None:
    def told(log: FlightLog) -> list[tuple[float, str]]:
        return [(event.t_s, event.id) for outputs in log.outputs for event in outputs.events]

    assert told(thin) == told(whole)
    assert [o.outcome for o in thin.outputs if o.outcome] == [o.outcome for o in whole.outputs if o.outcome]


@pytest.mark.parametrize("name", ["outcome", "events"])
def test_many_ticks_with_an_outcome_or_events_are_looked_at_a_few_times_each(
    name: str, whole: FlightLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stride that grew at each of these ticks went through all kept ticks each time."""
    ticks, looks, keep = 10 * TICKS, 0, _Rows._keep

    def counted(rows: _Rows, row: Row) -> None:
        nonlocal looks
        looks += 1
        keep(rows, row)

    monkeypatch.setattr(_Rows, "_keep", counted)
    special = next(o for o in whole.outputs if getattr(o, name))
    special = special if name == "events" else replace(special, events=())
    rows = _Rows(TICKS, None)
    for tick in range(ticks):
        rows.take((replace(whole.inputs[0], tick=tick), special, whole.sent[0]))
    assert looks < 10 * ticks
    assert rows.stride == 16
    kept = [inputs.tick for inputs, _, _ in rows.with_the_last()]
    assert kept == (list(range(ticks)) if name == "events" else [*range(0, ticks, 16), ticks - 1])


def test_timing_is_that_of_every_tick(whole: FlightLog, thin: FlightLog) -> None:
    one, other = whole.timing, thin.timing
    for name in ("lateness_s", "joint_read_to_write_s", "mocap_to_setpoint_s", "core_s", "whole_s"):
        assert len(getattr(one, name)) > 100
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert (one.ticks, one.first_tick, one.last_tick, one.span_s) == (
        *(other.ticks, other.first_tick, other.last_tick, other.span_s),
    )
    assert thin.missing_ticks() == 0


def test_the_summary_says_that_it_is_thinned_out_and_grades_nearly_the_same(whole: FlightLog, thin: FlightLog) -> None:
    of_all, of_some = (
        summarise(log, outcome="completed", controller="adaptive", preset="recommended") for log in (whole, thin)
    )
    assert (of_all["graded_every"], of_some["graded_every"]) == (1, thin.stride)
    for key in ("loop", "latency_ms", "events", "recorder"):
        assert of_all[key] == of_some[key]
    assert of_some["impedance_error"] == {"position_n": None, "arm_nm": None}
    for part in ("pre", "post"):
        assert of_some["rms"][part]["e_p_m"] == pytest.approx(of_all["rms"][part]["e_p_m"], rel=0.1)
    assert catch_index(thin) is not None
    json.dumps(of_some, allow_nan=False)


def test_a_replay_compares_every_tick_of_a_thinned_out_log(whole: FlightLog, thin: FlightLog) -> None:
    thinned_out = 4 * thin.stride + 1
    assert thinned_out not in [inputs.tick for inputs in thin.inputs]

    class Recited:
        """A core that returns what was flown, but for one tick."""

        def __init__(self, other_tick: int) -> None:
            self._other_tick = other_tick

        def step(self, inputs: Inputs) -> Outputs:
            outputs = whole.outputs[inputs.tick]
            return outputs if inputs.tick != self._other_tick else replace(outputs, phase="another")

    same = replay(thin, lambda _: Recited(-1))
    assert (same.ticks, same.first_difference) == (len(whole.inputs), None)
    other = replay(thin, lambda _: Recited(thinned_out)).first_difference
    assert other is not None
    assert (other.tick, other.field) == (thinned_out, "phase")


def test_the_hover_thrust_is_fitted_to_every_tick_of_a_thinned_out_log(whole: FlightLog, thin: FlightLog) -> None:
    assert fit_hover_thrust(thin) == fit_hover_thrust(whole)


@pytest.mark.parametrize("form", ["csv", "parquet", "lerobot", "foxglove"])
def test_an_export_holds_every_tick_of_a_thinned_out_log(
    whole: FlightLog, thin: FlightLog, form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(tables, "_PIECE_ROWS", TICKS // 3)
    written: dict[str, dict[str, bytes]] = {}
    for name, log in (("whole", whole), ("thin", thin)):
        out = tmp_path / name
        out.mkdir()
        match form:
            case "lerobot":
                write_lerobot([log], out)
            case "foxglove":
                write_viewer_file({"A": log}, out / "both.mcap")
            case _:
                write_tables(log, out, form)
        written[name] = {str(file.relative_to(out)): file.read_bytes() for file in out.rglob("*") if file.is_file()}
    assert written["thin"] == written["whole"]


def test_identification_reads_the_ticks_around_the_catch_of_a_long_flight(
    path: Path, whole: FlightLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(samples, "TICKS_KEPT", TICKS)
    log, part = samples.read_part(path)
    caught = catch_index(whole)
    assert caught is not None
    assert part == range(caught - TICKS // 2, caught - TICKS // 2 + TICKS)
    assert list(log.rows())[:TICKS] == list(whole.rows())[part.start : part.stop]
    assert (len(log.inputs) - len(part), log.outputs[-1].outcome) == (1, whole.outputs[-1].outcome)
    assert catch_index(log) == TICKS // 2


@pytest.mark.parametrize(
    "command", ["hover fit", "export --format csv", "export --format lerobot", "export --format foxglove"]
)
def test_the_commands_keep_a_part_of_a_long_log_in_memory(
    command: str, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow")
    limits: list[int | None] = []

    def read(path: Path, *, ticks_max: int | None = None) -> FlightLog:
        limits.append(ticks_max)
        return read_log(path, ticks_max=TICKS)

    read_log = FlightLog.read
    monkeypatch.setattr(FlightLog, "read", staticmethod(read))
    out = () if command == "hover fit" else ("--out", str(tmp_path / "out"))
    assert main([*command.split(), str(path), *out]) == EXIT_OK
    assert limits == [TICKS_KEPT]


@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_long_flight_names_the_share_of_ticks_kept(thin: FlightLog, tmp_path: Path) -> None:
    summary = summarise(thin, outcome="completed", controller="adaptive", preset="recommended")
    assert f"one in {thin.stride} (long flight)" in write_report(thin, summary, tmp_path).read_text()


def test_a_log_that_fits_is_read_whole(path: Path, whole: FlightLog) -> None:
    read = FlightLog.read(path, ticks_max=TICKS_MAX)
    assert (read.stride, read.measured) == (1, None)
    assert read.inputs == whole.inputs


def test_a_thinned_out_log_counts_the_ticks_that_the_recorder_dropped(tmp_path: Path) -> None:
    gap = tmp_path / "gap.mcap"
    recorder = RecorderProcess.start(gap, config_json=json.dumps(CONFIG), epoch_offset_ns=1_700_000_000_000_000_000)
    for inputs, outputs, sent in synthetic_flight(end_s=6.0):
        if not 100 <= inputs.tick < 103:
            select.select([], [recorder.client], [], 60.0)
            recorder.client.record(inputs, outputs, sent)
    assert recorder.finish(60.0).error is None
    thin = FlightLog.read(gap, ticks_max=TICKS)
    assert thin.stride > 1
    assert thin.missing_ticks() == 3
