"""Flies the catch in the ideal world with one effect of the laboratory at a time, and shows the position error that each causes.

    python -m benchmarks.effects --table effects.md --picture docs/internals/pictures/effects.png

An effect is drawn as in the laboratory of the same seed. Its cost is the median over laboratories of the difference in RMS ||e_p|| from
the ideal flight with the same seed and payload. A flight that was not completed has no cost.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from companion.analysis.plot_style import COLOURS, INK, dress, figure_legend, new_figure, write_png
from companion.config.document import ConfigError
from companion.recorder.versions import versions
from companion.sitl_config.loader import SitlConfig, load_sitl
from companion.sitl_config.world import World
from sitl.campaigns.flights import fly_to_end, row_of, with_world

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
NONE, ALL = "ideal world", "laboratory"

Errors = tuple[float, float]
"""RMS ||e_p|| of one flight before and after the catch, m; NaN if that part was not completed."""


def with_effect(config: SitlConfig, ideal: World, effect: str) -> SitlConfig:
    """Return the configuration of a laboratory in which only one effect acts, by its name; or `NONE`, or `ALL`."""
    if effect == ALL:
        return config
    kept = ("seed", *EFFECTS.get(effect, ()))
    return with_world(config, {key: value for key, value in ideal.model_dump(mode="json").items() if key not in kept})


def fly(configs: Mapping[tuple[str, str], SitlConfig], flight: tuple[str, str, int]) -> Errors:
    """Fly one law with one effect in one laboratory."""
    law, effect, seed = flight
    changes = {"seed": seed, "payload_kg": PAYLOADS_KG[seed % len(PAYLOADS_KG)]}
    flown = fly_to_end(with_world(configs[law, effect], changes))
    rms = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)[0]["rms"]
    before, after = rms["pre"]["e_p_m"], rms["post"]["e_p_m"]
    return (np.nan if before is None else before, np.nan if after is None else after)


def costs_mm(flown: Mapping[tuple[str, str, int], Errors], law: str, effect: str) -> tuple[float, float, int]:
    """Return the cost before and after the catch, mm, and the number of completed flights; `NONE` has its errors themselves."""
    seeds = sorted({seed for _, _, seed in flown})

    def errors(name: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        return 1e3 * np.array([flown[law, name, seed] for seed in seeds])

    of_effect = errors(effect)
    cost = of_effect if effect == NONE else of_effect - errors(NONE)
    known = [column[np.isfinite(column)] for column in cost.T]
    before, after = (float(np.median(column)) if len(column) else np.nan for column in known)
    return before, after, int(np.isfinite(of_effect[:, 1]).sum())


def table(flown: Mapping[tuple[str, str, int], Errors], laws: Sequence[str], effects: Sequence[str]) -> str:
    """Return the costs as a Markdown table."""
    number = len(flown) // len(laws) // len(effects)
    heads = [f"{law}, {part}, mm" for law in laws for part in ("before", "after")]
    lines = ["| effect | " + " | ".join(heads) + " |", "|---" * (1 + len(heads)) + "|"]
    for effect in effects:
        cells = []
        for law in laws:
            before, after, completed = costs_mm(flown, law, effect)
            sign = "" if effect == NONE else "+"
            cells += [f"{before:{sign}.1f}", f"{after:{sign}.1f}"]
            cells[-1] += f" ({completed} of {number})" if completed < number else ""
        lines.append(f"| {effect} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(flown: Mapping[tuple[str, str, int], Errors], laws: Sequence[str], effects: Sequence[str], path: Path) -> None:
    """Draw the cost of each effect after the catch as bars."""
    figure = new_figure(5.2)
    ax = figure.subplots()
    dress(ax)
    step = 0.8 / len(laws)
    for k, law in enumerate(laws):
        at = np.arange(len(effects)) + (k - (len(laws) - 1) / 2) * step
        costs = [costs_mm(flown, law, effect)[1] for effect in effects]
        ax.barh(at, costs, height=0.9 * step, color=COLOURS[k], label=law, zorder=3)
    ax.axvline(0.0, color=INK, lw=0.8, zorder=4)
    ax.set_yticks(range(len(effects)), effects)
    ax.invert_yaxis()
    ax.set_xlabel(r"additional RMS $\|e_p\|$ after the catch [mm]")
    figure_legend(figure, "Cost of each effect alone", *ax.get_legend_handles_labels(), columns=4)
    write_png(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(description="Fly the effects of the laboratory one at a time.")
    parser.add_argument("--laws", default="adaptive/paper,adaptive/recommended", help="law/preset, ... (%(default)s)")
    parser.add_argument("--laboratories", type=int, default=8, help="flights per law and effect (%(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (%(default)s)")
    parser.add_argument("--table", type=Path, help="Markdown file to write; absent: standard output")
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    a = parser.parse_args(arguments)
    laws, effects = a.laws.split(","), (NONE, *EFFECTS, ALL)
    try:
        loaded = {law: load_sitl(MISSION, None, *law.split("/", 1), world="lab") for law in laws}
    except ConfigError as error:
        print(f"effects: {error}", file=sys.stderr)
        return 2
    ideal = load_sitl(MISSION, world="ideal").world
    configs = {(law, effect): with_effect(loaded[law], ideal, effect) for law in laws for effect in effects}
    flights = [(*key, seed) for key in configs for seed in range(1, a.laboratories + 1)]
    with ProcessPoolExecutor(a.jobs) as pool:
        flown = dict(zip(flights, pool.map(partial(fly, configs), flights, chunksize=4), strict=True))
    command = f"python -m benchmarks.effects --laws {a.laws} --laboratories {a.laboratories}"
    text = table(flown, laws, effects) + f"\nFlown by `{command}` at {versions().get('git', 'unknown')[:10]}.\n"
    if a.table is None:
        print(text, end="")
    else:
        a.table.write_text(text, encoding="utf-8")
    if a.picture is not None:
        draw(flown, laws, [*EFFECTS, ALL], a.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
