"""Contact of a flight with a surface, measured from its log: force, touches, path and place."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.arm_skeleton import pose
from companion.analysis.log import Array, FlightLog
from companion.model.arm_skeleton import ArmSkeleton
from companion.model.best_pose import best_pose
from companion.model.contact import ContactMode, ContactState
from companion.model.frames import quat_rotate
from companion.model.types import Vec3
from companion.phases.contact.surface import axes
from companion.safety import notices

SETTLED_S = 1.5
"""Time after the end of the force's ramp from which the force counts as steady."""
PROBE = "probe.csv"
"""Name of the file with the touched points in the folder of a flight."""
PLANE_M = 0.05
"""Extent of the touched points, in both directions, from which the surface's normal is fitted to them."""


def contact_summary(log: FlightLog) -> dict[str, Any] | None:
    """Return `contact` of summary.json; None if the mission has no contact phases.

    * The force is the measured force along the direction of the approach: `mean_n` and `rms_error_n` while it is steady,
      `overshoot_n` from the first touch on.
    * `path_rms_m` is the RMS distance of the tip from its planned position, perpendicular to that direction. The planned position
      is one point for a press; for a slide it begins where the tip is and moves with the reference.
    * If the mission slides, force and path are those of the slides alone, and `slid_m` is the length of the planned path.
    * `surface` is the plane through the points touched by a probe, or by an approach that turns to the surface; `points` is their
      number. Otherwise `points` is 0, and `point_m` is the mean position of the contact while the force was steady. `normal` is
      then fitted to the tip's positions or, if they lie too close together, opposite to the approach.
    """
    states = [outputs.contact for outputs in log.outputs]
    last = next((state for state in reversed(states) if state is not None), None)
    if last is None:
        return None
    touches = sum(event.id == notices.TOUCHED.id for outputs in log.outputs for event in outputs.events)
    pressing = np.array([state is not None and presses(state) for state in states], dtype=np.bool_)
    force = np.array([np.nan if state is None else state.force_n for state in states])
    wanted = np.array([0.0 if state is None else state.wanted_n for state in states])
    row: dict[str, Any] = {
        "wanted_n": None, "mean_n": None, "rms_error_n": None, "overshoot_n": None, "touches": touches, "path_rms_m": None,
        "slid_m": None, "surface": None,
    }  # fmt: skip
    finder = next((state for state in reversed(states) if state is not None and state.surface is not None), None)
    found = None if finder is None else finder.surface
    if finder is not None and found is not None:
        row["surface"] = {
            "point_m": list(found.point_world_m),
            "normal": list(found.normal_world),
            "points": len(finder.points),
        }
    if not pressing.any():
        return row
    most = float(wanted[pressing].max())
    row.update(wanted_n=most, overshoot_n=max(0.0, float(force[pressing].max()) - most))
    sliding = np.array([state is not None and state.mode is ContactMode.SLIDE for state in states], dtype=np.bool_)
    steady = sliding if sliding.any() else _steady(log.columns.t_s, pressing, wanted)
    if not steady.any():
        return row
    row.update(mean_n=float(force[steady].mean()), rms_error_n=float(np.sqrt(np.mean((force - wanted)[steady] ** 2))))
    tips = tips_m(log, steady)
    if tips is not None:
        tip, planned, direction, _ = tips
        off = tip - planned
        off -= np.outer(off @ direction, direction)
        row["path_rms_m"] = float(np.sqrt(np.mean(np.sum(off * off, axis=1))))
        if sliding.any():
            row["slid_m"] = float(np.sum(np.linalg.norm(np.diff(planned, axis=0), axis=1)))
        if found is None:
            normal = _normal(tip, direction)
            row["surface"] = {
                "point_m": (tip.mean(axis=0) - _radius_m(log) * normal).tolist(),
                "normal": normal.tolist(),
                "points": 0,
            }
    return row


def true_force_n(summary: dict[str, Any]) -> float | None:
    """Return the true force along the surface's normal, as the simulated world reports it; None if it is unknown."""
    surface = (summary.get("contact") or {}).get("surface")
    force_n = ((summary.get("world") or {}).get("contact") or {}).get("force_held_world_n")
    return None if surface is None or force_n is None else float(np.dot(force_n, surface["normal"]))


def rotor_distance_m(summary: dict[str, Any]) -> float | None:
    """Return the smallest distance of a rotor's disk from a surface, m, as the simulated world reports it; None if it is unknown."""
    distance_m: float | None = ((summary.get("world") or {}).get("contact") or {}).get("rotor_distance_min_m")
    return distance_m


def surface_error(summary: dict[str, Any]) -> tuple[float, float] | None:
    """Return the found surface's distance from the nearest true one, m, and the angle of the normals, deg; None if unknown."""
    surface = (summary.get("contact") or {}).get("surface")
    true = ((summary.get("world") or {}).get("contact") or {}).get("surfaces")
    if not surface or not surface["points"] or not true:
        return None
    errors = [
        (
            abs(float(np.dot(np.subtract(surface["point_m"], one["point_m"]), one["normal"]))),
            float(np.degrees(np.arccos(np.clip(np.dot(surface["normal"], one["normal"]), -1.0, 1.0)))),
        )
        for one in true
    ]
    return min(errors)


def contact_lines(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return name and text of what a summary says about the contact; empty for a flight without contact."""
    contact = summary.get("contact")
    if contact is None:
        return []
    surface = contact["surface"]
    text = "1 touch" if contact["touches"] == 1 else f"{contact['touches']} touches"
    if surface is not None and surface["points"]:
        text += f", {surface['points']} of them to find the surface"
    lines = [("contact", text)]
    if contact["mean_n"] is not None:
        text = (
            f"{contact['wanted_n']:.2f} N wanted, {contact['mean_n']:.2f} N measured (RMS error {contact['rms_error_n']:.2f} N, "
            f"overshoot {contact['overshoot_n']:.1f} N)"
        )
        lines.append(("force", text))
        if contact.get("slid_m") is not None:
            lines.append(("slide", f"{contact['slid_m']:.2f} m along the surface"))
        if (true_n := true_force_n(summary)) is not None:
            lines.append(("true force", f"{true_n:.2f} N (known to the simulated world only)"))
    if (distance_m := rotor_distance_m(summary)) is not None:
        lines.append(
            ("rotors", f"{distance_m:.2f} m from a surface at the nearest (known to the simulated world only)")
        )
    if contact["path_rms_m"] is not None:
        lines.append(("tip", f"{1e3 * contact['path_rms_m']:.0f} mm (RMS) from its path on the surface"))
    if surface is None:
        return lines
    x, y, z = surface["point_m"]
    text = f"touched at [{x:.3f}, {y:.3f}, {z:.3f}] m"
    if surface["points"]:
        x, y, z = surface["normal"]
        text = f"found by {surface['points']} points{text.removeprefix('touched')}, normal [{x:.3f}, {y:.3f}, {z:.3f}]"
        if (off := surface_error(summary)) is not None:
            text += f"; {1e3 * off[0]:.1f} mm and {off[1]:.1f} deg off (known to the simulated world only)"
    return [*lines, ("surface", text)]


def write_probe(log: FlightLog, path: Path) -> None:
    """Write the points at which a flight has touched surfaces to find them as CSV, a line for each; no file without such points.

    The point lies on the surface; `residual_mm` is its distance from the plane through the points, positive outside the surface, and
    empty if no plane was found.

    Raises:
        OSError: the file cannot be written.
    """
    contacts = {o.contact.points[0]: o.contact for o in log.outputs if o.contact is not None and o.contact.points}
    if not contacts:
        return
    radius_m = _radius_m(log)
    with path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(("t_s", "x_m", "y_m", "z_m", "force_n", "residual_mm"))
        for contact in contacts.values():
            found = contact.surface
            normal = -np.array(contact.direction_world) if found is None else np.array(found.normal_world)
            for point in contact.points:
                at = np.array(point.tip_world_m) - radius_m * normal
                off = "" if found is None else f"{1e3 * float((at - found.point_world_m) @ normal):z.2f}"
                rows.writerow((f"{point.t_s:.3f}", *(f"{x:.4f}" for x in at), f"{point.force_n:.2f}", off))


def presses(state: ContactState) -> bool:
    """Return whether the vehicle presses: the light touches by which a surface is found do not count."""
    if state.mode is ContactMode.SLIDE:
        return True
    return state.mode is ContactMode.PRESS and (state.surface is not None or state.shift.length_m == 0.0)


def _radius_m(log: FlightLog) -> float:
    tool = (log.config.get("vehicle") or {}).get("tool") or {}
    return float(tool.get("tip_radius_m") or 0.0)


def _steady(t_s: Array, pressing: Any, wanted: Array) -> Any:
    """Return the ticks in which the wanted force has been constant for `SETTLED_S`."""
    steady = np.zeros(len(t_s), dtype=np.bool_)
    since_s = np.inf
    for k in np.flatnonzero(pressing):
        if k == 0 or not pressing[k - 1] or wanted[k] != wanted[k - 1]:
            since_s = t_s[k]
        steady[k] = t_s[k] - since_s > SETTLED_S
    return steady


def surface_axes(direction: Array) -> tuple[Array, Array]:
    """Return the unit vectors to the right and up in a surface, as seen along a direction into it; of a floor, up is the world's x."""
    x, y, z = direction
    right, up = axes((float(x), float(y), float(z)))
    return np.array(right), np.array(up)


def tips_m(log: FlightLog, used: Any) -> tuple[Array, Array, Array, Array] | None:
    """Return the measured and the planned position of the tip, world frame, m, the last direction of the contact, and the ticks to
    which they belong: those of `used` in which all is known. None if it never is.
    """
    skeleton = log.arm_skeleton
    if skeleton is None:
        return None
    measured, planned, ticks, direction = [], [], [], (0.0, 0.0, 0.0)
    for k in np.flatnonzero(used):
        i, o = log.inputs[k], log.outputs[k]
        at, contact, reference = best_pose(i), o.contact, o.reference
        if at is None or i.arm is None or contact is None or reference is None:
            continue
        tip = _tip_body_m(skeleton, np.array([i.arm.angle_rad]))
        level = _tip_body_m(skeleton, np.array([reference.arm_rad]))
        cos, sin = np.cos(0.5 * reference.yaw_rad), np.sin(0.5 * reference.yaw_rad)
        measured.append(np.add(at.position_world_m, quat_rotate(at.attitude_wxyz, tip)))
        ahead = np.add(reference.position_world_m, quat_rotate((float(cos), 0.0, 0.0, float(sin)), level))
        planned.append(ahead - contact.tilting_n * np.array(contact.tip_per_n_m) + contact.beside_m)
        ticks.append(k)
        direction = contact.direction_world
    return (np.array(measured), np.array(planned), np.array(direction), np.array(ticks)) if measured else None


def _tip_body_m(skeleton: ArmSkeleton, arm_rad: Array) -> Vec3:
    x, y, z = pose(skeleton, arm_rad)[0][0, -1]
    return (float(x), float(y), float(z))


def _normal(tip: Array, direction: Array) -> Array:
    """Return the normal of the touched points, or the direction reversed if they lie too close together."""
    centred = tip - tip.mean(axis=0)
    _, _, main = np.linalg.svd(centred, full_matrices=False)
    if min(float(np.ptp(centred @ main[0])), float(np.ptp(centred @ main[1]))) < PLANE_M:
        return -direction
    normal: Array = main[2]
    return -normal if float(normal @ direction) > 0.0 else normal
