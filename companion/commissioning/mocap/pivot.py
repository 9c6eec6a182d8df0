"""`companion mocap pivot`: how far the rigid body's pivot is off, from probes of surfaces whose place is known.

A pivot, heading, arm or joint zero that is wrong moves the place at which the tip is believed to be, in the body frame always by nearly
the same t. A plane with the normal n, probed at the heading R, is then found n . R t beside its place. Three probes whose R' n point in
different directions give t. Pure, but for reading the flights' files.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.commissioning.tool import Report, Session
from companion.config.document import ConfigError
from companion.config.loader import logged_flight
from companion.config.vehicle import Vehicle
from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.model.types import Vec3
from companion.preflight.checks import Check

FLIGHTS_MIN: Final = 3
WELL_MM: Final = 3.0
SPREAD_MIN: Final = 0.1
"""Least singular value of the normals: below it errors of the probes would grow more than tenfold."""

PIVOT = Check("mocap.pivot", "pivot of the rigid body", why="the computed position of the tip is wrong")


@dataclass(frozen=True, slots=True)
class Probed:
    """One probe of a known surface."""

    normal_world: Vec3
    """Unit normal of the surface, out of it."""
    yaw_rad: float
    off_m: float
    """Distance of the found plane from the surface along the normal."""


class TooAlike(ValueError):
    """The normals, seen from the vehicle, do not point in three directions."""


def tip_off_m(probes: Sequence[Probed]) -> Vec3:
    """Return how far the tip is believed to be from its true place, body frame.

    Raises:
        TooAlike: the probes do not determine it.
    """
    rows = []
    for probed in probes:
        (x, y, z), cos, sin = probed.normal_world, math.cos(probed.yaw_rad), math.sin(probed.yaw_rad)
        rows.append((cos * x + sin * y, cos * y - sin * x, z))
    if np.linalg.svd(np.array(rows), compute_uv=False)[2] < SPREAD_MIN:
        raise TooAlike("the surfaces' normals, seen from the vehicle, do not point in three directions")
    x, y, z = np.linalg.lstsq(np.array(rows), np.array([probed.off_m for probed in probes]), rcond=None)[0]
    return float(x), float(y), float(z)


def read(session: Session) -> list[Probed]:
    """Return the probes of the flights that were given.

    Raises:
        ConfigError: a flight or a plane is not usable.
    """
    flights, planes = session.arguments.flights, session.arguments.plane
    if len(flights) < FLIGHTS_MIN:
        raise _wrong(f"expected {FLIGHTS_MIN} or more flights, got {len(flights)}")
    if len(planes) not in (1, len(flights)):
        raise _wrong(
            f"--plane: expected once for all flights, or once for each of the {len(flights)}, got {len(planes)}"
        )
    each = planes * len(flights) if len(planes) == 1 else planes
    probes = [_probed(Path(flight), point_m, normal) for flight, (point_m, normal) in zip(flights, each, strict=True)]
    try:
        tip_off_m(probes)
    except TooAlike as error:
        raise _wrong(f"{error}: turn the nose by 15 deg to either side, and lean the surface by 15 deg") from None
    return probes


def judge(probes: list[Probed], _: Vehicle) -> Report:
    """Return the report: how to move the pivot."""
    move_mm = [-1e3 * value for value in tip_off_m(probes)]
    x, y, z = move_mm
    fix = f"in Motive, move the pivot by {x:+.1f} mm forward, {y:+.1f} mm to the left and {z:+.1f} mm up, in the body's axes"
    read = f"{math.hypot(*move_mm):.1f} mm off"
    data = {"pivot_move_mm": move_mm, "probes_off_mm": [1e3 * probed.off_m for probed in probes]}
    return Report([PIVOT.row(math.hypot(*move_mm) <= WELL_MM, read, f"within {WELL_MM:g} mm", fix)], data)


def _probed(folder: Path, point_m: Vec3, normal: Vec3) -> Probed:
    try:
        summary: Any = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        config = logged_flight((folder / "config.json").read_text(encoding="utf-8"))
        surface = (summary.get("contact") or {}).get("surface")
    except (OSError, ValueError, AttributeError):
        raise _wrong(f"{folder}: expected the folder of a flight, with its summary.json and config.json") from None
    plan, phases = Plan.build(config.mission, config.vehicle), phases_of(config.mission)
    probe = next((one for one in plan.segments if phases[one.index].surveys), None)
    if probe is None or surface is None:
        raise _wrong(f"{folder}: expected a flight with a phase `probe` that found a surface")
    away = [found - known for found, known in zip(surface["point_m"], point_m, strict=True)]
    return Probed(normal, plan.reference(probe.start_s).yaw_rad, sum(map(float.__mul__, away, normal)))


def _wrong(text: str) -> ConfigError:
    return ConfigError(f"companion mocap pivot: {text}")
