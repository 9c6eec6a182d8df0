"""Means and deviations of a comparison over the seeds.

A *row* holds the results of one flight as plain data: controller, preset, payload_kg, seed, world_seed, model_error, outcome, error,
catch_t_s, rms {pre|post: e_p_m, e_q_deg, e_alpha_deg}, impedance_error {position_n, arm_nm}, final_e_z_m, peak_e_p_m,
torque_activity_nm. A figure is None if its part of the flight was not flown to the end: errors on the way to a crash say nothing about
the controller.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from companion.campaigns.compare.grid import is_ablation
from companion.campaigns.compare.paper_results import PrintedFlight, printed
from companion.campaigns.runner import Row, flat

COMPLETED = "completed"
MISSED = "missed"
"""A failure in `Group.failures`: the flight was completed without a catch."""
FIGURES = (
    *(f"rms.{part}.{key}" for part in ("pre", "post") for key in ("e_p_m", "e_q_deg", "e_alpha_deg")),
    "impedance_error.position_n",
    "impedance_error.arm_nm",
    "final_e_z_m",
    "final_abs_e_z_m",
    "peak_e_p_m",
    "torque_activity_nm",
    "catch_t_s",
)
"""Averaged figures: dotted keys of a row, and the absolute final height error, because signed ones would cancel."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and sample standard deviation over seeds."""

    mean: float
    std: float | None
    """None for a single value."""


@dataclass(frozen=True, slots=True)
class Group:
    """All seeds of one variant with one payload and one model error."""

    controller: str
    preset: str
    payload_kg: float
    model_error: float
    rows: Sequence[Row]

    @property
    def label(self) -> str:
        """`law/preset`."""
        return f"{self.controller}/{self.preset}"

    def spread(self, name: str) -> Spread | None:
        """Return one of `FIGURES` over the flights that have it; None if none has."""
        values = [value for row in self.rows if (value := figure(row, name)) is not None]
        if not values:
            return None
        return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)

    @property
    def failures(self) -> dict[str, int]:
        """Number of flights by outcome that were not completed with the payload on board."""
        return dict(Counter(what for row in self.rows if (what := _failure(row)) is not None))

    @property
    def failure_text(self) -> str:
        """`crashed 2 of 5`; empty if there was no failure."""
        return ", ".join(f"{what} {count} of {len(self.rows)}" for what, count in self.failures.items())

    @property
    def printed(self) -> PrintedFlight | None:
        """The paper's figures."""
        return None if is_ablation(self.preset) else printed(self.controller, self.payload_kg)

    def jsonable(self) -> dict[str, Any]:
        """Return the group as in compare.json."""
        spreads = {name: self.spread(name) for name in FIGURES}
        of = self.printed
        return {
            "controller": self.controller,
            "preset": self.preset,
            "payload_kg": self.payload_kg,
            "model_error": self.model_error,
            "flights": len(self.rows),
            "completed": sum(row["outcome"] == COMPLETED for row in self.rows),
            "failures": self.failures,
            "mean": _nested({name: None if spread is None else spread.mean for name, spread in spreads.items()}),
            "std": _nested({name: None if spread is None else spread.std for name, spread in spreads.items()}),
            "printed": of
            and {"controller": of.title, "pre": of.pre.jsonable(), "post": of.post and of.post.jsonable()},
        }


def aggregate(rows: Iterable[Row]) -> list[Group]:
    """Group the rows by controller, preset, payload and model error, in the order of their first appearance."""
    groups: dict[tuple[str, str, float, float], list[Row]] = {}
    for row in rows:
        key = (row["controller"], row["preset"], row["payload_kg"], row["model_error"])
        groups.setdefault(key, []).append(row)
    return [Group(*key, group) for key, group in groups.items()]


def _failure(row: Row) -> str | None:
    if row["outcome"] != COMPLETED:
        return str(row["outcome"])
    return MISSED if row["payload_kg"] > 0 and row["catch_t_s"] is None else None


def figure(row: Row, name: str) -> float | None:
    """Return one of `FIGURES` of a row."""
    if name == "final_abs_e_z_m":
        return None if row["final_e_z_m"] is None else abs(row["final_e_z_m"])
    value = dict(flat(row))[name]
    return None if value is None else float(value)


def _nested(figures: Mapping[str, float | None]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, value in figures.items():
        *above, last = name.split(".")
        place = nested
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
    return nested
