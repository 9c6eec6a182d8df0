"""Report of two vehicles that carry a bar: what the bar does, an animation of both, and the report of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.animation import (
    FLYING,
    FRAMES_PER_S,
    HEIGHT,
    SPLIT_PX,
    Frame,
    Movie,
    Track,
    labels,
    player_html,
    plot_x,
    plotted,
)
from companion.analysis.log import Array, FlightLog
from companion.analysis.page import Page, Section, write_page
from companion.analysis.pair import BarSample, BarTruth, Course, bar_errors, carried, figure_texts
from companion.analysis.plot_style import SERIES, SOFT, dress, new_figure, write_pictures
from companion.analysis.scene import FRAME, Camera, Scene, Shape
from companion.analysis.table import Table, pairs
from companion.analysis.time_axes import legend, line
from companion.model.frames import quat_rotate
from companion.model.logged_geometry import logged_bar_length_m

_SHOWN_S = 16.0
"""Duration of the animation at most; a longer flight is shown faster."""
_BAR_RADIUS_M = 0.012


def write_pair_report(
    summary: Mapping[str, Any], truth: BarTruth, left: FlightLog, right: FlightLog, out: Path
) -> Path:
    """Write report.html and its plot into the folder of the team's flight, and return the path of report.html.

    Args:
        out: folder of the flight; the report of each vehicle is in a folder of its own there.
    """
    sides = Course(left, truth), Course(right, truth)
    samples = list(carried(truth, *sides))
    rows = [bar_errors(s.position_world_m, s.attitude_wxyz, s.pulls_world_n, planned) for s, planned in samples]
    errors = np.array(rows, dtype=np.float64).reshape(-1, 3)
    t_s = np.array([sample.t_s for sample, _ in samples]) - _mission_start_s(sides[0])
    figure = None if not samples else _bar_figure(t_s, errors, [sample for sample, _ in samples])
    caption = "True state of the bar while both vehicles carry it, by the left vehicle's mission time."
    movie = _movie(truth, sides, t_s, errors)
    members = summary["members"]
    page = Page(
        summary["name"],
        "two vehicles and a bar",
        [
            Section("", cards=[pairs("The bar", figure_texts(summary["team"])), _members(members)]),
            Section("Plots", pictures=write_pictures([("bar", "The bar", caption, figure)], out)),
        ],
        badge=str(summary["outcome"]),
        good=False,
        links=[(f"the {end} vehicle", f"{end}/report.html") for end in members if (out / end / "report.html").exists()],
        player_html="" if movie is None else player_html(movie),
        width_rem=62,
    )
    path = out / "report.html"
    write_page(page, path)
    return path


def _members(members: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = []
    for end, member in members.items():
        error_m = (member["rms"].get("pre") or {}).get("e_p_m")
        rows.append((end, str(member["outcome"]), "–" if error_m is None else f"{error_m:.4f} m"))
    return pairs("The vehicles", rows, "outcome", "‖e_p‖, RMS")


def _bar_figure(t_s: Array, errors: Array, samples: list[BarSample]) -> Any:
    figure = new_figure(6.0)
    axes = figure.subplots(4, 1, sharex=True)
    lifts_n = np.array([[pull[2] for pull in sample.pulls_world_n] for sample in samples])
    for ax, (name, lines) in zip(
        axes,
        (
            ("position error [m]", [("", errors[:, 0])]),
            ("tilt [deg]", [("", np.degrees(errors[:, 1]))]),
            ("stretching force [N]", [("", errors[:, 2])]),
            ("lift [N]", [("left", lifts_n[:, 0]), ("right", lifts_n[:, 1])]),
        ),
        strict=True,
    ):
        dress(ax)
        ax.set_ylabel(name)
        for colour, (who, values) in zip(SERIES, lines, strict=False):
            line(ax, t_s, values, who, colour)
        if len(lines) > 1:
            legend(ax, columns=2)
        elif name.startswith(("tilt", "stretching")):
            ax.axhline(0.0, color=SOFT, lw=0.8)
    axes[-1].set_xlabel("mission time [s]")
    return figure


def _mission_start_s(side: Course) -> float:
    """Return the time of the world at which a vehicle's mission begins, which is 0 of its mission time."""
    return next((t - o.mission_t_s for t, o in zip(side.times_s, side.log.outputs, strict=True) if o.mission_t_s), 0.0)


def _movie(truth: BarTruth, sides: tuple[Course, Course], t_s: Array, errors: Array) -> Movie | None:
    """Return the animation of both; None if one of them has not flown, or its geometry was not logged."""
    flying = [[t for t, o in zip(s.times_s, s.log.outputs, strict=True) if o.phase_kind in FLYING] for s in sides]
    if not all(flying) or not truth.samples:
        return None
    try:
        scenes = [Scene(side.log.config["vehicle"]) for side in sides]
    except (KeyError, ValueError):
        return None
    if any(scene.joint_count != side.log.joint_count for scene, side in zip(scenes, sides, strict=True)):
        return None
    length_m = logged_bar_length_m(sides[0].log.config)
    if length_m is None:
        return None
    first_s, last_s = min(times[0] for times in flying), max(times[-1] for times in flying)
    start_s = _mission_start_s(sides[0])
    span_s = first_s - start_s, last_s - start_s
    tracks = [Track(side.log, scene, None, None) for side, scene in zip(sides, scenes, strict=True)]
    rows = [("bar, position error [cm]", 100.0 * errors[:, 0]), ("bar, tilt [deg]", np.degrees(np.abs(errors[:, 1])))]
    axes, curves = plotted(span_s, t_s, rows, np.ones(len(t_s), dtype=bool)) if len(t_s) else ([], [])
    speed = max(1.0, (last_s - first_s) / _SHOWN_S)
    bar_s, frames, target = [sample.t_s for sample in truth.samples], [], None
    for now_s in np.arange(first_s, last_s, speed / FRAMES_PER_S):
        ticks = [min(max(int(np.searchsorted(side.times_s, now_s)), 0), len(side.times_s) - 1) for side in sides]
        poses = [track.pose(tick) for track, tick in zip(tracks, ticks, strict=True)]
        bar = truth.samples[min(int(np.searchsorted(bar_s, now_s)), len(bar_s) - 1)]
        places = np.array([pose.position_world_m for pose in poses])
        centre = places.mean(axis=0) + np.array([0.0, 0.0, -0.2])
        target = centre if target is None else target + 0.25 * (centre - target)
        camera = Camera(target, math.radians(205.0), math.radians(14.0), 6.0, (SPLIT_PX, HEIGHT), view_m=3.6)
        far, near = sorted((0, 1), key=lambda n: -camera.depth_m(places[n]))
        shapes = scenes[far].shapes(camera, poses[far])
        shapes += [_bar_shape(camera, bar, length_m), *scenes[near].shapes(camera, poses[near], room=False)]
        shapes += labels(sides[0].log.outputs[ticks[0]].phase, now_s - start_s, speed)
        frames.append(Frame(shapes, float(plot_x(span_s, now_s - start_s))))
    return Movie(axes, curves, frames, len(frames) // 2)


def _bar_shape(camera: Camera, bar: BarSample, length_m: float) -> Shape:
    half = 0.5 * length_m * np.array(quat_rotate(bar.attitude_wxyz, (1.0, 0.0, 0.0)))
    centre = np.array(bar.position_world_m)
    ends = camera.pixels(np.array([centre - half, centre + half]))
    return Shape(ends, FRAME, 2.0 * _BAR_RADIUS_M * camera.scale(centre))
