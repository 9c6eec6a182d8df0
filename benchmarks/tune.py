"""Tunes the gains of one law in the fast closed loop by CMA-ES; every law has the same cost, flights and budget.

    python -m benchmarks.tune psc --world lab --budget 300 --out mine.yaml

Cost of a flight: ||e_p|| after the catch + 0.3 of that before it + 0.1 m/(N m) of the arm's impedance error against one common target
(`companion.analysis.metrics.impedance_error`) + 0.5 m/(N m) of the torque activity, all RMS. A flight that is not completed with the
payload on board costs `FAILURE_COST`. Cost of a point: mean over laboratories 1 to --laboratories, with 0.1, 0.2 and 0.3 kg in turn. A
found point is judged on laboratories that the search has not seen, beside the point it started from. Parameters are searched on a
logarithmic scale; one that ends near a bound is named, so that the bound can be widened.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cma
import numpy as np
from pydantic import ValidationError

from companion.config.controller import LAWS
from companion.config.document import ConfigError
from companion.model.types import Outcome
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import fly_to_end, row_of, with_world

Gains = dict[str, Any]

MISSION = Path(__file__).parents[1] / "configs" / "missions" / "catch.yaml"
PAYLOADS_KG = (0.1, 0.2, 0.3)
BEFORE_SHARE, ARM_WEIGHT_M_NM, ACTIVITY_WEIGHT_M_NM, FAILURE_COST = 0.3, 0.1, 0.5, 1.0
HELD_OUT_FROM = 1001
"""First laboratory of the judgement."""
FIRST_STEP, NEAR_BOUND = 0.15, 0.03
"""Initial standard deviation, and what counts as near, as shares of the logarithmic range."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the search: a key of the controller file, all of it or some of its rows, which then share a value."""

    key: str
    low: float
    high: float
    rows: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Name in the output."""
        return f"{self.key}{list(self.rows) if self.rows else ''}"

    def read(self, gains: Gains) -> float:
        """Return its value in a controller file."""
        value = gains[self.key]
        return float(value[self.rows[0]] if self.rows else value)

    def write(self, gains: Gains, value: float) -> None:
        """Set it in a controller file."""
        if not self.rows:
            gains[self.key] = value
            return
        rows = list(gains[self.key])
        for row in self.rows:
            rows[row] = value
        gains[self.key] = rows


XY, Z, ARM = (0, 1), (2,), (6, 7)
_ATTITUDE = Parameter("attitude_filter_rad_s", 15.0, 150.0)
_EXTRAS = (
    Parameter("disturbance_time_xyz_s", 0.2, 5.0, XY),
    Parameter("disturbance_time_xyz_s", 0.2, 5.0, Z),
    Parameter("feedforward_lead_s", 0.01, 0.4),
    _ATTITUDE,
)
_CSC = (
    Parameter("stiffness_kp", 3.0, 150.0, XY),
    Parameter("damping_kd", 3.0, 60.0, XY),
    Parameter("stiffness_kp", 5.0, 600.0, Z),
    Parameter("damping_kd", 5.0, 150.0, Z),
    Parameter("inertia_md", 0.005, 0.3, ARM),
    Parameter("damping_kd", 0.1, 3.0, ARM),
    Parameter("stiffness_kp", 0.4, 20.0, ARM),
)
_PSC = (
    Parameter("position_kp_xyz", 1.0, 40.0, XY),
    Parameter("position_kd_xyz", 1.0, 20.0, XY),
    Parameter("position_ki_xyz", 0.05, 20.0, XY),
    Parameter("position_kp_xyz", 2.0, 200.0, Z),
    Parameter("position_kd_xyz", 1.0, 40.0, Z),
    Parameter("position_ki_xyz", 0.05, 100.0, Z),
    Parameter("arm_inertia_md", 0.005, 0.3, (0, 1)),
    Parameter("arm_damping_kd", 0.1, 3.0, (0, 1)),
    Parameter("arm_stiffness_kp", 0.4, 20.0, (0, 1)),
    Parameter("payload_time_s", 0.03, 2.0),
)
_ADAPTIVE = (
    Parameter("lambda_gain", 1.0, 30.0, XY),
    Parameter("lambda_gain", 2.0, 80.0, Z),
    Parameter("phi", 0.7, 6.0, XY),
    Parameter("phi", 0.7, 8.0, Z),
    Parameter("lambda_gain", 0.2, 3.0, ARM),
    Parameter("rho_max", 0.5, 20.0),
    Parameter("row_weights_s", 0.01, 1.0, ARM),
    Parameter("nu", 0.05, 50.0, (0, 1, 2, 3)),
)
_LOADS = (
    Parameter("load_rate_xyz", 0.3, 30.0, XY),
    Parameter("load_rate_xyz", 1.0, 200.0, Z),
    Parameter("moment_rate", 0.002, 0.3),
    Parameter("friction_rate", 0.01, 3.0),
)
SEARCHES: dict[str, tuple[str, str, tuple[Parameter, ...]]] = {
    "csc": ("csc", "tuned", (*_CSC, _ATTITUDE)),
    "csc_extras": ("csc", "tuned_extras", (*_CSC, *_EXTRAS)),
    "psc": ("psc", "tuned", (*_PSC, _ATTITUDE)),
    "psc_extras": ("psc", "tuned_extras", (*_PSC, *_EXTRAS)),
    "paper": ("adaptive", "paper", (*_ADAPTIVE, _ATTITUDE)),
    "model_free": ("adaptive", "model_free", (*_ADAPTIVE, *_LOADS, *_EXTRAS[2:])),
    "recommended": ("adaptive", "recommended", (*_ADAPTIVE, *_LOADS, *_EXTRAS)),
}
"""Search spaces: the law, the preset whose file gives the start and everything that is not searched, and the parameters."""


def gains_of(base: Gains, parameters: Sequence[Parameter], point: Sequence[float]) -> Gains:
    """Return the controller file of a point, with six digits; K_p of the adaptive law follows from the rest (gain_cond)."""
    gains = dict(base)
    for parameter, value in zip(parameters, point, strict=True):
        parameter.write(gains, float(f"{value:.6g}"))
    if gains["law"] == "adaptive":
        rows = zip(gains["damping_kd"], gains["inertia_md"], gains["phi"], strict=True)
        gains["stiffness_kp"] = [float(f"{(kd - md * phi) * phi:.6g}") for kd, md, phi in rows]
    return gains


def cost(config: SitlConfig, gains: Gains, laboratory: int) -> float:
    """Return the cost of one flight."""
    try:
        controller = LAWS[gains["law"]].model_validate(gains)
    except ValidationError:  # the law's own conditions refuse the point
        return FAILURE_COST
    world = {"seed": laboratory, "payload_kg": PAYLOADS_KG[laboratory % len(PAYLOADS_KG)]}
    flown = fly_to_end(with_world(config.model_copy(update={"controller": controller}), world))
    row, _ = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)
    before, after = row["rms"]["pre"]["e_p_m"], row["rms"]["post"]["e_p_m"]
    arm_nm, activity_nm = row["impedance_error"]["arm_nm"], row["torque_activity_nm"]
    if row["outcome"] != Outcome.COMPLETED.value or None in (before, after, arm_nm, activity_nm):
        return FAILURE_COST
    value = after + BEFORE_SHARE * before + ARM_WEIGHT_M_NM * arm_nm + ACTIVITY_WEIGHT_M_NM * activity_nm
    return min(FAILURE_COST, float(value))


class Judge:
    """Costs of points, flown over processes."""

    def __init__(self, config: SitlConfig, pool: ProcessPoolExecutor) -> None:
        self._config, self._pool = config, pool

    def means(self, candidates: Sequence[Gains], laboratories: Sequence[int]) -> list[float]:
        """Return the mean cost of each candidate over the same laboratories."""
        jobs = [(gains, laboratory) for gains in candidates for laboratory in laboratories]
        costs = np.array(list(self._pool.map(partial(cost, self._config), *zip(*jobs, strict=True))))
        return [float(mean) for mean in costs.reshape(len(candidates), len(laboratories)).mean(axis=1)]


def search(
    judge: Judge, base: Gains, parameters: Sequence[Parameter], laboratories: Sequence[int], budget: int, seed: int
) -> Gains:
    """Return the best controller file of `budget` points, the start included."""
    low = np.log([parameter.low for parameter in parameters])
    span = np.log([parameter.high for parameter in parameters]) - low
    start = (np.log([max(parameter.read(base), parameter.low) for parameter in parameters]) - low) / span

    def gains(point: Sequence[float]) -> Gains:
        return gains_of(base, parameters, np.exp(low + span * np.clip(point, 0.0, 1.0)).tolist())

    options = {"bounds": [0.0, 1.0], "seed": seed, "verbose": -9, "maxfevals": budget}
    strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.0, 1.0), FIRST_STEP, options)
    best, best_cost = gains(start), judge.means([gains(start)], laboratories)[0]
    print(f"   1/{budget}  cost {best_cost:.5f} (start)", file=sys.stderr, flush=True)
    while not strategy.stop():
        points = strategy.ask()
        costs = judge.means([gains(point) for point in points], laboratories)
        strategy.tell(points, costs)
        if min(costs) < best_cost:
            best_cost = min(costs)
            best = gains(points[costs.index(best_cost)])
        print(
            f"{1 + strategy.countevals:4d}/{budget}  cost {best_cost:.5f}  step {strategy.sigma:.3f}",
            file=sys.stderr,
            flush=True,
        )
    for parameter, at in zip(
        parameters, (np.log([parameter.read(best) for parameter in parameters]) - low) / span, strict=True
    ):
        if min(at, 1.0 - at) < NEAR_BOUND:
            print(f"{parameter.name} ended near a bound: {parameter.read(best):g}", file=sys.stderr)
    return best


def controller_yaml(gains: Gains, found: str) -> str:
    """Return a controller file as text."""
    lines = [
        "# yaml-language-server: $schema=../schema/controller.schema.json",
        "#",
        *(f"# {line}" for line in found.splitlines()),
        "schema_version: 1",
        f"law: {gains['law']}",
        f"preset: {gains['preset']}",
        "",
    ]
    for key, value in gains.items():
        if key in ("schema_version", "law", "preset") or value is None:
            continue
        if isinstance(value, bool):
            text = str(value).lower()
        else:
            text = "[" + ", ".join(f"{v:g}" for v in value) + "]" if isinstance(value, list) else f"{value:g}"
        lines.append(f"{key}: {text}")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(description="Tune one law on the fast closed loop.")
    parser.add_argument("search", choices=list(SEARCHES))
    parser.add_argument("--world", default="lab", help="lab, ideal or a world file (%(default)s)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--budget", type=int, default=300, help="points to try (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=6, help="flights per point (%(default)s)")
    parser.add_argument("--held-out", type=int, default=30, help="laboratories of the judgement (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the search (%(default)s)")
    parser.add_argument("--out", type=Path, help="controller file to write; absent: standard output")
    a = parser.parse_args(arguments)
    law, preset, parameters = SEARCHES[a.search]
    try:
        config = load_sitl(MISSION, controller_law=law, preset=preset, overrides=a.overrides, world=a.world)
    except ConfigError as error:
        print(f"tune: {error}", file=sys.stderr)
        return 2
    base = config.controller.model_dump(mode="json")
    with ProcessPoolExecutor(a.jobs) as pool:
        judge = Judge(config, pool)
        best = search(judge, base, parameters, range(1, a.laboratories + 1), a.budget, a.seed)
        before, after = judge.means([base, best], range(HELD_OUT_FROM, HELD_OUT_FROM + a.held_out))
    command = f"python -m benchmarks.tune {a.search} --world {a.world} --budget {a.budget}"
    command += f" --laboratories {a.laboratories} --seed {a.seed}"
    judged = f"Cost on {a.held_out} held-out laboratories: {before:.4f} before, {after:.4f} after."
    text = controller_yaml(best, f"Found by `{command}`.\n{judged}")
    if a.out is None:
        print(text, end="")
    else:
        a.out.write_text(text, encoding="utf-8")
    print(judged, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
