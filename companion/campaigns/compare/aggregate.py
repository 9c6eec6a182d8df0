"""Distributions of a comparison's metrics over the seeds, and the paired comparison of two variants. `tables`
formats them.

A *row* holds the results of one flight as plain data: controller, preset, payload_kg, seed, world_seed, model_error, outcome,
error, caught (the world's truth), catch_t_s (the companion's event, mission clock), rms {pre|post: e_p_m, e_q_deg, e_alpha_deg},
impedance_error {position_n, arm_nm}, final_e_z_m, peak_e_p_m, torque_activity_nm. A metric is None if its part
of the flight was not completed: errors before a crash do not characterise the controller.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from companion.analysis.flat import flat
from companion.campaigns.compare.grid import ABLATED, ADAPTATION_OFF, is_ablation
from companion.campaigns.compare.paper_results import PrintedFlight, printed
from companion.campaigns.cost import cost_of, flight_cost
from companion.campaigns.runner import Row, catches

COMPLETED = "completed"
REFERENCE = "/".join(ABLATED)
"""Label of the variant from which the difference of all others is shown."""
MISSED = "missed"
"""Key in `Group.failures` for flights that were completed without the payload, whatever the companion reported."""
FIGURES = (
    *(f"rms.{part}.{key}" for part in ("pre", "post") for key in ("e_p_m", "e_q_deg", "e_alpha_deg")),
    "impedance_error.position_n",
    "impedance_error.arm_nm",
    "final_e_z_m",
    "final_abs_e_z_m",
    "peak_e_p_m",
    "torque_activity_nm",
)
"""Metrics that are summarised: dotted keys of a row, and the absolute final height error, whose sign does not matter."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Percentiles of a metric over seeds, by nearest rank. A failed flight counts as worse than all others."""

    p50: float | None
    """Median; None if half of the flights or more failed."""
    p95: float | None
    """95th percentile; None if more than one flight in twenty failed."""
    flights: int
    """Number of flights, failed ones included."""


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
        """Label of the variant, `law/preset`."""
        return f"{self.controller}/{self.preset}"

    def values(self, name: str) -> list[float]:
        """Return the value of one of `FIGURES` for each flight: infinite if the flight failed before its value was known. A
        completed flight without a value is left out, and one whose payload was not caught in all but the errors before the catch.
        """
        before = name.startswith("rms.pre.")
        found = ((row, figure(row, name)) for row in self.rows if before or _failure(row) != MISSED)
        return [math.inf if value is None else value for row, value in found if value is not None or _ended_early(row)]

    def spread(self, name: str) -> Spread | None:
        """Return the percentiles of one of `FIGURES`; None if no flight has a value."""
        values = sorted(self.values(name))
        if not values or math.isinf(values[0]):
            return None
        return Spread(_percentile(values, 0.5), _percentile(values, 0.95), len(values))

    @property
    def cost(self) -> float:
        """Cost of the flights, m."""
        return cost_of([flight_cost(row) for row in self.rows])

    @property
    def failures(self) -> dict[str, int]:
        """Number of flights, by outcome, that were not completed with the payload on board."""
        return dict(Counter(what for row in self.rows if (what := _failure(row)) is not None))

    @property
    def failure_text(self) -> str:
        """Failures as text, such as `crashed 2 of 5`; empty if there are none."""
        return ", ".join(f"{what} {count} of {len(self.rows)}" for what, count in self.failures.items())

    @property
    def printed(self) -> PrintedFlight | None:
        """Results printed in the paper for this group; None if there are none."""
        return None if is_ablation(self.preset) else printed(self.controller, self.payload_kg)

    def jsonable(self) -> dict[str, Any]:
        """Return the group as in compare.json."""
        spreads = {name: self.spread(name) for name in FIGURES}
        of, (false, undetected) = self.printed, catches(self.rows)
        return {
            "controller": self.controller,
            "preset": self.preset,
            "payload_kg": self.payload_kg,
            "model_error": self.model_error,
            "flights": len(self.rows),
            "completed": sum(row["outcome"] == COMPLETED for row in self.rows),
            "failures": self.failures,
            "false_catches": false,
            "undetected_catches": undetected,
            "cost_m": self.cost,
            "p50": _nested({name: None if spread is None else spread.p50 for name, spread in spreads.items()}),
            "p95": _nested({name: None if spread is None else spread.p95 for name, spread in spreads.items()}),
            "printed": of and {"controller": of.title, "pre": asdict(of.pre), "post": of.post and asdict(of.post)},
        }


def aggregate(rows: Iterable[Row]) -> list[Group]:
    """Group the rows by controller, preset, payload and model error, in order of first appearance."""
    groups: dict[tuple[str, str, float, float], list[Row]] = {}
    for row in rows:
        key = (row["controller"], row["preset"], row["payload_kg"], row["model_error"])
        groups.setdefault(key, []).append(row)
    return [Group(*key, group) for key, group in groups.items()]


def _ended_early(row: Row) -> bool:
    return bool(row["outcome"] != COMPLETED)


def _percentile(values: Sequence[float], share: float) -> float | None:
    """Return the percentile of sorted values by nearest rank, `share` from 0 to 1; None if it is infinite."""
    value = values[math.ceil(share * len(values)) - 1]
    return value if math.isfinite(value) else None


def _failure(row: Row) -> str | None:
    if _ended_early(row):
        return str(row["outcome"])
    return MISSED if row["payload_kg"] > 0 and not row["caught"] else None


@dataclass(frozen=True, slots=True)
class Pairs:
    """Flights of two variants in the same laboratories, with the same payload and model error."""

    group: Group
    base_m_this_m: Sequence[tuple[float, float]]
    """RMS of ||e_p|| after the catch in m, first with the variant compared with, then with this one; infinite if the flight failed.
    Pairs with two failures or a missed payload are left out.
    """

    @property
    def better(self) -> int:
        """Number of pairs in which this variant has the smaller error."""
        return sum(this < base for base, this in self.base_m_this_m)

    @property
    def p_value(self) -> float:
        """Two-sided p-value of the sign test: the probability of a count at least as uneven as `better` if both were equally likely
        to be better.
        """
        n = sum(this != base for base, this in self.base_m_this_m)
        return min(1.0, 2 * next(itertools.islice(_tosses(n), min(self.better, n - self.better), None)) / (1 << n))

    @property
    def difference_95(self) -> tuple[float, float, float] | None:
        """Median of this variant's error minus the other's in m, and its 95 % confidence interval; None for fewer than six pairs."""
        return median_95([this - base for base, this in self.base_m_this_m])

    def p50(self, part: int) -> float | None:
        """Return the median error of the variant compared with (0) or of this one (1); None if the median flight failed."""
        return _percentile(sorted(pair[part] for pair in self.base_m_this_m), 0.5)


def median_95(values: Iterable[float]) -> tuple[float, float, float] | None:
    """Return the median of some values and its 95 % confidence interval: the medians that the sign test does not reject. None for
    fewer than six values, which have no such interval.
    """
    ordered = sorted(values)
    n = len(ordered)
    outside = next(k for k, count in enumerate(_tosses(n)) if 40 * count > 1 << n)
    return (ordered[(n - 1) // 2], ordered[outside - 1], ordered[n - outside]) if outside else None


def adaptation_pairs(groups: Sequence[Group]) -> list[Pairs]:
    """Return the pairs of every variant with its adaptation that was also flown without it."""
    found = []
    for on in groups:
        found += [_pairs(off, on) for off in groups if off.label == f"{on.label}{ADAPTATION_OFF}" and _alike(off, on)]
    return [pairs for pairs in found if pairs.base_m_this_m]


def pairs_with_reference(groups: Sequence[Group]) -> dict[int, Pairs]:
    """Return, by `id` of each other group, its pairs with the adaptive law's `recommended`, or else with the first variant."""
    labels = [group.label for group in groups]
    label = REFERENCE if REFERENCE in labels else next(iter(labels), "")
    base = [group for group in groups if group.label == label]
    return {
        id(group): _pairs(one, group) for group in groups for one in base if group is not one and _alike(one, group)
    }


def _alike(one: Group, other: Group) -> bool:
    return (one.payload_kg, one.model_error) == (other.payload_kg, other.model_error)


def _pairs(base: Group, this: Group) -> Pairs:
    base_m, this_m = _post_by_seed(base), _post_by_seed(this)
    pairs = [(base_m[seed], this_m[seed]) for seed in base_m if seed in this_m]
    return Pairs(this, [pair for pair in pairs if any(map(math.isfinite, pair))])


def _tosses(n: int) -> Iterator[int]:
    """Yield for k = 0, 1, ... how many of the 2^n series of n tosses of a coin have at most k heads."""
    with_k = itertools.accumulate(range(n), lambda count, k: count * (n - k) // (k + 1), initial=1)
    return itertools.accumulate(with_k)


def _post_by_seed(group: Group) -> dict[int, float]:
    known = {row["seed"]: row["rms"]["post"]["e_p_m"] for row in group.rows if _failure(row) != MISSED}
    return {seed: math.inf if value is None else value for seed, value in known.items()}


def figure(row: Row, name: str) -> float | None:
    """Return the value of one of `FIGURES` for a row."""
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
