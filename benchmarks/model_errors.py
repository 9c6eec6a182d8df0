"""What a wrong figure of the vehicle costs each law: the laboratory with one figure after the other wrong, and with all of them.

    python -m benchmarks.model_errors --laws adaptive/recommended,psc/tuned --table model_errors.md

Each laboratory is flown as it is, and then with one error in the place of what it draws for that figure, with a sign drawn from its
seed. The difference in RMS ||e_p|| after the catch is paired. A flight that ends early counts as infinite; a laboratory in which the
ball is missed is left out.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.effects import MISSION, PAYLOADS_KG
from companion.campaigns.compare.aggregate import median_95
from companion.config.document import ConfigError
from companion.recorder.versions import versions
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import fly_to_end, row_of, with_world

NONE, ALL = "as it is", "all of them"
Wrong = Callable[[SitlConfig, float], SitlConfig]
"""Returns a laboratory with an error of a sign, 1 or -1."""


def _world(key: str, error: Callable[[float], Any]) -> Wrong:
    return lambda lab, sign: with_world(lab, {key: error(sign)})


def _section(name: str, key: str, error: Callable[[float], Any]) -> Wrong:
    return lambda lab, sign: with_world(
        lab, {name: getattr(lab.world, name).model_dump(mode="json") | {key: error(sign)}}
    )


def _thrust_curve(lab: SitlConfig, sign: float) -> SitlConfig:
    """PX4 inverts a curve that is wrong by 0.3 in its factor."""
    factor = min(max(lab.world.rotors.thrust_curve + 0.3 * sign, 0.0), 1.0)
    return _section("rotors", "thr_mdl_fac", lambda _: factor)(lab, sign)


def _frozen(lab: SitlConfig, sign: float) -> SitlConfig:
    """The hover thrust is wrong by 10 % and is not estimated in flight."""
    airframe = lab.vehicle.airframe.model_copy(update={"hover_thrust_adapt": False})
    frozen = lab.model_copy(update={"vehicle": lab.vehicle.model_copy(update={"airframe": airframe})})
    return with_world(frozen, {"hover_thrust_error": 0.1 * sign})


ERRORS: Mapping[str, Wrong] = {
    "base mass, 20 %": _world("mass_error", lambda sign: 0.2 * sign),
    "link masses, 20 %": _world("link_mass_error", lambda sign: [0.2 * sign]),
    "moments of inertia, 20 %": _section("machine", "inertia_error", lambda sign: [0.2 * sign] * 3),
    "base's centre of mass, 20 mm": _section("machine", "centre_of_mass_m", lambda sign: [0.02 * sign, 0.0, 0.0]),
    "links' centres of mass, 20 mm": _section("machine", "link_com_error_m", lambda sign: [0.02 * sign]),
    "torque constants, 20 %": _section("servo_mechanics", "torque_per_amp_error", lambda sign: [0.2 * sign]),
    "hover thrust, 20 %": _world("hover_thrust_error", lambda sign: 0.2 * sign),
    "hover thrust, 10 %, frozen": _frozen,
    "thrust curve, 0.3 of its factor": _thrust_curve,
    "force sensor's scale, 20 %": _world("force_scale", lambda sign: 1.0 + 0.2 * sign),
    "force sensor's axes, 10 deg each": _section("force_sensor", "mounting_rpy_deg", lambda sign: [10.0 * sign] * 3),
}


def with_error(config: SitlConfig, seed: int, error: str) -> SitlConfig:
    """Return the laboratory of a seed with one of `ERRORS`, `NONE` or `ALL`."""
    laboratory = with_world(config, {"seed": seed, "payload_kg": PAYLOADS_KG[seed % len(PAYLOADS_KG)]})
    for name in {NONE: (), ALL: tuple(ERRORS)}.get(error, (error,)):
        drawn = np.random.default_rng((seed, list(ERRORS).index(name))).random()
        laboratory = ERRORS[name](laboratory, 1.0 if drawn < 0.5 else -1.0)
    return laboratory


def fly(loaded: Mapping[str, SitlConfig], flight: tuple[str, str, int]) -> float:
    """Fly a law with an error in the laboratory of a seed; return RMS ||e_p|| after the catch, m: infinite if the flight ended early,
    NaN if the ball was missed.
    """
    law, error, seed = flight
    flown = fly_to_end(with_error(loaded[law], seed, error))
    row = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)[0]
    if row["outcome"] != "completed":
        return np.inf
    return float(row["rms"]["post"]["e_p_m"]) if row["caught"] else np.nan


def cell(plain_m: Sequence[float], wrong_m: Sequence[float]) -> str:
    """Return how much the error adds, mm, and how many flights ended early with it."""
    pairs = [(a, b) for a, b in zip(plain_m, wrong_m, strict=True) if np.isfinite(a) and not np.isnan(b)]
    found = median_95(1e3 * (b - a) for a, b in pairs)
    early = sum(np.isinf(wrong_m))
    text = "–" if found is None else "{:+.1f} ({:+.1f} to {:+.1f})".format(*found)
    return text + (f"; {early} ended early" if early else "")


def table(flown: Mapping[str, Mapping[str, Sequence[float]]]) -> str:
    """Return one line per error and one column per law as a Markdown table."""
    lines = ["| wrong | " + " | ".join(flown) + " |", "|---" * (1 + len(flown)) + "|"]
    plain = [1e3 * float(np.nanmedian(by_error[NONE])) for by_error in flown.values()]
    lines.append(f"| nothing: e_p after the catch, mm | {' | '.join(f'{one:.0f}' for one in plain)} |")
    for error in (*ERRORS, ALL):
        cells = [cell(by_error[NONE], by_error[error]) for by_error in flown.values()]
        lines.append(f"| {error} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(description="Fly each law with one wrong figure of the vehicle after the other.")
    parser.add_argument(
        "--laws", default="adaptive/recommended,psc/tuned,csc/tuned", help="law/preset, ... (%(default)s)"
    )
    parser.add_argument("--first-seed", type=int, default=1, help="first laboratory (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=12, help="flights per law and error (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--table", type=Path, help="Markdown file to write; absent: standard output")
    a = parser.parse_args(arguments)
    laws, seeds = a.laws.split(","), range(a.first_seed, a.first_seed + a.laboratories)
    try:
        loaded = {law: load_sitl(MISSION, None, *law.split("/", 1), world="lab") for law in laws}
    except ConfigError as error:
        print(f"model_errors: {error}", file=sys.stderr)
        return 2
    flights = list(itertools.product(laws, (NONE, *ERRORS, ALL), seeds))
    with ProcessPoolExecutor(a.jobs) as pool:
        results = dict(zip(flights, pool.map(partial(fly, loaded), flights, chunksize=4), strict=True))
    flown = {
        law: {error: [results[law, error, seed] for seed in seeds] for error in (NONE, *ERRORS, ALL)} for law in laws
    }
    command = (
        f"python -m benchmarks.model_errors --laws {a.laws} --first-seed {a.first_seed} --laboratories {a.laboratories}"
    )
    text = table(flown) + f"\nFlown by `{command}` at commit {versions().get('git', 'unknown')[:10]}.\n"
    if a.table is None:
        print(text, end="")
    else:
        a.table.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
