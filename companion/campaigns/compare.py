"""Comparison of controllers: which flights a grid has, and what their rows add up to. Pure; flying is sitl.campaign's.

A *row* is what one flight came to, as plain data: controller, preset, payload_kg, seed, outcome, error, catch_t_s, rms {pre|post:
e_p_m, e_q_deg, e_alpha_deg}, impedance_error {position_n, arm_nm}, final_e_z_m, peak_e_p_m, torque_activity_nm. A figure is None
where that part of the flight was not flown to its end: an error up to a crash says nothing about the controller's errors.
"""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from companion.campaigns.printed import PrintedFlight, printed

Row = dict[str, Any]
COMPLETED = "completed"
MISSED = "missed"
"""In `Cell.failures`: the flight was completed, but the payload not caught."""

ABLATED = ("adaptive", "recommended")
_LESS = " - "
ABLATIONS: dict[str, tuple[str, ...]] = {
    # rho = min(H . b + zeta, rho_max): nothing is left of what H and zeta learn.
    "adaptation off": ("controller.rho_max=1.0e-9",),
    "H3 uncapped": ("controller.acceleration_cap=1.0e9",),
    "S = I": ("controller.row_weights_s=[1, 1, 1, 0, 0, 0, 1, 1]",),
    "base feed-forward off": ("controller.force_feedforward_xyz=[0, 0, 0]",),
    # A force that the base carries by feed-forward is one that it does not give way to.
    "base rows on": ("controller.base_compliance_xyz=[1, 1, 1]", "controller.force_feedforward_xyz=[0, 0, 0]"),
    "F_d off": ("controller.desired_force_time_s=null",),
    "disturbance observer off": ("controller.disturbance_time_xyz_s=[0, 0, 0]",),
    "lead off": ("controller.feedforward_lead_s=0",),
    "arm inertia and friction off": ("controller.arm_inertia_nominal=false", "controller.arm_friction_share=0"),
}
"""What is taken from `ABLATED`, as overrides of its controller section. Attitude rows stay masked: PX4 closes that loop."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One line of the table: a law with its gains."""

    controller: str
    preset: str
    """As the table names it: a preset, or a preset less something."""
    base_preset: str
    """The preset that is loaded."""
    overrides: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Law and gains."""
        return f"{self.controller}/{self.preset}"

    @property
    def short_label(self) -> str:
        """As below the line that it took something from."""
        return _short_label(self.controller, self.preset)

    @property
    def ablation(self) -> bool:
        """Whether something was taken away."""
        return _LESS in self.preset


@dataclass(frozen=True, slots=True)
class Flight:
    """One flight of the grid."""

    variant: int
    """Position in the list of variants."""
    payload_kg: float
    seed: int


def variants_of(
    available: dict[str, tuple[str, ...]], controllers: Sequence[str], presets: Sequence[str], ablation: bool
) -> list[Variant]:
    """The lines of the table.

    A law that has some of the presets asked for flies those, one that has none of them flies all of its own.

    Args:
        available: presets of each law.
        controllers: laws asked for; empty: all.
        presets: presets asked for; empty: all.
        ablation: add what is left of `ABLATED` when one thing at a time is taken away.

    Raises:
        ValueError: no such law or preset, or nothing to ablate; one line.
    """
    for law in controllers:
        if law not in available:
            raise ValueError(f"--controllers {law}: no such controller; available: {', '.join(available)}")
    laws = list(dict.fromkeys(controllers)) or list(available)
    known = list(dict.fromkeys(preset for law in laws for preset in available[law]))
    for preset in presets:
        if preset not in known:
            raise ValueError(f"--presets {preset}: no such preset of {', '.join(laws)}; available: {', '.join(known)}")
    found = []
    for law in laws:
        chosen = [preset for preset in available[law] if preset in presets] or list(available[law])
        if ablation and law == ABLATED[0] and ABLATED[1] not in chosen:
            chosen.append(ABLATED[1])  # nothing can be seen beside nothing
        for preset in chosen:
            found.append(Variant(law, preset, preset))
            if ablation and (law, preset) == ABLATED:
                found += [Variant(law, f"{preset}{_LESS}{what}", preset, less) for what, less in ABLATIONS.items()]
    if ablation and not any(variant.ablation for variant in found):
        raise ValueError(f"--ablation: takes things from {'/'.join(ABLATED)}, but --controllers leaves it out")
    return found


def _short_label(controller: str, preset: str) -> str:
    """` - F_d off` of an ablation, else law and gains."""
    _, less, what = preset.partition(_LESS)
    return f"{less}{what}" if less else f"{controller}/{preset}"


def flights_of(variants: Sequence[Variant], payloads_kg: Sequence[float], seeds: Sequence[int]) -> list[Flight]:
    """The grid in the order of the table: payload, variant, seed."""
    return [
        Flight(variant, payload_kg, seed)
        for payload_kg in payloads_kg
        for variant in range(len(variants))
        for seed in seeds
    ]


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and sample standard deviation over seeds."""

    mean: float
    std: float | None
    """None: a single value has none."""


@dataclass(frozen=True, slots=True)
class Cell:
    """All seeds of one variant at one payload."""

    controller: str
    preset: str
    payload_kg: float
    flights: int
    failures: dict[str, int]
    """How many flights ended otherwise than completed with the payload on board, by outcome."""
    figures: dict[str, Spread | None]
    """By name, see `FIGURES`; over the flights that have the figure."""
    printed: PrintedFlight | None

    @property
    def label(self) -> str:
        """Law and gains."""
        return f"{self.controller}/{self.preset}"

    @property
    def short_label(self) -> str:
        """As below the line that it took something from."""
        return _short_label(self.controller, self.preset)

    @property
    def failure_text(self) -> str:
        """`crashed 2 of 5`; empty if every flight was completed with the payload on board."""
        return ", ".join(f"{what} {count} of {self.flights}" for what, count in self.failures.items())

    def jsonable(self) -> dict[str, Any]:
        """As in compare.json."""
        of = self.printed
        return {
            "controller": self.controller,
            "preset": self.preset,
            "payload_kg": self.payload_kg,
            "flights": self.flights,
            "completed": self.flights - sum(count for what, count in self.failures.items() if what != MISSED),
            "failures": dict(self.failures),
            "mean": _nested({name: None if s is None else s.mean for name, s in self.figures.items()}),
            "std": _nested({name: None if s is None else s.std for name, s in self.figures.items()}),
            "printed": None
            if of is None
            else {
                "controller": of.title,
                "pre": {"e_p_m": of.pre.e_p_m, "e_q_deg": of.pre.e_q_deg},
                "post": None if of.post is None else {"e_p_m": of.post.e_p_m, "e_q_deg": of.post.e_q_deg},
            },
        }


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
"""What is averaged: paths in a row, and the size of the final height error, which averages of either sign would hide."""


def aggregate(rows: Iterable[Row]) -> list[Cell]:
    """Rows of the same controller, preset and payload together, in the order of their first appearance."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["controller"], row["preset"], row["payload_kg"]), []).append(row)
    return [_cell(*key, group) for key, group in groups.items()]


def _cell(controller: str, preset: str, payload_kg: float, rows: list[Row]) -> Cell:
    failures = Counter(what for row in rows if (what := _failure(row)) is not None)
    figures = {name: _spread([value for row in rows if (value := figure(row, name)) is not None]) for name in FIGURES}
    paper = None if _LESS in preset else printed(controller, payload_kg)
    return Cell(controller, preset, payload_kg, len(rows), dict(failures), figures, paper)


def _failure(row: Row) -> str | None:
    if row["outcome"] != COMPLETED:
        return str(row["outcome"])
    return MISSED if row["payload_kg"] > 0 and row["catch_t_s"] is None else None


def figure(row: Row, name: str) -> float | None:
    """One of `FIGURES` of a row."""
    if name == "final_abs_e_z_m":
        return None if row["final_e_z_m"] is None else abs(row["final_e_z_m"])
    value: Any = row
    for key in name.split("."):
        value = value[key]
    return None if value is None else float(value)


def _spread(values: list[float]) -> Spread | None:
    if not values:
        return None
    return Spread(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


def flat(row: Row) -> Iterator[tuple[str, Any]]:
    """Names and values of a row without nesting, in the row's order, for CSV."""
    for key, value in row.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{below}", found) for below, found in flat(value))
        else:
            yield key, value


def _nested(figures: dict[str, float | None]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for name, value in figures.items():
        *above, last = name.split(".")
        place = nested
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
    return nested
