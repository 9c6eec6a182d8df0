"""Flights in worlds drawn at random: drawn values, distribution of the position error and its correlations.

A row holds the results of one flight, as `companion robustness --json` prints it; docs/internals/robustness.md describes its keys.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.campaigns.runner import Row, catches
from companion.model.types import Outcome
from companion.sitl_config.per_joint import of_joints

WORST = 10
"""Number of worst flights that are kept."""
SAFE = (Outcome.COMPLETED.value, Outcome.ABORTED.value, Outcome.REFUSED.value)
"""Outcomes with the vehicle undamaged on the floor."""
_SEVERITY = {Outcome.CRASHED.value: 4, Outcome.LOST.value: 3, Outcome.REFUSED.value: 2, Outcome.ABORTED.value: 1}
DRIVERS: dict[str, str] = {
    "payload_kg": "payload, kg",
    "throw_speed_m_s": "horizontal throw speed, m/s",
    "throw_from_deg": "throw direction, deg off the line",
    "descent_m_s": "descent at the catch, m/s",
    "catch_x_m": "catch point, m along the line",
    "hover_thrust_error": "hover-thrust error",
    "link1_mass_error": "mass error of link 1",
    "link2_mass_error": "mass error of link 2",
    "setpoint_delay_s": "setpoint delay, s",
    "arm_delay_s": "arm delay, s",
    "rotor_lag_s": "rotor time constant, s",
    "wind_speed_m_s": "wind, m/s",
    "force_bias_n": "bias of the force sensor, N",
    "force_lost_s": "time of the force sensor's loss, s",
}
"""The drawn quantities as single numbers, each with its label."""


DRAWN = ("payload_kg", "throw_velocity_m_s", "catch_at_m", "seed")
"""Keys of the world that the campaign draws; the world file draws the others."""


def drivers(world: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the drawn values by the keys of `DRIVERS`; None where a quantity does not apply."""
    unknown = (math.nan,) * 3  # people throw with a velocity of their own
    vx, vy, vz = unknown if world.get("people") else world.get("throw_velocity_m_s", unknown)
    wx, wy, _ = world.get("wind_m_s", (math.nan,) * 3)
    link1, link2 = of_joints(world.get("link_mass_error", (math.nan,)), 2)
    values: dict[str, float | None] = {
        "throw_speed_m_s": math.hypot(vx, vy),
        # 0: from ahead, 180: from behind.
        "throw_from_deg": abs(math.degrees(math.atan2(-vy, -vx))),
        "descent_m_s": -vz,
        "catch_x_m": world.get("catch_at_m", (None,))[0],
        "link1_mass_error": link1,
        "link2_mass_error": link2,
        "wind_speed_m_s": math.hypot(wx, wy),
        "force_bias_n": math.hypot(*world["force_bias_n"]) if "force_bias_n" in world else None,
        "force_lost_s": next(
            (fault["t_s"] for fault in world.get("faults", ()) if fault["kind"] == "force_loss"), None
        ),
    }
    found = {key: values[key] if key in values else world.get(key) for key in DRIVERS}
    return {key: None if value is None or math.isnan(value) else float(value) for key, value in found.items()}


def sensor_of(row: Row) -> str:
    """Return the state of the force sensor: working, lost after the catch, or missing at the catch."""
    if not row["felt"]:
        return "missing at the catch"
    return "lost after the catch" if "force_lost" in row["events"] else "working"


def graded(rows: Sequence[Row]) -> list[Row]:
    """Return the completed flights with a catch: only these are used for the distribution of e_p."""
    return [
        row for row in rows if row["outcome"] == Outcome.COMPLETED.value and row["caught"] and row["e_p_m"] is not None
    ]


@dataclass(frozen=True, slots=True)
class Third:
    """The flights of one third of the payload range."""

    payload_kg: tuple[float, float]
    flights: int
    caught: int
    catches: tuple[int, int]
    """Number of false and of undetected catches."""
    e_p_m: dict[str, float | None]
    """p50, p95 and max of the RMS after the catch, over the flights of `graded`."""


def thirds(rows: Sequence[Row]) -> list[Third]:
    """Return the flights of each third of the payload range; the thirds have equal widths. One payload for all is one part."""
    payloads = [row["world"]["payload_kg"] for row in rows if "payload_kg" in row["world"]]
    if not payloads:
        return []
    edges = [float(edge) for edge in np.linspace(min(payloads), max(payloads), 4)]
    if edges[0] == edges[-1]:  # set by the user, or a single flight
        edges = edges[:2]
    found = []
    for low, high in itertools.pairwise(edges):
        last = high == edges[-1]
        these = [
            r for r in rows if low <= r["world"]["payload_kg"] < high or (last and r["world"]["payload_kg"] == high)
        ]
        errors = quantiles([row["e_p_m"] for row in graded(these)])
        caught = sum(bool(row["caught"]) for row in these)
        found.append(Third((low, high), len(these), caught, catches(these), errors))
    return found


def quantiles(values: Sequence[float]) -> dict[str, float | None]:
    """Return median, 95th percentile and maximum; None without a value."""
    found = np.percentile(values, (50, 95, 100)).tolist() if values else (None, None, None)
    return dict(zip(("p50", "p95", "max"), found, strict=True))


def why_of(row: Row) -> str:
    """Return why a flight was not completed."""
    return str(row["error"] or row["why"] or "no event gives a reason")


def influence(rows: Sequence[Row]) -> dict[str, float]:
    """Return the rank correlation (Spearman) of e_p after the catch with each drawn quantity, the strongest first."""
    flown = graded(rows)
    known = [drivers(row["world"]) for row in flown]
    found = {}
    for key in DRIVERS:
        pairs = [(d[key], row["e_p_m"]) for d, row in zip(known, flown, strict=True) if d[key] is not None]
        if len(pairs) >= 10:
            correlation = rank_correlation(*zip(*pairs, strict=True))
            if correlation is not None:
                found[key] = correlation
    return dict(sorted(found.items(), key=lambda item: -abs(item[1])))


def rank_correlation(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return Spearman's rank correlation; None if one of the quantities does not vary."""
    if not (np.ptp(x) > 0 and np.ptp(y) > 0):
        return None
    from scipy.stats import spearmanr  # the import takes half a second

    return float(spearmanr(x, y).statistic)


def worst(rows: Sequence[Row], count: int = WORST) -> list[Row]:
    """Return the worst flights, the worst first: by outcome, then by error, then by number."""
    return sorted(
        rows, key=lambda row: (-_SEVERITY.get(row["outcome"], 0), -(row["e_p_m"] or 0.0), row["number"] or 0)
    )[:count]
