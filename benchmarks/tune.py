"""Tunes the gains of one law in the fast closed loop by CMA-ES; every law has the same cost, flights and budget.

    python -m benchmarks.tune psc --world lab --budget 300 --out mine.yaml
    python -m benchmarks.tune psc --world lab --budget 300 --out mine.yaml --state psc.state --minutes 5   # repeat until it is finished

Cost of a flight: ||e_p|| after the catch + 0.3 of that before it + 0.1 m/(N m) of the arm's impedance error against one common target
(`companion.analysis.metrics.impedance_error`) + 0.5 m/(N m) of the torque activity, all RMS. A flight in which the payload is missed
or the safety supervisor does more than warn costs `FAILURE_COST`. Cost of a point: mean over laboratories 1 to --laboratories, with
0.1, 0.2 and 0.3 kg in turn; every point flies the same ones, every other one with a long delay.

Flights of the search end `SEARCH_FLIGHT_S` after power-on, some 5 s after the catch. Of each generation all points fly the first
half of the laboratories and the better half of the points the rest, because CMA-ES needs only the order of the points. The result
is evaluated on whole missions in laboratories outside the search, beside the start point. Parameters are searched on
a logarithmic scale; one that ends near a bound is named, so that the bound can be widened.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cma
import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from companion.analysis import metrics
from companion.config.controller import LAWS
from companion.config.document import ConfigError
from companion.model.types import Outcome, SafetyAction
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import Flown, fly_to_end, log_of, torque_activity_nm, with_world

Gains = dict[str, Any]
Costs = npt.NDArray[np.float64]

MISSION = Path(__file__).parents[1] / "configs" / "missions" / "catch.yaml"
PAYLOADS_KG = (0.1, 0.2, 0.3)
BEFORE_SHARE, ARM_WEIGHT_M_NM, ACTIVITY_WEIGHT_M_NM, FAILURE_COST = 0.3, 0.1, 0.5, 1.0
HELD_OUT_FROM = 1001
"""First laboratory of the final evaluation."""
SEARCH_FLIGHT_S, MISSION_LIMIT_S = 15.0, 90.0
"""Longest flights of the search and of the final evaluation, from power-on; the catch is at about 10 s."""
SLOW = {"setpoint_delay_s": 0.05}
"""What every other flight of the search has, so that no law is tuned to a short delay only."""
FIRST_STEP, NEAR_BOUND = 0.15, 0.03
"""Initial standard deviation, and distance that counts as near a bound, as shares of the logarithmic range."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the search: a key of the controller file, all of it or some of its rows, which then share a value."""

    key: str
    low: float
    high: float
    rows: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Return the name in the output."""
        return f"{self.key}{list(self.rows) if self.rows else ''}"

    def read(self, gains: Gains) -> float:
        """Return the parameter's value in a controller file."""
        value = gains[self.key]
        return float(value[self.rows[0]] if self.rows else value)

    def write(self, gains: Gains, value: float) -> None:
        """Set the parameter in a controller file."""
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
)
_PAYLOAD = Parameter("payload_time_s", 0.03, 2.0)
_GAINS = (
    Parameter("lambda_gain", 1.0, 30.0, XY),
    Parameter("lambda_gain", 2.0, 80.0, Z),
    Parameter("phi", 0.7, 6.0, XY),
    Parameter("phi", 0.7, 8.0, Z),
    Parameter("lambda_gain", 0.2, 3.0, ARM),
    Parameter("nu", 0.05, 50.0, (0, 1, 2, 3)),
)
_ROBUST = (Parameter("rho_max", 0.5, 20.0), Parameter("row_weights_s", 0.01, 1.0, ARM))
_LOADS = (
    Parameter("load_rate_xyz", 0.3, 30.0, XY),
    Parameter("load_rate_xyz", 1.0, 200.0, Z),
    Parameter("moment_rate", 0.002, 0.3, (0,)),
    Parameter("friction_rate", 0.01, 3.0, (0,)),
)
SEARCHES: dict[str, tuple[str, str, tuple[Parameter, ...]]] = {
    "csc": ("csc", "tuned", (*_CSC, _ATTITUDE)),
    "csc_extras": ("csc", "tuned_extras", (*_CSC, *_EXTRAS)),
    "psc": ("psc", "tuned", (*_PSC, _PAYLOAD, _ATTITUDE)),
    "psc_extras": ("psc", "tuned_extras", (*_PSC, *_EXTRAS)),
    "paper": ("adaptive", "paper", (*_GAINS, *_ROBUST, _ATTITUDE)),
    "model_free": ("adaptive", "model_free", (*_GAINS, *_LOADS, *_EXTRAS[2:])),
    "recommended": ("adaptive", "recommended", (*_GAINS, *_LOADS, *_EXTRAS[2:])),
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


def cost(config: SitlConfig, searching: bool, gains: Gains, laboratory: int) -> float:
    """Return the cost of one flight, which is shortened and may have a long delay while `searching`."""
    try:
        controller = LAWS[gains["law"]].model_validate(gains)
    except ValidationError:  # the law's own conditions reject the point
        return FAILURE_COST
    world = {"seed": laboratory, "payload_kg": PAYLOADS_KG[laboratory % len(PAYLOADS_KG)]}
    if searching and laboratory % 2 == 0:
        world |= SLOW
    limit_s = SEARCH_FLIGHT_S if searching else MISSION_LIMIT_S
    flown = fly_to_end(with_world(config.model_copy(update={"controller": controller}), world), limit_s)
    if _failed(flown):
        return FAILURE_COST
    log = log_of(flown.config.flight, flown.result, flown.caught_t_s)
    before, after = metrics.flight_masks(log)
    terms = (
        (1.0, metrics.tracking_rms(log, after).e_p_m),
        (BEFORE_SHARE, metrics.tracking_rms(log, before).e_p_m),
        (ARM_WEIGHT_M_NM, metrics.impedance_error(log)[1]),
        (ACTIVITY_WEIGHT_M_NM, torque_activity_nm(log, before | after)),
    )
    return min(FAILURE_COST, sum(FAILURE_COST if value is None else weight * value for weight, value in terms))


def _failed(flown: Flown) -> bool:
    outputs = flown.result.outputs
    if flown.caught_t_s is None or flown.result.crashed or not outputs:
        return True
    return outputs[-1].action.rank > SafetyAction.WARN.rank or outputs[-1].outcome not in (None, Outcome.COMPLETED)


class Judge:
    """Costs of points, flown over processes."""

    def __init__(self, config: SitlConfig, pool: ProcessPoolExecutor) -> None:
        self._config, self._pool = config, pool

    def costs(self, searching: bool, candidates: Sequence[Gains], laboratories: Sequence[int]) -> Costs:
        """Return the cost of each candidate (rows) in each laboratory (columns)."""
        jobs = [(gains, laboratory) for gains in candidates for laboratory in laboratories]
        found = list(self._pool.map(partial(cost, self._config, searching), *zip(*jobs, strict=True)))
        return np.array(found).reshape(len(candidates), len(laboratories))

    def ranked(self, candidates: Sequence[Gains], laboratories: Sequence[int]) -> list[float]:
        """Return a cost of each candidate of a generation: the mean over the laboratories for the better half of them, judged by the
        first half of the laboratories; more than any of these, in their order, for the others.
        """
        half = (len(laboratories) + 1) // 2
        first = self.costs(True, candidates, laboratories[:half])
        order = np.argsort(first.mean(axis=1))[: (len(candidates) + 1) // 2]
        rest = self.costs(True, [candidates[k] for k in order], laboratories[half:])
        means = np.hstack([first[order], rest]).mean(axis=1)
        costs = means.max() + first.mean(axis=1)
        costs[order] = means
        return [float(mean) for mean in costs]


@dataclass
class Progress:
    """State of a search between two generations, as in its state file."""

    strategy: Any
    start: Gains
    """Controller file at the start of the search."""
    best: Gains
    best_cost: float


class Search:
    """CMA-ES on a logarithmic scale.

    Args:
        base: controller file with the start and everything that is not searched.
        parameters: the search space.
        budget: points to try, the start included.
        seed: seed of the search.
    """

    def __init__(self, base: Gains, parameters: Sequence[Parameter], budget: int, seed: int) -> None:
        self._base, self._parameters, self._budget = base, parameters, budget
        self._low = np.log([parameter.low for parameter in parameters])
        self._span = np.log([parameter.high for parameter in parameters]) - self._low
        options = {"bounds": [0.0, 1.0], "seed": seed, "verbose": -9}
        strategy = cma.CMAEvolutionStrategy(self._point(base), FIRST_STEP, options)
        start = self._gains(self._point(base))
        self.progress = Progress(strategy, start, start, np.inf)

    def _point(self, gains: Gains) -> Any:
        values = [parameter.read(gains) for parameter in self._parameters]
        return np.clip((np.log(np.maximum(values, 1e-9)) - self._low) / self._span, 0.0, 1.0)

    def _gains(self, point: Sequence[float]) -> Gains:
        values = np.exp(self._low + self._span * np.clip(point, 0.0, 1.0))
        return gains_of(self._base, self._parameters, values.tolist())

    def run(self, judge: Judge, laboratories: Sequence[int], state: Path | None, deadline_s: float) -> bool:
        """Search until the budget is used, which returns True, or `time.monotonic()` passes `deadline_s` after a generation."""
        p = self.progress
        if not np.isfinite(p.best_cost):
            p.best_cost = float(judge.costs(True, [p.start], laboratories).mean())
            self._say("start")
        while 1 + p.strategy.countevals < self._budget and not p.strategy.stop():
            if time.monotonic() >= deadline_s:
                return False
            points = p.strategy.ask()
            candidates = [self._gains(point) for point in points]
            costs = judge.ranked(candidates, laboratories)
            p.strategy.tell(points, costs)
            if min(costs) < p.best_cost:
                p.best_cost = min(costs)
                p.best = candidates[costs.index(p.best_cost)]
            self._say(f"step {p.strategy.sigma:.3f}")
            if state is not None:
                state.write_bytes(pickle.dumps(p))
        return True

    def _say(self, text: str) -> None:
        p = self.progress
        tried = f"{1 + p.strategy.countevals:4d}/{self._budget}"
        print(f"{tried}  cost {p.best_cost:.5f}  {text}", file=sys.stderr, flush=True)

    def name_bounds(self) -> None:
        """Name the parameters that are near a bound."""
        best = self.progress.best
        for parameter, at in zip(self._parameters, self._point(best), strict=True):
            if min(at, 1.0 - at) < NEAR_BOUND:
                print(f"{parameter.name} is near a bound: {parameter.read(best):g}", file=sys.stderr)


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
    """Run the search and return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(description="Tune one law on the fast closed loop.")
    parser.add_argument("search", choices=list(SEARCHES))
    parser.add_argument("--world", default="lab", help="lab, ideal or a world file (%(default)s)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--budget", type=int, default=300, help="points to try (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=4, help="flights per point, at least 2 (%(default)s)")
    parser.add_argument("--held-out", type=int, default=30, help="laboratories of the final evaluation (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the search (%(default)s)")
    parser.add_argument(
        "--state", type=Path, help="file of the search's progress; if it exists the search continues from it"
    )
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after the generation in which they pass")
    parser.add_argument("--out", type=Path, help="controller file to write; absent: standard output")
    a = parser.parse_args(arguments)
    law, preset, parameters = SEARCHES[a.search]
    try:
        as_written = ("controller.found_for=null", *a.overrides)
        config = load_sitl(MISSION, controller_law=law, preset=preset, overrides=as_written, world=a.world)
    except ConfigError as error:
        print(f"tune: {error}", file=sys.stderr)
        return 2
    run = Search(config.controller.model_dump(mode="json"), parameters, a.budget, a.seed)
    if a.state is not None and a.state.exists():
        run.progress = pickle.loads(a.state.read_bytes())
    training = range(1, a.laboratories + 1)
    held_out = range(HELD_OUT_FROM, HELD_OUT_FROM + a.held_out)
    with ProcessPoolExecutor(a.jobs) as pool:
        judge = Judge(config, pool)
        finished = run.run(judge, training, a.state, time.monotonic() + 60.0 * a.minutes)
        best = run.progress.best
        judged = f"Cost on laboratories 1 to {a.laboratories}: {run.progress.best_cost:.4f}."
        if finished:
            before, after = judge.costs(False, [run.progress.start, best], held_out).mean(axis=1)
            judged += f" On {a.held_out} held-out laboratories, whole missions: {before:.4f} before, {after:.4f} after."
    run.name_bounds()
    options = "".join(f" --set {override}" for override in a.overrides)
    command = f"python -m benchmarks.tune {a.search} --world {a.world}{options} --budget {a.budget}"
    command += f" --laboratories {a.laboratories} --seed {a.seed}"
    text = controller_yaml(best, f"Found by `{command}`.\n{judged}")
    if a.out is None:
        print(text, end="")
    else:
        a.out.write_text(text, encoding="utf-8")
    print(judged, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
