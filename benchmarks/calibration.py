"""Flies laws in the laboratory and shows their errors before the catch beside the paper's.

    python -m benchmarks.calibration --laboratories 20

The laboratory is calibrated on these figures alone. Each is the median over laboratories of an RMS from the end of the take-off to the
catch. The paper does not define the reference of its attitude error: the second figure is relative to the law's commanded attitude,
the third to level flight along x. The soft laws are CSC and PSC with the position stiffness Lambda Phi and the damping
Lambda + M_d Phi that the paper's printed gains give its own law.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

from benchmarks.report import publish, table_parser
from companion.analysis import metrics
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import fly_to_end, log_of, with_world
from tools.docs.tables import markdown

MISSION = Path(__file__).parents[1] / "configs" / "missions" / "catch.yaml"
FLIGHT_S = 11.0
"""End of each flight, from power-on; the catch is at about 10 s."""
SOFT_CSC = (
    "controller.inertia_md=[3, 3, 3, 1, 1, 1, 0.0742098, 0.0742098]",
    "controller.damping_kd=[5.5, 5.5, 6, 20, 20, 4, 0.7, 0.7]",
    "controller.stiffness_kp=[6, 6, 8, 130, 130, 8, 1.225, 1.225]",
)
SOFT_PSC = (
    "controller.position_kp_xyz=[2, 2, 2.67]",
    "controller.position_kd_xyz=[1.83, 1.83, 2]",
    "controller.position_ki_xyz=[0, 0, 0]",
)
LAWS = {
    "adaptive/paper": ("adaptive", "paper", (), "73 to 91", "2.6 to 2.9"),
    "csc, soft": ("csc", "tuned", SOFT_CSC, "93 to 100", "2.8 to 3.3"),
    "psc, soft": ("psc", "tuned", SOFT_PSC, "84 to 99", "2.4 to 3.3"),
    "csc/tuned": ("csc", "tuned", (), "93 to 100", "2.8 to 3.3"),
    "psc/tuned": ("psc", "tuned", (), "84 to 99", "2.4 to 3.3"),
}
"""Law, preset, overrides, and the paper's figures of the law: ||e_p|| in mm and ||e_q|| in deg."""


def errors(name: str, world: str, seed: int) -> tuple[float, float, float]:
    """Fly one laboratory; return before the catch RMS ||e_p|| in mm, ||e_q|| and the attitude from level in deg. NaN is unknown."""
    law, preset, overrides, _, _ = LAWS[name]
    config = load_sitl(MISSION, None, law, preset, overrides, world=world)
    flown = fly_to_end(with_world(config, {"seed": seed}), FLIGHT_S)
    log = log_of(flown.config.flight, flown.result, flown.caught_t_s)
    before, _ = metrics.flight_masks(log)
    rms = metrics.tracking_rms(log, before)
    level_rad = metrics.rms_norm(log.columns.mocap_attitude_rad[before])
    if rms.e_p_m is None or rms.e_q_deg is None or level_rad is None:
        return (math.nan, math.nan, math.nan)
    return (1e3 * rms.e_p_m, rms.e_q_deg, math.degrees(level_rad))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and return 0."""
    parser = table_parser("Show the errors before the catch beside the paper's.")
    parser.add_argument("--world", default="lab", help="lab, ideal or a world file (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=20, help="flights per law (%(default)s)")
    parser.add_argument("--first", type=int, default=1, help="seed of the first laboratory (%(default)s)")
    a = parser.parse_args(arguments)
    flights = [(name, a.world, seed) for name in LAWS for seed in range(a.first, a.first + a.laboratories)]
    with ProcessPoolExecutor(a.jobs) as pool:
        rows_of = list(pool.map(errors, *zip(*flights, strict=True)))
    flown = np.array(rows_of).reshape(len(LAWS), a.laboratories, 3)
    rows = []
    for (name, (*_, paper_mm, paper_deg)), found in zip(LAWS.items(), flown, strict=True):
        p5, p50, p95 = np.nanpercentile(found[:, 0], (5, 50, 95))
        e_q, level = np.nanmedian(found[:, 1:], axis=0)
        rows.append((name, f"{p50:.0f} ({p5:.0f} to {p95:.0f})", f"{e_q:.1f}", f"{level:.1f}", paper_mm, paper_deg))
    ours = ("law", "e_p, mm: p50 (p5 to p95)", "e_q, deg", "attitude from level, deg")
    command = f"calibration --world {a.world} --laboratories {a.laboratories} --first {a.first}"
    publish(markdown((*ours, "paper: e_p, mm", "paper: e_q, deg"), rows) + "\n", command, a.table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
