"""Logs of an arm with any number of joints, and of a vehicle without one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from companion.analysis import metrics
from companion.analysis.animation import movie_of
from companion.analysis.log import FlightLog
from companion.analysis.plots import write_plots
from companion.analysis.summary import summarise
from tests.analysis.synthetic_flight import CONFIG, log_of_rows, synthetic_flight, with_joints
from tests.machines import vehicle_with_joints

SIMULATED = {"payload_kg": 0.2, "world": {"throw_velocity_m_s": [0.0, -1.5, 0.5]}}


def flight(count: int, rate_hz: float = 20.0) -> FlightLog:
    rows = [with_joints(row, count) for row in synthetic_flight(rate_hz=rate_hz)]
    vehicle = {**CONFIG["vehicle"], **json.loads(vehicle_with_joints(count).model_dump_json())}
    return log_of_rows(rows, {**CONFIG, "vehicle": vehicle})


@pytest.mark.parametrize("count", [0, 1, 4])
def test_summary_and_animation_have_as_many_joints_as_the_flight(count: int) -> None:
    log = flight(count)
    assert (log.joint_count, log.columns.arm_rad.shape[1]) == (count, count)
    summary = summarise(log, outcome="completed", controller="adaptive", preset="recommended")
    graded = [summary["rms"]["pre"]["e_alpha_deg"], summary["impedance_error"]["arm_nm"]]
    assert [value is not None for value in graded] == [count > 0] * 2
    assert summary["rms"]["pre"]["e_p_m"] is not None and summary["impedance_error"]["position_n"] is not None
    movie = movie_of(log, SIMULATED)
    assert movie is not None
    named = {shape.text for shape in movie.axes}
    assert ("arm error [deg]" in named) == (count > 0)


@pytest.mark.parametrize("count", [0, 4])
def test_plots_show_every_joint_and_no_joint_of_an_absent_arm(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, list[str]] = {}

    def keep(figure: object, path: Path) -> None:
        drawn[path.stem] = [str(line.get_label()) for ax in figure.axes for line in ax.lines]  # type: ignore[attr-defined]

    monkeypatch.setattr("companion.analysis.plot_style.write_png", keep)
    write_plots(flight(count), tmp_path)
    angles = [label for label in drawn["tracking"] if "alpha" in label and "reference" not in label]
    sent = [label for label in drawn["actuation"] if label.endswith("sent")]
    assert angles == [rf"$\alpha_{j + 1}$" for j in range(count)]
    assert sent == [f"joint {j + 1} sent" for j in range(count)]


def test_the_error_of_every_joint_counts() -> None:
    log = flight(4)
    error = metrics.arm_error_rad(log)
    known = error[np.isfinite(error).all(axis=1)]
    expected = np.degrees(np.sqrt(np.mean(np.sum(known**2, axis=1))))
    assert metrics.tracking_rms(log, np.full(len(error), True)).e_alpha_deg == pytest.approx(expected)
