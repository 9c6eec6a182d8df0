"""Many flights of one mission in worlds drawn at random: what came of them, what it depended on, and the worst ones as named cases.

A row is a flight's, as `companion robustness --json` prints it; the keys are described in docs/robustness.md.
"""

from __future__ import annotations

import csv
import itertools
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.config.base import Model, NonNegative
from companion.config.document import ConfigError, problem_lines
from companion.config.explain import validate
from companion.config.yaml_strict import read_document
from companion.config.yaml_text import flow_text
from companion.model.types import Outcome
from companion.sitl_config.world import World

Row = dict[str, Any]

WORST = 10
"""So many are kept."""
WORSE_THAN_KEPT = 1.25
"""A kept case may have so many times its kept error."""
SAFE = (Outcome.COMPLETED.value, Outcome.ABORTED.value, Outcome.REFUSED.value)
"""Outcomes that end with the machine standing on the floor in one piece."""
_GRAVITY = {Outcome.CRASHED.value: 4, Outcome.LOST.value: 3, Outcome.REFUSED.value: 2, Outcome.ABORTED.value: 1}


class Kept(Model):
    """What came of a case when it was kept."""

    outcome: Outcome
    caught: bool
    e_p_m: NonNegative | None = None
    """RMS after the catch, of the whole flight if nothing was caught; absent if the mission was not completed."""


class Case(Model):
    """One world that was hard to fly in."""

    name: str
    world: World
    kept: Kept

    def knobs(self) -> dict[str, Any]:
        """The world's keys that the case sets."""
        knobs: dict[str, Any] = self.world.model_dump(mode="json", exclude_unset=True)
        return knobs


class Cases(Model):
    """A file of cases."""

    mission: str
    controller: str
    preset: str
    cases: tuple[Case, ...]

    def named(self, names: Sequence[str]) -> tuple[Case, ...]:
        """The cases of these names, in the order of the file; all if none is named.

        Raises:
            ConfigError: there is no such case.
        """
        known = [case.name for case in self.cases]
        missing = [name for name in names if name not in known]
        if missing:
            raise ConfigError([f"--case {name}: no such case; there are: {', '.join(known)}" for name in missing])
        return tuple(case for case in self.cases if not names or case.name in names)


def read_cases(path: Path) -> Cases:
    """Read a file of cases.

    Raises:
        ConfigError: one line per problem, with file, line and column.
    """
    document = read_document(path)
    cases = validate(Cases, document)
    if cases is None:
        raise ConfigError(problem_lines(document.problems))
    names = [case.name for case in cases.cases]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError([f"{path}: cases: every name once, but there are two of {', '.join(twice)}"])
    return cases


def write_cases(cases: Cases, path: Path, remark: str) -> None:
    """Write a file of cases that `read_cases` reads.

    Args:
        cases: what to write.
        path: where to.
        remark: lines for the head of the file.
    """
    lines = [f"# {line}".rstrip() for line in remark.splitlines()]
    lines += [*(f"{key}: {flow_text(getattr(cases, key))}" for key in ("mission", "controller", "preset")), "cases:"]
    for case in cases.cases:
        lines += ["", f"  - name: {flow_text(case.name)}", "    world:"]
        lines += [f"      {key}: {flow_text(value)}" for key, value in case.knobs().items()]
        lines.append(f"    kept: {flow_text(case.kept.model_dump(mode='json', exclude_none=True))}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def overrides_of(knobs: Mapping[str, Any]) -> list[str]:
    """The same world as `--set` options."""
    return [
        f"world.{key}={flow_text(value).replace(' ', '') if key != 'faults' else flow_text(value)}"
        for key, value in knobs.items()
    ]


def fly_command(mission: str, controller: str, preset: str, knobs: Mapping[str, Any], sets: Sequence[str] = ()) -> str:
    """What flies the same world over real wires."""
    words = ["companion", "fly", mission, "--sitl", "--controller", controller, "--preset", preset]
    return shlex.join([*words, "--set", *sets, *overrides_of(knobs)])


# -- what a draw was ---------------------------------------------------------------------------------------------------

DRIVERS: dict[str, str] = {
    "payload_kg": "payload, kg",
    "throw_speed_m_s": "horizontal throw speed, m/s",
    "throw_from_deg": "thrown from, deg off the line",
    "descent_m_s": "descent at the catch, m/s",
    "catch_x_m": "catch point, m along the line",
    "hover_thrust_error": "hover-thrust error",
    "link1_mass_error": "mass error of link 1",
    "link2_mass_error": "mass error of link 2",
    "setpoint_delay_s": "setpoint delay, s",
    "arm_delay_s": "arm delay, s",
    "rotor_lag_s": "rotor lag, s",
    "wind_speed_m_s": "wind, m/s",
    "force_bias_n": "bias of the force sensor, N",
    "force_lost_s": "force sensor lost at, s",
}
"""What was drawn, as single numbers, each with a label for people."""


def drivers(knobs: Mapping[str, Any]) -> dict[str, float | None]:
    """What was drawn as single numbers, by the keys of `DRIVERS`; None where it does not apply."""
    vx, vy, vz = knobs.get("throw_velocity_m_s", (math.nan,) * 3)
    wx, wy, _ = knobs.get("wind_m_s", (math.nan,) * 3)
    link1, link2 = knobs.get("link_mass_error", (math.nan,) * 2)
    faults = knobs.get("faults", ())
    lost = next((float(fault["t_s"]) for fault in faults if fault["kind"] == "force_loss"), None)
    values: dict[str, float | None] = {
        "payload_kg": knobs.get("payload_kg"),
        "throw_speed_m_s": math.hypot(vx, vy),
        # 0: from ahead, 180: from behind.
        "throw_from_deg": abs(math.degrees(math.atan2(-vy, -vx))),
        "descent_m_s": -vz,
        "catch_x_m": knobs.get("catch_at_m", (None,))[0],
        "hover_thrust_error": knobs.get("hover_thrust_error"),
        "link1_mass_error": link1,
        "link2_mass_error": link2,
        "setpoint_delay_s": knobs.get("setpoint_delay_s"),
        "arm_delay_s": knobs.get("arm_delay_s"),
        "rotor_lag_s": knobs.get("rotor_lag_s"),
        "wind_speed_m_s": math.hypot(wx, wy),
        "force_bias_n": math.hypot(*knobs["force_bias_n"]) if "force_bias_n" in knobs else None,
        "force_lost_s": lost,
    }
    return {key: None if value is None or math.isnan(value) else float(value) for key, value in values.items()}


def sensor_of(row: Row) -> str:
    """What the force sensor was like when the payload came: biased, lost later, or missing."""
    if drivers(row["world"])["force_lost_s"] is None:
        return "biased"
    return "lost after the catch" if row["felt"] else "missing at the catch"


def name_of(knobs: Mapping[str, Any]) -> str:
    """What is hard about a world, in a few words: `heavy_fast_from_behind_slow_setpoints`."""
    d = drivers(knobs)

    def beyond(key: str, middle: float, end: float) -> float:
        """0 at the middle of the range, 1 at its hard end."""
        value = d[key]
        return 0.0 if value is None else (value - middle) / (end - middle)

    words: list[tuple[float, str]] = [
        (beyond("setpoint_delay_s", 0.03, 0.06), "slow_setpoints"),
        (beyond("arm_delay_s", 0.006, 0.01), "slow_arm"),
        (beyond("rotor_lag_s", 0.04, 0.06), "slow_rotors"),
        (beyond("wind_speed_m_s", 1.5, 3.0), "windy"),
        (beyond("hover_thrust_error", 0.0, 0.1), "hover_too_high"),
        (beyond("hover_thrust_error", 0.0, -0.1), "hover_too_low"),
        (beyond("catch_x_m", 0.0, 1.0), "caught_late"),
        (beyond("catch_x_m", 0.0, -1.0), "caught_early"),
        (beyond("force_bias_n", 6.0, 12.0), "biased"),
    ]
    head = []
    payload = beyond("payload_kg", 0.225, 0.4)
    head += ["heavy"] if payload > 0.4 else ["light"] if payload < -0.4 else []
    speed = beyond("throw_speed_m_s", 2.25, 4.0)
    head += ["fast"] if speed > 0.4 else ["gentle"] if speed < -0.4 else []
    from_deg = d["throw_from_deg"]
    if from_deg is not None:
        left = knobs["throw_velocity_m_s"][1] < 0
        side = "left" if left else "right"
        head.append(f"from_{'ahead' if from_deg < 45 else 'behind' if from_deg > 135 else side}")
    if d["force_lost_s"] is not None:
        head.append("no_force" if d["force_lost_s"] == 0.0 else "force_lost")
    hard = sorted((word for word in words if word[0] > 0.4), reverse=True)[:2]
    return "_".join([*head, *(text for _, text in hard)]) or "plain"


# -- what came of it ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Third:
    """A third of the payloads."""

    low_kg: float
    high_kg: float
    flights: int
    caught: int
    p50_m: float | None
    """Of the RMS of e_p after the catch, flights that caught and completed."""
    p90_m: float | None
    max_m: float | None


def outcomes(rows: Sequence[Row]) -> dict[str, int]:
    """How many ended how, by outcome."""
    names = [outcome.value for outcome in Outcome]
    counted = {name: sum(row["outcome"] == name for row in rows) for name in names}
    return {name: count for name, count in counted.items() if count}


def graded(rows: Sequence[Row]) -> list[Row]:
    """Flights that caught the payload and completed: the distribution of e_p is theirs."""
    return [
        row for row in rows if row["outcome"] == Outcome.COMPLETED.value and row["caught"] and row["e_p_m"] is not None
    ]


def thirds(rows: Sequence[Row]) -> list[Third]:
    """Flights by payload, in three parts of the same width."""
    payloads = [row["world"]["payload_kg"] for row in rows if "payload_kg" in row["world"]]
    if not payloads:
        return []
    edges = np.linspace(min(payloads), max(payloads), 4)
    found = []
    for part, (low, high) in enumerate(itertools.pairwise(edges)):
        these = [
            row
            for row in rows
            if low <= row["world"]["payload_kg"] < high or (part == 2 and row["world"]["payload_kg"] == high)
        ]
        errors = [row["e_p_m"] for row in graded(these)]
        p50, p90, most = (float(v) for v in np.percentile(errors, [50, 90, 100])) if errors else (None, None, None)
        caught = sum(bool(row["caught"]) for row in these)
        found.append(Third(float(low), float(high), len(these), caught, p50, p90, most))
    return found


def influence(rows: Sequence[Row]) -> list[tuple[str, float]]:
    """Rank correlation (Spearman) of e_p after the catch with each thing drawn, the strongest first."""
    flown = graded(rows)
    known = [drivers(row["world"]) for row in flown]
    found = []
    for key in DRIVERS:
        pairs = [(d[key], row["e_p_m"]) for d, row in zip(known, flown, strict=True) if d[key] is not None]
        x, y = np.array([p[0] for p in pairs], dtype=np.float64), np.array([p[1] for p in pairs], dtype=np.float64)
        if len(pairs) >= 10 and np.ptp(x) > 0 and np.ptp(y) > 0:
            found.append((key, float(np.corrcoef(_ranks(x), _ranks(y))[0, 1])))
    return sorted(found, key=lambda item: -abs(item[1]))


def _ranks(values: Any) -> Any:
    """Ranks from 0; equal values share theirs."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ends = np.cumsum(counts)
    return (ends - (counts + 1) / 2.0)[inverse]


def hardness(row: Row) -> tuple[int, float]:
    """For sorting: how it ended, then its error."""
    return _GRAVITY.get(row["outcome"], 0), row["e_p_m"] if row["e_p_m"] is not None else 0.0


def worst(rows: Sequence[Row], count: int = WORST) -> list[Row]:
    """The hardest flights, the worst first; of the same hardness the earlier draw."""
    return sorted(rows, key=lambda row: (tuple(-part for part in hardness(row)), row["number"] or 0))[:count]


def as_cases(rows: Sequence[Row]) -> tuple[Case, ...]:
    """Rows as cases to be kept; draws get a name that says what is hard about them."""
    taken: dict[str, int] = {}
    cases = []
    for row in rows:
        name = row["name"] if row["number"] is None else name_of(row["world"])
        taken[name] = taken.get(name, 0) + 1
        unique = name if taken[name] == 1 else f"{name}_{taken[name]}"
        completed = row["outcome"] == Outcome.COMPLETED.value
        error_m = row["e_p_m"] if completed else None
        kept = Kept(
            outcome=Outcome(row["outcome"]),
            caught=row["caught"],
            e_p_m=None if error_m is None else round(error_m, 4),
        )
        cases.append(Case(name=unique, world=World.model_validate(row["world"]), kept=kept))
    return tuple(cases)


def held_against(row: Row, kept: Kept) -> str | None:
    """What is worse than when the case was kept; None if nothing is."""
    if row["outcome"] != kept.outcome.value and row["outcome"] != Outcome.COMPLETED.value:
        return f"{row['outcome']} ({row['why'] or row['error'] or 'no event tells why'}), kept as {kept.outcome.value}"
    if row["outcome"] not in SAFE:
        return f"{row['outcome']} ({row['why'] or row['error']})"
    if kept.caught and not row["caught"]:
        return "the payload was not caught any more"
    if kept.e_p_m is not None and row["e_p_m"] is not None and row["e_p_m"] > WORSE_THAN_KEPT * kept.e_p_m:
        return f"e_p {row['e_p_m']:.4f} m, more than {WORSE_THAN_KEPT:g} times the {kept.e_p_m:.4f} m that were kept"
    return None


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """One line per flight: what came of it, then what was drawn; an unknown value is empty."""
    figures = [key for key in rows[0] if key not in ("world", "events")]
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer: Any = csv.writer(file)
        writer.writerow([*figures, "events", "seed", *DRIVERS])
        for row in rows:
            known = drivers(row["world"])
            drawn = [known[key] for key in DRIVERS]
            writer.writerow([*(row[key] for key in figures), " ".join(row["events"]), row["world"].get("seed"), *drawn])
