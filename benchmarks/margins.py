"""How late setpoints may be: flies the catch of each law in the laboratory with more and more delay before the attitude loop.

    python -m benchmarks.margins --laws adaptive/recommended,psc/tuned --table margins.md

A law's delay margin is the largest delay up to which the median of the largest ||e_p|| stays below 0.1 m; a flight that is not
completed counts as infinite. What becomes of the flights one step later shows whether a law that swings is landed, or completes all
the same.
"""

from __future__ import annotations

import itertools
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

from benchmarks.effects import MISSION, PAYLOADS_KG
from benchmarks.report import add_laws, laws_of, publish, table_parser
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import fly_to_end, row_of, with_world
from tools.docs.tables import markdown

DELAYS_MS = tuple(range(10, 151, 10))
LIMIT_M = 0.1

Flown = tuple[str, float, float]
"""Outcome, largest ||e_p|| and RMS ||e_p|| after the catch of one flight, m; infinite where the flight has no such figure."""


def fly(loaded: Mapping[str, SitlConfig], flight: tuple[str, int, int]) -> Flown:
    """Fly a law with a delay of setpoints, ms, in the laboratory of a seed."""
    law, delay_ms, seed = flight
    changes = {"seed": seed, "payload_kg": PAYLOADS_KG[seed % len(PAYLOADS_KG)], "setpoint_delay_s": 1e-3 * delay_ms}
    flown = fly_to_end(with_world(loaded[law], changes))
    row = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)[0]
    after_m = row["rms"]["post"]["e_p_m"]
    peak_m = row["peak_e_p_m"] if row["outcome"] == "completed" else None
    return row["outcome"], np.inf if peak_m is None else peak_m, np.inf if after_m is None else after_m


def margin(flown: Mapping[int, Sequence[Flown]]) -> tuple[int | None, int | None]:
    """Return the largest delay up to which the median of the peaks stays below the limit, and the next one; None if there is none."""
    good = [delay for delay in sorted(flown) if float(np.median([peak for _, peak, _ in flown[delay]])) < LIMIT_M]
    kept = [delay for delay, flies in zip(good, sorted(flown), strict=False) if delay == flies]
    return (kept[-1] if kept else None, next((delay for delay in sorted(flown) if delay not in kept), None))


def table(flown: Mapping[str, Mapping[int, Sequence[Flown]]]) -> str:
    """Return one line per law as a Markdown table."""
    rows = []
    for law, by_delay in flown.items():
        last, beyond = margin(by_delay)
        after_mm = 1e3 * float(np.median([after for _, _, after in by_delay[min(by_delay)] if np.isfinite(after)]))
        later = by_delay.get(beyond if beyond is not None else -1, ())
        peaks = [peak for _, peak, _ in later if np.isfinite(peak)]
        peak_text = f"{max(peaks):.2f}" if peaks else "–"
        ended = ", ".join(f"{count} {outcome}" for outcome, count in sorted(Counter(o for o, _, _ in later).items()))
        text = (
            f"above {max(by_delay)}" if beyond is None else f"{last}" if last is not None else f"below {min(by_delay)}"
        )
        rows.append((law, f"{after_mm:.0f}", text, peak_text, ended or "–"))
    largest, became = "largest e_p one step later, m", "what became of those flights"
    return markdown(("law/preset", "e_p after, mm", "delay margin, ms", largest, became), rows) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = table_parser("Fly each law with more and more delay of its setpoints.")
    add_laws(parser, "adaptive/recommended,adaptive/model_free,psc/tuned,csc/tuned", 6)
    a = parser.parse_args(arguments)
    loaded, seeds = laws_of("margins", a.laws, MISSION), range(1, a.laboratories + 1)
    laws = list(loaded)
    flights = list(itertools.product(laws, DELAYS_MS, seeds))
    with ProcessPoolExecutor(a.jobs) as pool:
        results = dict(zip(flights, pool.map(partial(fly, loaded), flights, chunksize=4), strict=True))
    flown = {law: {delay: [results[law, delay, seed] for seed in seeds] for delay in DELAYS_MS} for law in laws}
    publish(table(flown), f"margins --laws {a.laws} --laboratories {a.laboratories}", a.table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
