"""Which effect of the laboratory matters: each is added in a random order to the ideal world, until it is the laboratory.

    python -m benchmarks.effects --table effects.md --picture docs/internals/pictures/effects.png

Each laboratory adds the effects in an order of its own. What an effect adds to the RMS ||e_p|| after the catch is thus measured beside
many other effects, and the means add up to the difference between laboratory and ideal world: they are Shapley values, estimated from
permutations (Castro et al., 2009). Every law flies the same worlds in the same order, so that the same holds for the difference between
two laws: an effect whose share in it is certain could turn their order. A flight that is not completed with the payload says nothing
about the effects before and after it.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.report import add_laws, laws_of, publish, table_parser
from companion.analysis.plot_style import COLOURS, INK, dress, figure_legend, new_figure, write_png
from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.world import World
from sitl.campaigns.flights import fly_to_end, row_of, with_world
from tools.docs.tables import markdown

MISSION = Path(__file__).parents[1] / "configs" / "missions" / "catch.yaml"
PAYLOADS_KG = (0.1, 0.2, 0.3)
EFFECTS = {
    "machine": ("machine", "mass_error", "link_mass_error", "hover_thrust_error"),
    "force-torque sensor": ("force_sensor", "force_scale"),
    "gusts": ("air",),
    "downwash": ("downwash",),
    "slack tether": ("tether_line",),
    "IMU": ("imu", "barometer"),
    "motion capture": ("mocap", "markers"),
    "net": ("net",),
    "thrower": ("thrower",),
    "rotors": ("rotors",),
    "battery": ("battery", "battery_start"),
    "servos": ("servo_mechanics",),
    "compliance": ("compliance",),
}
"""Keys of the world that belong to each effect."""
IDEAL, LABORATORY = "ideal world", "laboratory"

Errors = np.ndarray[tuple[int, int], np.dtype[np.float64]]
"""RMS ||e_p|| after the catch, mm: one row per laboratory, one column per number of effects; NaN without the payload."""


def order(seed: int) -> list[str]:
    """Return the order in which the laboratory with this seed adds the effects."""
    return [list(EFFECTS)[k] for k in np.random.default_rng(seed).permutation(len(EFFECTS))]


def with_effects(config: SitlConfig, ideal: World, effects: Sequence[str]) -> SitlConfig:
    """Return the configuration of a laboratory in which only these effects act, each with its values in the whole laboratory."""
    kept = {"seed", *(key for effect in effects for key in EFFECTS[effect])}
    return with_world(config, {key: value for key, value in ideal.model_dump(mode="json").items() if key not in kept})


def fly(loaded: Mapping[str, SitlConfig], ideal: World, flight: tuple[str, int, int]) -> float:
    """Fly a law in the laboratory of a seed with the first effects of its order, and return its entry of `Errors`."""
    law, seed, number = flight
    payload_kg = PAYLOADS_KG[seed % len(PAYLOADS_KG)]
    laboratory = with_effects(loaded[law], ideal, order(seed)[:number])
    flown = fly_to_end(with_world(laboratory, {"seed": seed, "payload_kg": payload_kg}))
    after_m = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)[0]["rms"]["post"]["e_p_m"]
    return float(np.nan if after_m is None else 1e3 * after_m)


def added_mm(errors: Errors, seeds: Sequence[int]) -> dict[str, tuple[float, float]]:
    """Return for each effect, and for ideal world and laboratory, the mean of what it adds and half of its 95 % interval, mm."""
    steps = np.diff(errors, axis=1)
    of = {
        effect: np.array([row[order(seed).index(effect)] for row, seed in zip(steps, seeds, strict=True)])
        for effect in EFFECTS
    }
    found = {}
    for name, values in {IDEAL: errors[:, 0], **of, LABORATORY: errors[:, -1]}.items():
        known = values[np.isfinite(values)]
        half = 1.96 * float(np.std(known, ddof=1)) / math.sqrt(len(known)) if len(known) > 1 else math.nan
        found[name] = (float(np.mean(known)) if len(known) else math.nan, half)
    return found


def table(flown: Mapping[str, Errors], seeds: Sequence[int]) -> str:
    """Return what each effect adds as a Markdown table, and what it adds to the difference of each law from the first one."""
    first, *others = flown
    shown = {f"{law}, mm": errors for law, errors in flown.items()}
    shown |= {f"{law} - {first}, mm": flown[law] - flown[first] for law in others}
    columns = {title: added_mm(errors, seeds) for title, errors in shown.items()}
    rows = [
        (name, *(f"{mean:+.1f} ± {half:.1f}" for mean, half in (column[name] for column in columns.values())))
        for name in (IDEAL, *EFFECTS, LABORATORY)
    ]
    return markdown(("effect", *columns), rows) + "\n"


def draw(flown: Mapping[str, Errors], seeds: Sequence[int], path: Path) -> None:
    """Draw what each effect adds after the catch as bars with their 95 % intervals."""
    figure = new_figure(5.2)
    ax = figure.subplots()
    dress(ax)
    step = 0.8 / len(flown)
    for k, (law, errors) in enumerate(flown.items()):
        at = np.arange(len(EFFECTS)) + (k - (len(flown) - 1) / 2) * step
        found = added_mm(errors, seeds)
        means, halves = zip(*(found[effect] for effect in EFFECTS), strict=True)
        ax.barh(at, means, xerr=halves, height=0.9 * step, color=COLOURS[k], ecolor=INK, label=law, zorder=3)
    ax.axvline(0.0, color=INK, lw=0.8, zorder=4)
    ax.set_yticks(range(len(EFFECTS)), list(EFFECTS))
    ax.invert_yaxis()
    ax.set_xlabel(r"added to RMS $\|e_p\|$ after the catch [mm]")
    figure_legend(figure, "What each effect adds, beside the others", *ax.get_legend_handles_labels(), columns=4)
    write_png(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = table_parser("Add the effects of the laboratory one after the other.")
    add_laws(parser, "adaptive/recommended,psc/tuned,csc/tuned", 40)
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    a = parser.parse_args(arguments)
    loaded, seeds = laws_of("effects", a.laws, MISSION), range(1, a.laboratories + 1)
    laws = list(loaded)
    ideal = load_sitl(MISSION, world="ideal").world
    flights = [(law, seed, number) for law in laws for seed in seeds for number in range(len(EFFECTS) + 1)]
    with ProcessPoolExecutor(a.jobs) as pool:
        errors = np.array(list(pool.map(partial(fly, loaded, ideal), flights, chunksize=4)))
    flown = dict(zip(laws, errors.reshape(len(laws), len(seeds), -1), strict=True))
    publish(table(flown, seeds), f"effects --laws {a.laws} --laboratories {a.laboratories}", a.table)
    if a.picture is not None:
        draw(flown, seeds, a.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
