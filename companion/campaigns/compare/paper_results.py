"""Results printed in the paper's table "Tracking Performance Comparison in terms of RMS errors" (paper.tex, RMS_table)."""

from __future__ import annotations

from dataclasses import dataclass

SOURCE = "paper.tex, RMS_table"


@dataclass(frozen=True, slots=True)
class Printed:
    """Results of one flight before or after the catch."""

    e_p_m: float
    """RMS of ||e_p||."""
    e_q_deg: float
    """RMS of ||e_q||. The table states no unit; the plots in the same section use degrees."""


@dataclass(frozen=True, slots=True)
class PrintedFlight:
    """Results printed for one controller with one payload."""

    title: str
    """The controller's name in the table's header."""
    pre: Printed
    post: Printed | None
    """Results after the catch; None where the paper prints "Crashed"."""


_CSC, _PSC, _PROPOSED = "CSC, Cataldi et al.", "PSC, Wang et al.", "proposed"
TABLE: dict[tuple[str, float], PrintedFlight] = {
    ("csc", 0.1): PrintedFlight(_CSC, Printed(0.0998, 3.2985), Printed(0.2300, 3.7644)),
    ("csc", 0.2): PrintedFlight(_CSC, Printed(0.0989, 3.0888), Printed(0.2927, 3.8446)),
    ("csc", 0.3): PrintedFlight(_CSC, Printed(0.0932, 2.8178), None),
    ("psc", 0.1): PrintedFlight(_PSC, Printed(0.0837, 3.2516), Printed(0.1497, 3.1340)),
    ("psc", 0.2): PrintedFlight(_PSC, Printed(0.0928, 2.5393), Printed(0.2236, 3.2612)),
    ("psc", 0.3): PrintedFlight(_PSC, Printed(0.0990, 2.4189), Printed(0.2865, 3.5753)),
    ("adaptive", 0.1): PrintedFlight(_PROPOSED, Printed(0.0858, 2.8543), Printed(0.0984, 3.0710)),
    ("adaptive", 0.2): PrintedFlight(_PROPOSED, Printed(0.0906, 2.6097), Printed(0.1654, 3.1190)),
    ("adaptive", 0.3): PrintedFlight(_PROPOSED, Printed(0.0726, 2.6866), Printed(0.1728, 3.2031)),
}
"""Results by law and payload in kg, each of a single flight with the paper's hardware."""


def printed(controller: str, payload_kg: float) -> PrintedFlight | None:
    """Return the paper's results for a law and a payload, or None if it has none."""
    return TABLE.get((controller, round(payload_kg, 6)))
