"""The plots of a contact with a surface: force, and the tip's path in the plane of the surface. Needs matplotlib (extra `analysis`)."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from companion.analysis.contact import PLANE_M, presses, surface_axes, tips_m
from companion.analysis.log import Array, FlightLog
from companion.analysis.plot_style import CATCH, DASHED, INK, REFERENCE, SERIES, SOFT, dress, figure_legend, new_figure
from companion.analysis.time_axes import legend, line
from companion.model.contact import ContactMode
from companion.model.outputs import ControlLog
from companion.model.types import Vec3

_LEAVE, _MOVE = ("leave", "#f8eed8"), ("move", "#f1e9f7")
_BANDS = {
    ContactMode.TARE: ("tare", "#eceff2"),
    ContactMode.APPROACH: ("approach", "#dcebf9"),
    ContactMode.PRESS: ("press", "#dff3e6"),
    ContactMode.SLIDE: ("slide", "#cfe9f0"),
    ContactMode.LOST: ("contact lost", "#fbdfe3"),
    ContactMode.BACK: _LEAVE,
    ContactMode.LEAVE: _LEAVE,
    ContactMode.SHIFT: _MOVE,
    ContactMode.RETURN: _MOVE,
}
"""Name and colour of what the flight does about the surface."""
_EXACT = 3
"""Number of points through which a plane always fits."""
_MEAN_S = 0.1
"""Time over which the force in the plane and the position of the tip are averaged: noise would hide them."""
_AROUND_S = 1.0
"""Time before and after the contact that is drawn, too."""


def has_contact(log: FlightLog) -> bool:
    """Return whether the flight had a contact phase."""
    return any(o.contact is not None for o in log.outputs)


def contact_force(log: FlightLog) -> Figure | None:
    """Draw the force on the tool along the normal and in the plane of the surface, and the contact's modes as bands."""
    modes = [None if o.contact is None else o.contact.mode for o in log.outputs]
    seen = np.flatnonzero([mode is not None for mode in modes])
    if not len(seen):
        return None
    t = log.columns.mission_t_s
    figure = new_figure(5.4)
    normal, plane = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    force = _in_surface_frame(log, lambda o: _force_n(o.control))
    wanted = log.column(lambda i, o, s: o.contact.wanted_n if o.contact else None)
    sensor = _in_surface_frame(
        log, lambda o: o.control.force_measured_world_n if o.control and o.control.force_observed_world_n else None
    )
    observed = bool(np.isfinite(sensor).any())
    if observed:
        line(normal, t, sensor[:, 0], "force sensor", SERIES[2])
    corrected = log.column(lambda i, o, s: o.contact.force_n if o.contact and o.contact.unseen_n != 0.0 else None)
    differs = bool(np.isfinite(corrected).any())
    line(normal, t, force[:, 0], "momentum observer" if observed else "sensor" if differs else "measured", SERIES[0])
    if differs:
        line(normal, t, corrected, "with the correction from the vehicle's motion", SERIES[4])
    line(normal, t, wanted, "wanted", INK, reference=True)
    line(plane, t, _smooth(force[:, 1], t), "to the right", SERIES[1])
    line(plane, t, _smooth(force[:, 2], t), "up", SERIES[3])
    normal.set_ylabel("along the normal [N]")
    plane.set_ylabel("in the plane [N]")
    plane.set_xlabel("mission time [s]")
    for ax in (normal, plane):
        dress(ax)
        ax.set_xlim(t[seen[0]] - _AROUND_S, t[seen[-1]] + _AROUND_S)
        ax.margins(y=0.12)
        legend(ax, columns=3)
        _shade(ax, t, modes)
    shown = list(dict.fromkeys(_BANDS[mode] for mode in _BANDS if mode in modes))
    patches = [Patch(facecolor=colour, edgecolor="#aab4bd", lw=0.6) for _, colour in shown]
    figure_legend(figure, "Force on the tool", patches, [name for name, _ in shown], len(shown))
    return figure


def contact_path(log: FlightLog) -> Figure | None:
    """Draw the path of the tip in the plane of the surface while it presses."""
    pressing = np.array([o.contact is not None and presses(o.contact) for o in log.outputs])
    found = tips_m(log, pressing)
    if found is None:
        return None
    tip, planned, direction, used = found
    right, up = surface_axes(direction)
    origin = planned.mean(axis=0)
    flown, wanted = (np.stack([(path - origin) @ right, (path - origin) @ up], axis=1) for path in (tip, planned))
    moves = float(np.ptp(wanted, axis=0).max()) >= PLANE_M
    scale, unit = (1.0, "m") if moves else (1e3, "mm")
    flown, wanted = scale * flown, scale * wanted
    figure = new_figure(4.6)
    ax = figure.subplots()
    dress(ax)
    if moves:
        ax.plot(*wanted.T, color=REFERENCE, lw=1.2, ls=DASHED, label="reference", zorder=3.5)
    else:
        ax.plot(*wanted[-1], "+", color=CATCH, ms=14, mew=2.0, label="reference", zorder=4)
    t = log.columns.t_s[used]
    flown = np.stack([_smooth(column, t) for column in flown.T], axis=1)
    ax.plot(*flown.T, color=SOFT, lw=0.8, zorder=2)
    dots = ax.scatter(flown[:, 0], flown[:, 1], c=t - t[0], s=6, cmap="viridis", label="tip", zorder=3)
    figure.colorbar(dots, ax=ax, label="time since the touch [s]", shrink=0.85)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.1)
    ax.set_xlabel(f"right [{unit}]")
    ax.set_ylabel(f"up [{unit}]")
    legend(ax, columns=2)
    figure.suptitle("Contact in the plane of the surface", fontsize=13, fontweight="bold", color=INK)
    return figure


def found_surface(log: FlightLog) -> Figure | None:
    """Draw the points by which a probe found the surface, and how far each is from the plane through them."""
    last = next(
        (o.contact for o in reversed(log.outputs) if o.contact is not None and o.contact.surface is not None), None
    )
    if last is None or last.surface is None or len(last.points) <= _EXACT:
        return None
    normal = np.array(last.surface.normal_world)
    right, up = surface_axes(-normal)
    tips = np.array([point.tip_world_m for point in last.points])
    off = tips - tips.mean(axis=0)
    x, y, beyond_mm = off @ right, off @ up, 1e3 * (off @ normal)
    figure = new_figure(4.6)
    ax = figure.subplots()
    dress(ax)
    most = max(1.0, float(np.abs(beyond_mm).max()))
    ax.plot(x, y, color=SOFT, lw=0.8, zorder=2)
    dots = ax.scatter(
        x, y, c=beyond_mm, s=90, cmap="coolwarm", vmin=-most, vmax=most, edgecolors=INK, linewidths=0.6, zorder=3
    )
    for number, (px, py, mm) in enumerate(zip(x, y, beyond_mm, strict=True), 1):
        ax.annotate(
            f"{number}: {mm:+.1f} mm", (px, py), xytext=(8, 6), textcoords="offset points", fontsize=8.5, color=INK
        )
    figure.colorbar(dots, ax=ax, label="out of the plane through the points [mm]", shrink=0.85)
    ax.set_aspect("equal", adjustable="datalim")
    ax.margins(0.2)
    ax.set_xlabel("right [m]")
    ax.set_ylabel("up [m]")
    rms_mm = float(np.sqrt(np.mean(beyond_mm**2)))
    ax.set_title(
        f"{len(tips)} points, {rms_mm:.1f} mm RMS from the plane through them", loc="left", fontsize=10, color=INK
    )
    figure.suptitle("Found surface", fontsize=13, fontweight="bold", color=INK)
    return figure


def _smooth(values: Array, t_s: Array) -> Array:
    """Return the mean over `_MEAN_S` about each tick."""
    known = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
    count = np.concatenate([[0], np.cumsum(np.isfinite(values))])
    low, high = np.searchsorted(t_s, t_s - 0.5 * _MEAN_S), np.searchsorted(t_s, t_s + 0.5 * _MEAN_S, "right")
    out: Array = (known[high] - known[low]) / np.maximum(count[high] - count[low], 1)
    return np.where(np.isfinite(values), out, np.nan)


def _in_surface_frame(log: FlightLog, force_n: Any) -> Array:
    """Return the force on the tool out of the surface, to the right and up, less its mean before the approach; NaN without contact."""
    rows, mean, since = np.full((len(log.outputs), 3), np.nan), np.zeros(3), 0
    for k, o in enumerate(log.outputs):
        force = force_n(o)
        if o.contact is None or force is None:
            continue
        direction = np.array(o.contact.direction_world)
        right, up = surface_axes(direction)
        rows[k] = (-np.dot(force, direction), np.dot(force, right), np.dot(force, up))
        if o.contact.mode is ContactMode.TARE:
            since = (
                k
                if k == 0 or (before := log.outputs[k - 1].contact) is None or before.mode is not ContactMode.TARE
                else since
            )
            mean = np.nanmean(rows[since : k + 1], axis=0)
        else:
            rows[k] -= mean
    return rows


def _force_n(control: ControlLog | None) -> Vec3 | None:
    """Return the force on which the contact is controlled; while the tool touches, the law gets only its part along the press."""
    if control is None:
        return None
    return control.force_observed_world_n or control.force_measured_world_n or control.force_ext_world_n


def _shade(ax: Any, t: Array, modes: list[ContactMode | None]) -> None:
    last = len(modes) - 1
    for mode, ticks in groupby(range(len(modes)), key=lambda k: modes[k]):
        if mode is not None:
            first, *rest = ticks
            ax.axvspan(t[first], t[min(last, (rest or [first])[-1] + 1)], facecolor=_BANDS[mode][1], zorder=0, lw=0)
