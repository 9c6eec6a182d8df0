"""Tunes the gains of one law in the fast closed loop; every law has the same cost, flights and budget.

    python -m benchmarks.tune csc --budget 150 --out mine.yaml

Cost, mean over payloads x seeds, each term RMS from the catch to the landing:

    ||e_p|| (m) + 0.1 m/(N m) ||dI_arm|| + 0.5 m/(N m) ||tick-to-tick change of the joint torques||

dI_arm = M_d e'' + K_d e' + K_p e - e_tau, e_tau = J'(F - F_d), with one fixed target (M_d, K_d, K_p) for every law, whatever its own
gains; F as measured, F_d = F low-passed by 0.5 s, dI low-passed at 10 Hz without phase shift. An arm that does not give way at all has
dI = -e_tau: `--show` prints that beside dI as `rigid_nm`, for only what is below it is compliance.
A flight that does not end as `completed` costs 10. Search: the start point, then 20 log-uniform random points, then Gaussian steps in
the logarithm around the best, steps growing with success (1/5 rule). A candidate is given up as soon as the flights it has flown
cost a tenth more than the best's same flights (same payloads, same seeds, heaviest payload first). Flights with an even seed have slow
wires (`SLOW`), so that gains are not sharpened for one delay. The result depends on seed and
budget, not on the number of processes; a larger budget continues the same search, and the file is written whenever it improves.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from companion.analysis.metrics import lowpass_zero_phase
from companion.config.controller import LAWS, PRESETS
from companion.config.document import ConfigError
from companion.control.manipulator import Manipulator
from companion.model.constants import TICK_PERIOD_S
from companion.model.frames import quat_conjugate, quat_rotate
from companion.model.types import Inputs, Outcome, Outputs, PhaseKind
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight

Array = npt.NDArray[np.float64]
Gains = dict[str, Any]
Costs = tuple[float, ...]
"""Costs of the flights of a point, in order."""
Job = tuple[tuple[float, ...], Costs]
"""A point, and the costs of the best one so far, or an empty tuple."""
Evaluate = Callable[[Iterable[Job]], Iterable[Costs | None]]

MISSION = Path(__file__).parents[1] / "configs" / "missions" / "catch.yaml"
ARM_WEIGHT_M_NM, ACTIVITY_WEIGHT_M_NM, FAILURE_COST = 0.1, 0.5, 10.0
TARGET_MD_KG_M2, TARGET_KD_NMS, TARGET_KP_NM = 0.1, 0.7, 1.225
"""Target impedance of the arm in the paper (tab:control_parameters, joint rows)."""
DESIRED_FORCE_TIME_S = 0.5
IMPEDANCE_LOWPASS_HZ = 10.0
SLOW = {"setpoint_delay_s": 0.05, "rotor_lag_s": 0.05, "arm_delay_s": 0.006}
"""World of the flights with slow communication."""
RANDOM_POINTS, BATCH, FIRST_STEP, RACE_MARGIN = 20, 4, 0.15, 1.1


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the search, on a logarithmic scale."""

    name: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Tunable:
    """The search space of a law, and the gains of a point."""

    parameters: tuple[Parameter, ...]
    start: tuple[float, ...]
    gains: Callable[[Gains, Sequence[float]], Gains]
    """Returns the configuration, given the law's default preset and a point."""


@dataclass(frozen=True, slots=True)
class Grade:
    """Figures of one flight after the catch."""

    e_p_m: float
    arm_nm: float
    rigid_nm: float
    """Value of arm_nm for an arm that does not move off its reference."""
    activity_nm: float
    completed: bool

    @property
    def cost(self) -> float:
        """Cost as defined in the module's docstring."""
        if not self.completed:
            return FAILURE_COST
        return self.e_p_m + ARM_WEIGHT_M_NM * self.arm_nm + ACTIVITY_WEIGHT_M_NM * self.activity_nm


def adaptive_gains(base: Gains, point: Sequence[float]) -> Gains:
    """Return gains with the preset's target impedance; K_p of the base rows follows Phi (gain_cond)."""
    lambda_xy, lambda_z, phi_xy, phi_z, lambda_arm, rho_max, arm_weight, nu, observer_xy, observer_z, lead, attitude = (
        point
    )
    phi = [phi_xy, phi_xy, phi_z, *base["phi"][3:]]
    rows = zip(base["damping_kd"], base["inertia_md"], phi, strict=True)
    stiffness = [(kd - md * p) * p for kd, md, p in rows]
    weights = base["row_weights_s"]
    return base | {
        "lambda_gain": [lambda_xy, lambda_xy, lambda_z, *base["lambda_gain"][3:6], lambda_arm, lambda_arm],
        "phi": phi,
        "stiffness_kp": [*stiffness[:3], *base["stiffness_kp"][3:]],
        "rho_max": rho_max,
        "row_weights_s": [*weights[:6], arm_weight, arm_weight],
        "nu": [nu] * 4,
        "disturbance_time_xyz_s": [observer_xy, observer_xy, observer_z],
        "feedforward_lead_s": lead,
        "attitude_filter_rad_s": attitude,
    }


def csc_gains(base: Gains, point: Sequence[float]) -> Gains:
    """Return gains, given natural frequency and damping ratio of the base rows, and three gains of the arm rows."""
    w_xy, d_xy, w_z, d_z, md, kd, kp, attitude = point
    m = base["inertia_md"]
    k_d, k_p = base["damping_kd"], base["stiffness_kp"]
    return base | {
        "inertia_md": [*m[:6], md, md],
        "damping_kd": [2 * d_xy * w_xy * m[0], 2 * d_xy * w_xy * m[1], 2 * d_z * w_z * m[2], *k_d[3:6], kd, kd],
        "stiffness_kp": [w_xy**2 * m[0], w_xy**2 * m[1], w_z**2 * m[2], *k_p[3:6], kp, kp],
        "attitude_filter_rad_s": attitude,
    }


def psc_gains(base: Gains, point: Sequence[float]) -> Gains:
    """Return gains, given frequency, damping and integral of the vehicle, three gains of the arm, and the estimator's time constant."""
    w_xy, d_xy, i_xy, w_z, d_z, i_z, md, kd, kp, time_s, attitude = point
    return base | {
        "position_kp_xyz": [w_xy**2, w_xy**2, w_z**2],
        "position_kd_xyz": [2 * d_xy * w_xy, 2 * d_xy * w_xy, 2 * d_z * w_z],
        "position_ki_xyz": [i_xy, i_xy, i_z],
        "arm_inertia_md": [md, md],
        "arm_damping_kd": [kd, kd],
        "arm_stiffness_kp": [kp, kp],
        "payload_time_s": time_s,
        "attitude_filter_rad_s": attitude,
    }


_ARM = (Parameter("arm_md", 0.005, 0.3), Parameter("arm_kd", 0.1, 3.0), Parameter("arm_kp", 0.4, 10.0))
_ATTITUDE = Parameter("attitude_filter_rad_s", 20.0, 120.0)
TUNABLES: dict[str, Tunable] = {
    "adaptive": Tunable(
        (
            Parameter("lambda_xy", 2.0, 30.0),
            Parameter("lambda_z", 4.0, 60.0),
            Parameter("phi_xy", 0.7, 6.0),
            Parameter("phi_z", 0.7, 8.0),
            Parameter("lambda_arm", 0.2, 3.0),
            Parameter("rho_max", 0.5, 20.0),
            Parameter("arm_weight", 0.01, 1.0),
            Parameter("nu", 1.0, 50.0),
            Parameter("observer_xy_s", 0.2, 5.0),
            Parameter("observer_z_s", 0.2, 5.0),
            Parameter("lead_s", 0.01, 0.4),
            _ATTITUDE,
        ),
        (8.0, 20.0, 2.0, 3.0, 1.0, 6.0, 0.1, 10.0, 1.0, 1.0, 0.1, 30.0),
        adaptive_gains,
    ),
    "csc": Tunable(
        (
            Parameter("w_xy", 1.0, 6.0),
            Parameter("d_xy", 0.4, 2.0),
            Parameter("w_z", 1.5, 15.0),
            Parameter("d_z", 0.4, 2.0),
            *_ARM,
            _ATTITUDE,
        ),
        (3.0, 0.75, 5.0, 0.8, 0.03, 0.7, 1.225, 30.0),
        csc_gains,
    ),
    "psc": Tunable(
        (
            *(Parameter("w_xy", 1.0, 6.0), Parameter("d_xy", 0.4, 2.0), Parameter("i_xy", 0.05, 10.0)),
            *(Parameter("w_z", 1.5, 15.0), Parameter("d_z", 0.4, 2.0), Parameter("i_z", 0.05, 30.0)),
            *_ARM,
            Parameter("payload_time_s", 0.03, 1.0),
            _ATTITUDE,
        ),
        (2.6, 0.85, 1.0, 4.5, 0.9, 3.0, 0.03, 0.7, 1.225, 0.15, 30.0),
        psc_gains,
    ),
}


def arm_impedance_error_nm(
    config: SitlConfig, inputs: Sequence[Inputs], outputs: Sequence[Outputs]
) -> tuple[Array, Array]:
    """Return dI of the joint rows against the fixed target, and e_tau, both low-passed, N m, shape (ticks, 2).

    Every tick must have a control log and both states.
    """
    manipulator = Manipulator(config.vehicle.arm, config.vehicle.tool)
    k = TICK_PERIOD_S / DESIRED_FORCE_TIME_S
    lasting = np.zeros(3)
    e, e_rate, e_tau = [], [], []
    for i, o in zip(inputs, outputs, strict=True):
        assert o.control is not None and i.vehicle is not None and i.arm is not None
        force = np.array(o.control.force_ext_world_n)
        passing = force - lasting
        lasting = lasting + k * passing
        body = quat_rotate(
            quat_conjugate(i.vehicle.attitude_wxyz), (float(passing[0]), float(passing[1]), float(passing[2]))
        )
        e_tau.append(manipulator.joint_torque_from_force(i.arm.angle_rad, body))
        e.append(o.control.error[6:8])
        e_rate.append(o.control.error_rate[6:8])
    rate = np.array(e_rate)
    spring = TARGET_KD_NMS * rate + TARGET_KP_NM * np.array(e)
    slow = lowpass_zero_phase(np.hstack([rate, spring, np.array(e_tau)]), TICK_PERIOD_S, IMPEDANCE_LOWPASS_HZ)
    inertial = TARGET_MD_KG_M2 * np.gradient(slow[:, 0:2], TICK_PERIOD_S, axis=0)
    return inertial + slow[:, 2:4] - slow[:, 4:6], slow[:, 4:6]


def fly(config: SitlConfig) -> Grade:
    """Fly once in the fast loop and grade the flight from the catch to the landing."""
    result = FastFlight(config).run()
    completed = result.outputs[-1].outcome is Outcome.COMPLETED and not result.crashed
    rows = [
        (i, o)
        for i, o in zip(result.inputs, result.outputs, strict=True)
        if o.phase_kind is PhaseKind.FLIGHT and o.control and o.reference and i.mocap and i.vehicle and i.arm
    ]
    catch_s = next((e.t_s for o in result.outputs for e in o.events if e.id == "catch"), None)
    after = [k for k, (i, _) in enumerate(rows) if catch_s is not None and i.t_s >= catch_s]
    if not completed or len(after) < 10:
        return Grade(e_p_m=math.inf, arm_nm=math.inf, rigid_nm=math.inf, activity_nm=math.inf, completed=False)
    inputs, outputs = zip(*rows, strict=True)
    e_p = [
        math.dist(i.mocap.position_world_m, o.reference.position_world_m)
        for i, o in rows[after[0] :]
        if i.mocap and o.reference
    ]
    error, rigid = arm_impedance_error_nm(config, inputs, outputs)
    torque = np.array([o.arm_torque_nm or (0.0, 0.0) for o in outputs[after[0] :]])
    return Grade(
        e_p_m=rms(np.array(e_p)[:, None]),
        arm_nm=rms(error[after[0] :]),
        rigid_nm=rms(rigid[after[0] :]),
        activity_nm=rms(np.diff(torque, axis=0)),
        completed=True,
    )


def rms(rows: Array) -> float:
    """Return the root of the mean squared row norm."""
    return float(np.sqrt(np.mean(np.sum(rows * rows, axis=1))))


def configuration(law: str, gains: Gains, payload_kg: float, seed: int) -> SitlConfig:
    """Return the mission with these gains, validated like a file."""
    flight = load_sitl(MISSION, controller_law=law)
    wires = SLOW if seed % 2 == 0 else {}
    world = flight.world.model_copy(update={"payload_kg": payload_kg, "seed": seed, **wires})
    controller = LAWS[law].model_validate(gains | {"law": law})
    return flight.model_copy(update={"controller": controller, "world": world})


def evaluate(law: str, base: Gains, payloads_kg: Sequence[float], seeds: Sequence[int], job: Job) -> Costs | None:
    """Return the cost of each flight of a point, or None if the point was abandoned against the best one."""
    point, best = job
    gains = rounded(TUNABLES[law].gains(base, point))
    costs: list[float] = []
    for seed in seeds:
        for payload_kg in sorted(payloads_kg, reverse=True):
            try:
                config = configuration(law, gains, payload_kg, seed)
            except ValidationError:  # the law's own conditions refuse the point
                return None
            costs.append(fly(config).cost)
            if best and sum(costs) > RACE_MARGIN * sum(best[: len(costs)]):
                return None
    return tuple(costs)


def rounded(gains: Gains) -> Gains:
    """Round to six significant digits, so that the written gains are those that were flown."""

    def one(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return [one(item) for item in value]
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {key: one(value) for key, value in gains.items()}


def search(
    tunable: Tunable, budget: int, seed: int, run: Evaluate, tell: Callable[[int, float, Sequence[float]], None]
) -> tuple[tuple[float, ...], float]:
    """Return the best point and its cost after `budget` points, the first of which is the start point."""
    rng = np.random.default_rng(seed)
    low = np.log([parameter.low for parameter in tunable.parameters])
    high = np.log([parameter.high for parameter in tunable.parameters])
    best = tunable.start
    [costs] = run([(best, ())])
    assert costs is not None
    best_costs = costs
    done, step = 1, FIRST_STEP
    while done < budget:
        size = min(BATCH, budget - done)
        local = done > RANDOM_POINTS
        if local:
            noise = step * (high - low) * rng.standard_normal((size, len(low)))
            logs = np.clip(np.log(best) + noise, low, high)
        else:
            logs = rng.uniform(low, high, (size, len(low)))
        points = [tuple(float(x) for x in np.exp(row)) for row in logs]
        flown = zip(run([(point, best_costs) for point in points]), points, strict=True)
        better = [(costs, point) for costs, point in flown if costs is not None and sum(costs) < sum(best_costs)]
        if local:
            step = min(0.3, step * 1.3) if better else max(0.01, step * 0.9)
        if better:
            best_costs, best = min(better, key=lambda found: sum(found[0]))
        done += size
        tell(done, float(np.mean(best_costs)), best)
    return best, float(np.mean(best_costs))


def controller_yaml(law: str, gains: Gains, preset: str, command: str, cost: float, words: str) -> str:
    """Return a controller file as text."""
    lines = [
        "# yaml-language-server: $schema=../schema/controller.schema.json",
        "#",
        f"# {words}",
        f"# Found by `{command}`: cost {cost:.4f} (see there).",
        "schema_version: 1",
        f"law: {law}",
        f"preset: {preset}",
        "",
    ]
    for key, value in gains.items():
        if key in ("schema_version", "law", "preset") or value is None:
            continue
        text = "[" + ", ".join(f"{v:g}" for v in value) + "]" if isinstance(value, list) else f"{value:g}"
        lines.append(f"{key}: {text}")
    return "\n".join(lines) + "\n"


WORDS = {
    "adaptive": "Adaptive impedance control; rows are x, y, z (world) | roll, pitch, yaw | alpha_1, alpha_2.",
    "csc": "Complete-system compliance; rows are x, y, z (world) | roll, pitch, yaw (as PX4 closes them) | alpha_1, alpha_2.",
    "psc": "Partitioned compliance: impedance of the arm, position control of the vehicle with an estimate of the payload's mass.",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(description="Tune one law on the fast closed loop.")
    parser.add_argument("law", choices=list(TUNABLES))
    parser.add_argument("--budget", type=int, default=150, help="points to try (%(default)s)")
    parser.add_argument("--seeds", type=int, default=2, help="flights per payload and point (%(default)s)")
    parser.add_argument("--payloads", default="0.1,0.2,0.3", help="kg (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the search (%(default)s)")
    parser.add_argument("--preset", default="tuned", help="name in the file that is written (%(default)s)")
    parser.add_argument("--out", type=Path, help="controller file to write; absent: standard output")
    parser.add_argument("--show", action="store_true", help="no search: grade the law's presets and end")
    a = parser.parse_args(arguments)
    try:
        payloads_kg = [float(text) for text in a.payloads.split(",")]
        base = load_sitl(MISSION, controller_law=a.law).controller.model_dump(mode="json")
    except (ValueError, ConfigError) as error:
        print(f"tune: {error}", file=sys.stderr)
        return 2
    seeds = range(1, a.seeds + 1)
    with ProcessPoolExecutor(a.jobs) as pool:
        if a.show:
            show(a.law, payloads_kg, seeds, pool)
            return 0
        tunable = TUNABLES[a.law]
        run: Evaluate = partial(pool.map, partial(evaluate, a.law, base, payloads_kg, seeds))

        def tell(done: int, cost: float, point: Sequence[float]) -> None:
            named = ", ".join(
                f"{parameter.name} {value:.3g}" for parameter, value in zip(tunable.parameters, point, strict=True)
            )
            print(f"{done:4d}/{a.budget}  cost {cost:.5f}  {named}", file=sys.stderr, flush=True)
            if a.out is not None:
                a.out.write_text(found(done, cost, point), encoding="utf-8")

        def found(budget: int, cost: float, point: Sequence[float]) -> str:
            options = f"--budget {budget} --seeds {a.seeds} --payloads {a.payloads} --seed {a.seed}"
            gains = rounded(tunable.gains(base, point))
            return controller_yaml(a.law, gains, a.preset, f"benchmarks/tune.py {a.law} {options}", cost, WORDS[a.law])

        point, cost = search(tunable, a.budget, a.seed, run, tell)
        if a.out is None:
            print(found(a.budget, cost, point), end="")
    return 0


def show(law: str, payloads_kg: Sequence[float], seeds: Sequence[int], pool: ProcessPoolExecutor) -> None:
    """Print a line per preset and payload with means over the seeds."""
    print("law/preset payload_kg  e_p_m  arm_nm  rigid_nm  activity_nm  cost  failed")
    for preset in PRESETS[law]:
        gains = load_sitl(MISSION, controller_law=law, preset=preset).controller.model_dump(mode="json")
        for payload_kg in payloads_kg:
            flown = list(pool.map(fly, [configuration(law, gains, payload_kg, seed) for seed in seeds]))
            good = [grade for grade in flown if grade.completed]
            means = [
                float(np.mean([getattr(grade, key) for grade in good])) if good else math.nan
                for key in ("e_p_m", "arm_nm", "rigid_nm", "activity_nm", "cost")
            ]
            print(f"{law}/{preset}", payload_kg, *(f"{mean:.4f}" for mean in means), len(flown) - len(good), flush=True)


if __name__ == "__main__":
    sys.exit(main())
