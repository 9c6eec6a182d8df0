from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from msgspec.structs import replace

from companion.analysis import contact_plots, metrics, plot_style, plots
from companion.analysis.log import FlightLog
from companion.analysis.report import write_report
from companion.analysis.summary import summarise, write_summary
from companion.model.outputs import Outputs, Sent
from companion.model.types import Inputs, PhaseKind
from tests.analysis.synthetic_flight import CATCH_S, CONFIG, log_of_rows, synthetic_flight

Row = tuple[Inputs, Outputs, Sent]


@cache
def flown() -> list[Row]:
    """The ticks of `flight`."""
    return list(synthetic_flight())


def made_of(rows: list[Row], config: dict[str, Any] | None = None) -> FlightLog:
    return log_of_rows(rows, config or CONFIG, about={"version_companion": "0.1.0"})


def changed(change: Callable[[Inputs, Outputs, Sent], Row]) -> FlightLog:
    return made_of([change(*row) for row in flown()])


def test_position_rms_is_that_of_mocap_against_the_reference_around_the_catch() -> None:
    def shift(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        if o.reference is None:
            return i, o, s
        x, y, z = o.reference.position_world_m
        off = 0.03 if o.mission_t_s < CATCH_S else 0.05
        return replace(i, mocap=replace(i.mocap, position_world_m=(x + 0.6 * off, y, z - 0.8 * off))), o, s

    summary = summarise(changed(shift), outcome="completed", controller="adaptive", preset="paper")
    assert summary["catch_t_s"] == pytest.approx(CATCH_S)
    assert summary["rms"]["pre"]["e_p_m"] == pytest.approx(0.03)
    assert summary["rms"]["post"]["e_p_m"] == pytest.approx(0.05)
    assert summary["final_e_z_m"] == pytest.approx(-0.04)


def test_a_frame_is_held_against_the_reference_of_its_exposure() -> None:
    """Perfectly followed at 0.5 m/s, seen 3 + 2 ms late: no error."""

    def late(i: Inputs, o: Outputs, s: Sent) -> tuple[Inputs, Outputs, Sent]:
        assert i.mocap is not None
        if o.reference is None:
            return i, o, s
        x, y, z = o.reference.position_world_m
        age_s = i.t_s - i.mocap.stamp_s + (i.mocap.latency_s or 0.0)
        assert age_s == pytest.approx(0.005)
        o = replace(o, reference=replace(o.reference, velocity_world_m_s=(0.5, 0.0, -0.1)))
        return replace(i, mocap=replace(i.mocap, position_world_m=(x - 0.5 * age_s, y, z + 0.1 * age_s))), o, s

    log = changed(late)
    pre, post = metrics.flight_masks(log)
    assert metrics.tracking_rms(log, pre | post).e_p_m == pytest.approx(0.0, abs=1e-9)


def test_a_catch_that_was_noticed_late_counts_from_the_time_it_is_dated() -> None:
    contact_s = next(i.t_s for i, o, _ in flown() if o.mission_t_s >= CATCH_S - 0.25)

    def date_back(i: Inputs, o: Outputs, s: Sent) -> Row:
        events = tuple(replace(event, t_s=contact_s) if event.id == "catch" else event for event in o.events)
        return i, replace(o, events=events), s

    log = changed(date_back)
    caught = metrics.catch_index(log)
    assert caught is not None
    assert log.inputs[caught].t_s == contact_s
    summary = summarise(log, outcome="completed", controller="adaptive", preset="paper")
    event = next(event for event in summary["events"] if event["id"] == "catch")
    assert summary["catch_t_s"] == pytest.approx(CATCH_S - 0.25, abs=0.005)
    assert event["mission_t_s"] == pytest.approx(summary["catch_t_s"])
    pytest.importorskip("pandas")
    events = log.to_pandas()["/events"]
    assert events["mission_t_s"].tolist() == [event["mission_t_s"] for event in summary["events"]]


def test_attitude_and_arm_rms_are_in_degrees_and_wrapped() -> None:
    def turn(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        if o.control is None or i.arm is None or o.reference is None:
            return i, o, s
        half = math.radians(179.0) / 2
        pose = replace(i.mocap, attitude_wxyz=(math.cos(half), 0.0, 0.0, math.sin(half)))
        arm = tuple(a + math.radians(d) for a, d in zip(o.reference.arm_rad, (3.0, -4.0), strict=True))
        control = replace(o.control, attitude_desired_rad=(0.0, 0.0, math.radians(-179.0)))
        return replace(i, mocap=pose, arm=replace(i.arm, angle_rad=arm)), replace(o, control=control), s

    log = changed(turn)
    pre, _ = metrics.flight_masks(log)
    rms = metrics.tracking_rms(log, pre)
    assert rms.e_q_deg == pytest.approx(2.0)
    assert rms.e_alpha_deg == pytest.approx(5.0)


def test_an_estimator_that_praises_itself_changes_no_grade(flight: FlightLog) -> None:
    def flatter(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.vehicle is not None
        where = o.reference.position_world_m if o.reference else (9.0, 9.0, 9.0)
        return replace(i, vehicle=replace(i.vehicle, position_world_m=where)), o, s

    _, post = metrics.flight_masks(flight)
    assert metrics.tracking_rms(changed(flatter), post) == metrics.tracking_rms(flight, post)


def test_stale_or_invalid_mocap_is_not_graded() -> None:
    def lose(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        wrong = replace(i.mocap, position_world_m=(50.0, 0.0, 0.0))
        if 10.0 < o.mission_t_s < 11.0:
            wrong = replace(wrong, tracking_valid=False)
        elif 12.0 < o.mission_t_s < 13.0:
            wrong = replace(wrong, stamp_s=i.t_s - 0.5)
        else:
            wrong = i.mocap
        return replace(i, mocap=wrong), o, s

    log = changed(lose)
    rms = metrics.tracking_rms(log, metrics.flight_masks(log)[1])
    assert rms.e_p_m is not None
    assert rms.e_p_m < 0.05


def test_the_impedance_error_of_a_known_motion_is_what_the_formula_gives() -> None:
    """A sine on x and on joint 2 without force: |M_d s^2 + K_d s + K_p| of the common target; 11.5 s are 5.75 periods."""
    omega, size = 2 * math.pi * 0.5, 0.02

    def swing(i: Inputs, o: Outputs, s: Sent) -> Row:
        if o.control is None:
            return i, o, s
        e, rate = (size * math.sin(omega * o.mission_t_s), size * omega * math.cos(omega * o.mission_t_s))
        still = replace(o.control, force_ext_world_n=(0.0, 0.0, 0.0))
        moved = replace(still, error=(e, 0.0, 0.0, 9.0, 9.0, 9.0, 0.0, e), error_rate=(rate, 0, 0, 9, 9, 9, 0, rate))
        return i, replace(o, control=moved), s

    position_n, arm_nm = metrics.impedance_error(changed(swing))

    def rms(inertia: float, damping: float, stiffness: float) -> float:
        return size * math.hypot(stiffness - inertia * omega**2, damping * omega) / math.sqrt(2.0)

    assert position_n == pytest.approx(rms(1.0, 40.0, 144.0), rel=0.03)
    assert arm_nm == pytest.approx(rms(0.1, 0.7, 1.225), rel=0.03)


def test_a_load_that_stays_is_no_impedance_error_and_an_impact_is() -> None:
    """A payload's weight from t = 7 s on, an arm that does not move: dI is J'(F - F_d), which dies out within seconds."""

    def loaded(i: Inputs, o: Outputs, s: Sent) -> Row:
        if o.control is None:
            return i, o, s
        force = (0.0, 0.0, -2.0 if o.mission_t_s > since_s else 0.0)
        still = replace(o.control, force_ext_world_n=force, error=(0.0,) * 8, error_rate=(0.0,) * 8)
        uneven_s = i.t_s + (0.0 if even else 0.001 * (i.tick % 2))  # as in simulated time: 4 and 6 ms in turn
        return replace(i, t_s=uneven_s), replace(o, control=still), s

    since_s, even = 0.0, True
    _, always_nm = metrics.impedance_error(changed(loaded))
    since_s = 8.0
    _, impact_nm = metrics.impedance_error(changed(loaded))
    assert always_nm is not None
    assert impact_nm is not None
    assert always_nm < 0.01 < impact_nm
    even = False
    assert metrics.impedance_error(changed(loaded))[1] == pytest.approx(impact_nm, rel=1e-3)


def test_the_zero_phase_lowpass_halves_a_sine_at_its_cutoff_and_leaves_slow_ones_in_place() -> None:
    t_s = np.arange(0, 6, 0.005)
    for hz, gain in ((0.5, 1.0), (10.0, 0.5)):
        rows = np.sin(2 * np.pi * hz * t_s)[:, None]
        out = metrics.lowpass_zero_phase(rows, 0.005, 10.0)
        inner = slice(200, -200)
        assert np.allclose(out[inner], gain * rows[inner], atol=4e-3)


def test_what_the_plots_of_a_contact_smooth_is_the_mean_of_a_tenth_of_a_second() -> None:
    """Also in simulated time, in which ticks are 4 and 6 ms apart in turn, and across a gap."""
    t_s = np.delete(np.cumsum(np.tile([0.004, 0.006], 100)), slice(120, 150))
    impulse = np.where(np.arange(len(t_s)) == 100, 1.0, 0.0)
    reached_s = t_s[contact_plots._smooth(impulse, t_s) > 0.0] - t_s[100]
    assert (reached_s[0], reached_s[-1]) == (pytest.approx(-0.05), pytest.approx(0.05))
    impulse = np.where(np.arange(len(t_s)) == 119, 1.0, 0.0)
    reached_s = t_s[contact_plots._smooth(impulse, t_s) > 0.0] - t_s[119]
    assert reached_s[-1] == 0.0


def test_missed_ticks_and_latencies_are_counted_correctly() -> None:
    def slow(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        late_s = 0.006 if i.tick % 1000 == 999 else 0.001
        # Mocap at half the rate of the loop: the second tick of a frame tells nothing about the wire.
        stamp_s = (i.tick - i.tick % 2) * 0.005 - 0.002
        s = replace(
            s, lateness_s=late_s, joint_read_s=i.t_s, current_sent_s=i.t_s + 0.0015, setpoint_sent_s=i.t_s + 0.001
        )
        return replace(i, mocap=replace(i.mocap, stamp_s=stamp_s)), o, s

    summary = summarise(changed(slow), outcome="completed", controller="adaptive", preset="paper")
    assert summary["loop"]["ticks"] == 3001
    assert summary["loop"]["missed"] == 3
    assert summary["loop"]["lateness_ms"]["max"] == pytest.approx(6.0)
    assert summary["loop"]["lateness_ms"]["p50"] == pytest.approx(1.0)
    assert summary["latency_ms"]["joint_read_to_write"]["p99"] == pytest.approx(1.5)
    assert summary["latency_ms"]["mocap_to_setpoint"]["max"] == pytest.approx(3.0)


def test_every_stage_of_a_tick_is_reported_by_its_own_stamps() -> None:
    def staged(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.arm is not None
        # The bus thread writes the currents of a tick 1.2 ms after its start, and begins the read for the next 1.5 ms before that one.
        # Every fourth tick finds no new joint state.
        start_s = i.t_s - 0.0003
        fresh = i.tick - (i.tick % 4 == 3)
        read_s = fresh * 0.005 - 0.0003 - 0.0004
        arm = replace(
            i.arm, asked_s=read_s - 0.0011, stamp_s=read_s, written_s=(fresh - 1) * 0.005 + 0.0012 if fresh else None
        )
        late_s = 0.0001 if i.tick % 2 else 0.0  # the currents are handed over first in every second tick
        s = replace(
            s, start_s=start_s, joint_read_s=i.t_s, core_s=i.t_s + 0.0002, setpoint_sent_s=i.t_s + 0.0004 + late_s,
            current_sent_s=i.t_s + 0.00045, arm_torque_sent_nm=(0.0, 0.0),
        )  # fmt: skip
        return replace(i, arm=arm), o, s

    log = changed(staged)
    stages = summarise(log, outcome="completed", controller="adaptive", preset="paper")["stages_ms"]
    for name, p50, most in (
        ("wait_for_joints", 0.3, 0.3),
        ("core", 0.2, 0.2),
        ("send", 0.25, 0.3),
        ("whole", 0.75, 0.8),
        ("bus_read", 1.1, 1.1),
    ):
        assert stages[name]["p50"] == pytest.approx(p50), name
        assert stages[name]["max"] == pytest.approx(most), name
    # From 1.8 ms before the tick to 1.2 ms after it; a write that is seen a tick too late is none of the read before.
    assert stages["bus_cycle"]["p50"] == pytest.approx(3.0)
    assert len(log.timing.bus_read_s) == sum(i.tick % 4 != 3 for i in log.inputs)


def test_a_log_from_before_reads_were_stamped_shows_the_other_stages(flight: FlightLog) -> None:
    stages = summarise(flight, outcome="completed", controller="adaptive", preset="paper")["stages_ms"]
    assert stages["bus_read"] == stages["bus_cycle"] == {"p50": None, "p99": None, "max": None}
    assert stages["whole"]["max"] >= stages["core"]["max"] > 0.0


def test_the_least_tether_slack_is_that_of_the_attachment_point() -> None:
    def park(i: Inputs, o: Outputs, s: Sent) -> Row:
        assert i.mocap is not None
        # Rolled by 90 degrees: the attachment, 0.1 m above the body's origin, lies at y - 0.1.
        half = math.sqrt(0.5)
        return (
            replace(i, mocap=replace(i.mocap, position_world_m=(-2.0, 4.1, 3.0), attitude_wxyz=(half, half, 0.0, 0.0))),
            o,
            s,
        )

    assert metrics.min_slack_m(changed(park)) == pytest.approx(4.5 - 4.0)


def keys(tree: object) -> object:
    return {k: keys(v) for k, v in tree.items()} if isinstance(tree, dict) else None


def test_every_key_is_there_whatever_is_missing(flight: FlightLog, tmp_path: Path) -> None:
    full = summarise(flight, outcome="completed", controller="adaptive", preset="recommended", payload_kg=0.2)
    bare = [
        (replace(i, mocap=None, arm=None, force=None), replace(o, control=None, reference=None, events=()), s)
        for i, o, s in synthetic_flight(end_s=5.0)
    ]
    options: dict[str, Any] = {"outcome": "lost", "controller": "csc", "preset": "paper"}
    for summary in (
        summarise(None, **options),
        summarise(made_of(bare), **options),
        summarise(made_of(bare[:1], {"vehicle": {}}), **options),
        summarise(dataclasses.replace(flight, inputs=(), outputs=(), sent=()), **options),
    ):
        assert keys(summary) == keys(full)
        write_summary(summary, tmp_path / "summary.json")
        assert json.loads((tmp_path / "summary.json").read_text()) == summary
    caught = [event for event in full["events"] if event["id"] == "catch"]
    assert len(caught) == 1
    assert caught[0].keys() >= {"t_s", "id", "severity", "action"}
    assert full["recorder"] == {"samples": 3001, "dropped": 0, "error": None}


def test_without_a_catch_the_whole_flight_is_before_it() -> None:
    log = made_of([(i, replace(o, events=()), s) for i, o, s in flown()])
    pre, post = metrics.flight_masks(log)
    assert pre.sum() == sum(o.phase_kind is PhaseKind.FLIGHT for o in log.outputs)
    assert not post.any()
    assert metrics.tracking_rms(log, post).e_p_m is None


def test_the_report_is_one_file_with_plots_results_and_events(flight: FlightLog, tmp_path: Path) -> None:
    summary = summarise(flight, outcome="completed", controller="adaptive", preset="recommended", payload_kg=0.2)
    summary["world"] = {"name": "lab", "drawn": {"mass_error": 0.01}, "mass_error": 0.01, "seed": 7, "model_error": 0.2}
    path = write_report(flight, summary, tmp_path)
    page = path.read_text(encoding="utf-8")
    pictures = {p.stem for p in tmp_path.glob("*.png")}
    assert pictures == {"tracking", "actuation", "adaptation", "force", "path", "timing"}
    assert all((tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG") for name in pictures)
    assert page.count("data:image/png;base64,") == len(pictures)
    assert not re.search(r"""(?:src|href)=['"](?!data:)""", page)
    assert f"{summary['rms']['post']['e_p_m']:.4f}" in page
    assert "payload in the net" in page
    assert 'class="verdict' not in page
    assert "world lab, seed 7, model error 20%" in page
    assert "version_" not in page
    assert "numpy" in page


def force_legend(log: FlightLog) -> list[str]:
    figure = plots._force(log)
    assert figure is not None
    legend = figure.axes[0].get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def test_a_payload_estimate_is_drawn_as_its_weight_and_only_if_there_is_one() -> None:
    def estimate(i: Inputs, o: Outputs, s: Sent) -> Row:
        if o.control is None:
            return i, o, s
        return i, replace(o, control=replace(o.control, payload_estimate_kg=0.2 if o.mission_t_s > 7.0 else 0.0)), s

    log = changed(estimate)
    assert force_legend(log)[3:] == ["weight of the estimated payload"]
    figure = plots._force(log)
    assert figure is not None
    line = next(line for line in figure.axes[0].get_lines() if line.get_label() == "weight of the estimated payload")
    drawn = np.asarray(line.get_ydata())
    assert np.nanmin(drawn) == pytest.approx(-0.2 * 9.81, rel=1e-3)
    assert np.nanmax(drawn) == pytest.approx(0.0)
    assert len(force_legend(changed(lambda i, o, s: (i, o, s)))) == 3


def test_the_report_of_a_flight_that_hardly_began_is_written_all_the_same(tmp_path: Path) -> None:
    i, o, s = next(synthetic_flight(end_s=0.0))
    log = made_of([(replace(i, mocap=None, arm=None), replace(o, control=None), s)])
    summary = summarise(log, outcome="aborted", controller="adaptive", preset="<b>mine</b>")
    actions = {"warn": "<i>", "hold": "mocap lost", "autopilot_land": "mocap lost for long", "land": "low battery"}
    summary["events"] = [
        {"mission_t_s": 1.0, "id": "made_up", "severity": "warning", "action": action, "text": text}
        for action, text in actions.items()
    ]
    page = write_report(log, summary, tmp_path).read_text(encoding="utf-8")
    assert "aborted" in page
    assert re.findall(r'class="verdict not"><p>(.*?)</p>', page) == ["mocap lost for long"]
    assert "<b>mine</b>" not in page


@pytest.mark.parametrize("size_m", [(2.0, 0.02, 1.0), (0.02, 0.02, 1.0), (9.0, 2.0, 1.0), (1.0, 6.0, 3.0)])
def test_a_path_is_drawn_whole_and_to_one_scale(size_m: tuple[float, float, float]) -> None:
    figure = plot_style.new_figure(5.2)
    panes = plot_style.path_panes(figure)
    corners_m = np.array(list(product((-0.5, 0.5), repeat=3))) * size_m + np.array((1.0, 2.0, 3.0))
    plot_style.scale_path(panes, corners_m, np.full((1, 3), np.nan))
    FigureCanvasAgg(figure).draw()
    for ax, row in panes:
        pixels = ax.transData.transform(corners_m[:, [0, row]])
        per_m = np.ptp(pixels, axis=0) / (size_m[0], size_m[row])
        assert per_m[0] == pytest.approx(per_m[1], rel=1e-6)
        assert per_m[0] == pytest.approx(np.ptp(panes[0][0].transData.transform([[0, 0], [1, 0]])[:, 0]), rel=1e-6)
        assert all(ax.bbox.contains(*pixel) for pixel in pixels)
        assert ax.bbox.width > 0.8 * figure.bbox.width
