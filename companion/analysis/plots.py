"""The plots of a flight, as in the paper's figures: errors, arm, actuation, adaptation, force, path, timing.

Needs matplotlib (extra `analysis`). The flight process never imports this module.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from companion.analysis import metrics
from companion.analysis.contact_plots import contact_force, contact_path, found_surface, has_contact
from companion.analysis.log import FlightLog
from companion.analysis.page import Picture
from companion.analysis.plot_style import (
    CATCH,
    DASHED,
    INK,
    REFERENCE,
    SERIES,
    SERIES_DARK,
    dress,
    new_figure,
    path_panes,
    scale_path,
    write_pictures,
)
from companion.analysis.time_axes import legend, line, stack
from companion.model.best_pose import best_pose
from companion.model.constants import GRAVITY_M_S2
from companion.model.frames import tilt_rad
from companion.model.tick_times import end_s


def write_plots(log: FlightLog, out_dir: Path) -> list[Picture]:
    """Write every plot for which the log has data, as PNG into `out_dir`."""
    if not log.inputs:
        return []
    makers: tuple[tuple[str, str, str, Callable[[FlightLog], Figure | None]], ...] = (
        (
            "tracking",
            "Tracking",
            "Position and attitude by motion capture (without it, by PX4), and the reference.",
            _tracking,
        ),
        ("actuation", "Actuation", "Commands of the control law and the values sent.", _actuation),
        ("adaptation", "Adaptation", "Switching gain and its adapted parameters.", _adaptation),
        (
            "load",
            "Adaptive load",
            "Loads estimated by the adaptation: force on the base, first moments of the links, joint friction.",
            _load,
        ),
        (
            "contact",
            "Force on the tool",
            "Force of the surface on the tool in the frame of the surface, as seen from the vehicle, without the mean before the "
            "approach. The shaded bands are what the flight does about the surface.",
            contact_force,
        ),
        (
            "found_surface",
            "Found surface",
            "Centre of the tip at each touched point, as seen from the vehicle, in the order of the touches.",
            found_surface,
        ),
        (
            "contact_path",
            "Contact in the plane of the surface",
            "Centre of the tip while it touches, as seen from the vehicle, and the path on which the reference would lead it.",
            contact_path,
        ),
        ("force", "Contact force", "Tared force on the net in the world frame, without the weight of the net.", _force),
        (
            "path",
            "Path",
            "Path measured by motion capture (without it, by PX4), seen from above and from the side.",
            _path,
        ),
        (
            "timing",
            "Timing",
            "Lateness of the control tick, durations of ticks and bus reads, and the two main latencies.",
            _timing,
        ),
    )
    return write_pictures(((name, title, caption, make(log)) for name, title, caption, make in makers), out_dir)


def _tracking(log: FlightLog) -> Figure | None:
    joints = log.joint_count
    title = "Tracking errors and arm" if joints else "Tracking errors"
    figure, axes, t = stack(log, title, (1.0, 1.0, *((1.25,) if joints else ())), 6.8 if joints else 4.8)
    e_p_m = np.linalg.norm(metrics.position_error_m(log), axis=1)
    e_q_deg = np.degrees(np.linalg.norm(metrics.attitude_error_rad(log), axis=1))
    line(axes[0], t, e_p_m, r"$\|e_p\|$", SERIES[0])
    line(axes[0], t, log.column(lambda i, o, s: o.mocap_innovation_m or None), "motion capture against IMU", SERIES[1])
    legend(axes[0], columns=2)
    line(axes[1], t, e_q_deg, r"$\|e_q\|$", SERIES[0])
    axes[0].set_ylabel("position error [m]")
    axes[1].set_ylabel("attitude error [deg]")
    pre, post = metrics.flight_masks(log)
    # The take-off's transient would hide the flight itself.
    for ax, values in ((axes[0], e_p_m), (axes[1], e_q_deg)):
        seen = values[(pre | post) & np.isfinite(values)]
        if len(seen):
            ax.set_ylim(0.0, 1.15 * max(float(seen.max()), 1e-3))
    if joints:
        angles, wanted = np.degrees(log.columns.arm_rad), np.degrees(log.columns.arm_reference_rad)
        for j in range(joints):
            line(axes[2], t, angles[:, j], rf"$\alpha_{j + 1}$", SERIES[j])
            line(axes[2], t, wanted[:, j], rf"$\alpha_{j + 1}$ reference", SERIES_DARK[j], reference=True)
        axes[2].set_ylabel("arm angle [deg]")
        legend(axes[2], columns=4)
    return figure


def _actuation(log: FlightLog) -> Figure | None:
    joints = log.joint_count
    figure, axes, t = stack(log, "Actuation", (1.0, 1.0, *((1.25,) if joints else ())), 6.8 if joints else 4.8)
    thrust = log.column(lambda i, o, s: o.attitude.thrust if o.attitude else None)
    hover = log.column(lambda i, o, s: o.control.hover_thrust if o.control else None)
    line(axes[0], t, 100 * thrust, "collective", SERIES[0])
    line(axes[0], t, 100 * hover, "hover", REFERENCE, reference=True)
    axes[0].set_ylabel("thrust [%]")
    legend(axes[0])
    asked = log.column(lambda i, o, s: tilt_rad(o.attitude.attitude_wxyz) if o.attitude else None)
    flown = log.column(
        lambda i, o, s: tilt_rad(pose.attitude_wxyz) if (pose := best_pose(i)) and pose.tracking_valid else None
    )
    line(axes[1], t, np.degrees(flown), "flown", SERIES[0])
    line(axes[1], t, np.degrees(asked), "commanded", REFERENCE, reference=True)
    axes[1].set_ylabel("tilt [deg]")
    legend(axes[1])
    if not joints:
        return figure
    commanded = log.column(lambda i, o, s: o.arm_torque_nm, joints)
    sent = log.column(lambda i, o, s: s.arm_torque_sent_nm, joints)
    for j in range(joints):
        # Drawn below the values sent, which are noisy and mostly the same: only a difference shall show.
        axes[2].plot(t, commanded[:, j], color=SERIES_DARK[j], lw=1.2, label=f"joint {j + 1} commanded")
        line(axes[2], t, sent[:, j], f"joint {j + 1} sent", SERIES[j])
    axes[2].set_ylabel("joint torque [N m]")
    legend(axes[2], columns=4)
    return figure


def _adaptation(log: FlightLog) -> Figure | None:
    rho = log.column(lambda i, o, s: o.control.rho if o.control else None)
    if not np.isfinite(rho).any():
        return None
    figure, axes, t = stack(log, "Adaptation", (1.0, 1.25, 0.8))
    line(axes[0], t, rho, r"$\rho$", SERIES[0])
    axes[0].set_ylabel(r"switching gain $\rho$")
    h_hat = log.column(lambda i, o, s: o.control.h_hat if o.control else None, 4)
    for j in range(4):
        line(axes[1], t, h_hat[:, j], rf"$\hat{{H}}_{j}$", SERIES[j])
    axes[1].set_ylabel(r"$\hat{H}_0 \ldots \hat{H}_3$")
    legend(axes[1], columns=4)
    line(axes[2], t, log.column(lambda i, o, s: o.control.zeta if o.control else None), r"$\zeta$", SERIES[0])
    axes[2].set_ylabel(r"$\zeta$")
    for ax in axes:
        ax.set_ylim(bottom=0.0)
    return figure


def _load(log: FlightLog) -> Figure | None:
    force = log.column(lambda i, o, s: o.control.load_estimate_n if o.control else None, 3)
    if not np.isfinite(force).any():
        return None
    joints = log.joint_count
    heights = (1.0, 0.8, 0.8) if joints else (1.0,)
    figure, axes, t = stack(log, "Adaptive load", heights, 6.8 if joints else 3.2)
    moments = log.column(lambda i, o, s: o.control.moment_estimate_kg_m if o.control else None, joints)
    friction = log.column(lambda i, o, s: o.control.friction_estimate_nm if o.control else None, joints)
    for j, name in enumerate("xyz"):
        line(axes[0], t, force[:, j], f"${name}$", SERIES[j])
    for j in range(joints):
        line(axes[1], t, moments[:, j], f"link {j + 1}", SERIES[j])
        line(axes[2], t, friction[:, j], f"joint {j + 1}", SERIES[j])
    for ax, label in zip(axes, ("load [N]", "first moment [kg m]", "friction [N m]"), strict=False):
        ax.set_ylabel(label)
        legend(ax, columns=3)
    return figure


def _force(log: FlightLog) -> Figure | None:
    force = log.column(lambda i, o, s: o.control.force_ext_world_n if o.control else None, 3)
    observed = log.column(lambda i, o, s: o.control.force_observed_world_n if o.control else None, 3)
    devices = (log.config.get("vehicle") or {}).get("devices") or {}
    blind = devices.get("force", {}) is None and not np.isfinite(observed).any()
    if has_contact(log):  # drawn in the frame of the surface
        return None
    if blind or not np.isfinite(force).any():
        return None
    figure, axes, t = stack(log, "Contact force, world frame", (1.0,), height_in=3.2)
    for j, name in enumerate("xyz"):
        line(axes[0], t, force[:, j], f"$F_{name}$", SERIES[j])
    measured = log.column(lambda i, o, s: o.control.force_measured_world_n if o.control else None, 3)
    if np.isfinite(measured).any():
        line(axes[0], t, measured[:, 2], "$F_z$ of the sensor", REFERENCE, reference=True)
    payload_kg = log.column(lambda i, o, s: o.control.payload_estimate_kg if o.control else None)
    if np.isfinite(payload_kg).any():
        weight_n = GRAVITY_M_S2 * payload_kg
        line(axes[0], t, -weight_n, "weight of the estimated payload", REFERENCE, reference=True)
    axes[0].set_ylabel("force [N]")
    legend(axes[0], columns=4)
    return figure


def _path(log: FlightLog) -> Figure | None:
    flown, wanted = log.columns.mocap_position_world_m, log.columns.reference_position_world_m
    if not np.isfinite(flown).any():
        return None
    figure = new_figure(5.2)
    panes = path_panes(figure)
    caught = metrics.catch_index(log)
    for ax, row in panes:
        ax.plot(wanted[:, 0], wanted[:, row], color=REFERENCE, lw=1.2, ls=DASHED, label="reference", zorder=3.5)
        ax.plot(flown[:, 0], flown[:, row], color=SERIES[0], lw=1.5, label="flown", zorder=3)
        if caught is not None:
            ax.plot(*flown[caught, [0, row]], "o", ms=7, mfc="white", mec=CATCH, mew=1.8, label="catch", zorder=4)
    scale_path(panes, flown, wanted)
    legend(panes[0][0], columns=3)
    figure.suptitle("Path", fontsize=13, fontweight="bold", color=INK)
    return figure


def _timing(log: FlightLog) -> Figure | None:
    if log.clock == "simulated":
        return None
    figure = new_figure(5.4)
    panes: dict[str, Any] = figure.subplot_mosaic([["time", "time", "time"], ["late", "joint", "mocap"]])
    late_ms = 1e3 * log.columns.lateness_s
    dress(panes["time"])
    whole_ms = 1e3 * log.column(lambda i, o, s: end_s(s) - s.start_s)
    read_ms = 1e3 * log.column(
        lambda i, o, s: i.arm.stamp_s - i.arm.asked_s if i.arm and i.arm.asked_s is not None else None
    )
    for values_ms, label, colour in (
        (whole_ms, "whole tick", SERIES[1]),
        (read_ms, "servo bus read", SERIES[2]),
        (late_ms, "tick lateness", SERIES[0]),
    ):
        if np.isfinite(values_ms).any():
            panes["time"].plot(log.columns.t_s, values_ms, color=colour, lw=0.6, label=label)
    panes["time"].margins(x=0.0)
    panes["time"].set_ylim(bottom=0.0)
    panes["time"].set_xlabel("flight clock [s]")
    panes["time"].set_ylabel("time [ms]")
    legend(panes["time"], columns=3)
    for name, title, values_s in (
        ("late", "tick lateness", log.columns.lateness_s),
        ("joint", "joint read to current write", log.timing.joint_read_to_write_s),
        ("mocap", "mocap datagram to setpoint", log.timing.mocap_to_setpoint_s),
    ):
        ax = panes[name]
        dress(ax)
        ax.set_title(title, fontsize=10, color=INK)
        ax.set_xlabel("[ms]")
        spread = metrics.percentiles(values_s)
        p50_ms, p99_ms, max_ms = spread["p50"], spread["p99"], spread["max"]
        if p50_ms is None or p99_ms is None:
            ax.text(0.5, 0.5, "not measured", ha="center", va="center", color=REFERENCE, transform=ax.transAxes)
            continue
        end_ms = max(1.3 * p99_ms, 0.1)
        ax.hist(np.minimum(1e3 * values_s, end_ms), bins=40, range=(0.0, end_ms), color=SERIES[0], alpha=0.85)
        for value_ms, label, dash in ((p50_ms, "p50", "-"), (p99_ms, "p99", "--")):
            ax.axvline(value_ms, color=CATCH, lw=1.2, ls=dash, label=f"{label} {value_ms:.2f} ms")
        ax.plot([], [], " ", label=f"max {max_ms:.2f} ms")
        ax.set_ylim(top=1.45 * ax.get_ylim()[1])  # room for the legend
        legend(ax)
    panes["late"].set_ylabel("ticks")
    figure.suptitle("Timing", fontsize=13, fontweight="bold", color=INK)
    return figure
