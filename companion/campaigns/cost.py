"""The cost of flights, in metres: one number by which `companion tune` searches and `companion compare` ranks, the same for every law.

The cost of a flight is the sum of the terms in `TERMS`, at most 1, or the cost of its failure. The cost of several flights is the mean
of their mean and of the mean of the worst quarter (conditional value at risk), so that rare bad flights count.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from companion.analysis.flat import flat
from companion.campaigns.runner import Row
from companion.model.types import Outcome


@dataclass(frozen=True, slots=True)
class Term:
    """A metric of a flight with its weight in the cost."""

    key: str
    """Dotted key of a row (see `companion.campaigns.compare.aggregate`)."""
    weight: float
    unit: str
    text: str


TERMS = (
    Term("rms.post.e_p_m", 1.0, "", "RMS of the position error after the catch"),
    Term("rms.pre.e_p_m", 0.3, "", "RMS of the position error before the catch"),
    Term("peak_e_p_m", 0.2, "", "largest position error"),
    Term("rms.post.e_q_deg", 0.001, "m/deg", "RMS of the attitude error after the catch"),
    Term(
        "impedance_error.arm_nm",
        0.1,
        "m/(N m)",
        "deviation of the arm from one target impedance, the same for every law",
    ),
    Term("torque_activity_nm", 0.5, "m/(N m)", "RMS change of the joint torques from tick to tick"),
)
COMPLETED_MAX = 1.0
"""Largest cost of a completed flight, before `MISSED` is added."""
MISSED = 0.3
"""Additional cost of a flight that missed its payload."""
ABORTED, LOST = 1.0, 2.0
"""Cost of an aborted flight; cost of a flight that crashed, was lost or ended by an error."""
WORST_SHARE, WORST_WEIGHT = 0.25, 0.5
"""Fraction of the flights that count as the worst, and the weight of their mean."""


def terms_of(row: Row) -> dict[str, float]:
    """Return what each term contributes to the cost of a completed flight, by its key.

    Without a payload to catch, the whole flight takes the place of the part after the catch. A metric that was not measured is left
    out.
    """
    values: Mapping[str, Any] = dict(flat(row))
    expected, caught = row["payload_kg"] > 0, row["caught"]
    found = {}
    for term in TERMS:
        key = term.key if caught or expected else term.key.replace(".post.", ".pre.")
        value = values[key]
        if value is not None:
            found[term.key] = term.weight * value
    return found


def flight_cost(row: Row) -> float:
    """Return the cost of a flight, m."""
    if row["error"] or row["outcome"] not in (Outcome.COMPLETED.value, Outcome.ABORTED.value):
        return LOST
    if row["outcome"] == Outcome.ABORTED.value:
        return ABORTED
    missed = MISSED if row["payload_kg"] > 0 and not row["caught"] else 0.0
    return min(COMPLETED_MAX, missed + sum(terms_of(row).values()))


def cost_of(costs: Sequence[float]) -> float:
    """Return the cost of several flights from the cost of each, m."""
    worst = sorted(costs, reverse=True)[: math.ceil(WORST_SHARE * len(costs))]
    return (1.0 - WORST_WEIGHT) * math.fsum(costs) / len(costs) + WORST_WEIGHT * math.fsum(worst) / len(worst)
