"""A press on drawn walls in the laboratory, fast loop: `python -m benchmarks.press [--draws 200] [--first-seed 5001]`.

With `--mission probe` the walls are probed instead; then only the normal and the place that were found say something. With `--mission
slide` the tip slides along them; both errors are then RMS over the slide.
With `--datum` each laboratory first probes a wall whose place is known, from two headings and leaned, and the rigid body's pivot is
moved, as in Motive, by what the wall was found too far.

Each seed draws a laboratory, and a wall of 1e3 to 1e5 N/m with a friction of 0.1 to 0.8, tilted by up to 15 deg about both axes and
up to 5 cm from where the mission expects it. Prints a line for each flight and a summary: the steady error of the true and of the
measured force along the wall's normal from 1.5 s after the wanted force is reached, the largest force, the normal and the place that
were found. `--set vehicle.force_source=observer` flies without a force sensor.
"""

from __future__ import annotations

import argparse
import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.analysis.contact import contact_summary
from companion.analysis.log import Array
from companion.commissioning.mocap.pivot import Probed, tip_off_m
from companion.model.contact import ContactMode
from companion.model.types import Outcome, Severity
from companion.sitl_config.loader import load_sitl
from sitl.campaigns.flights import row_of
from sitl.fast.loop import FastFlight

PROBE = "configs/missions/probe.yaml"
DATUM_DEG = ((15.0, 0.0), (-15.0, 0.0), (0.0, 15.0))
"""Yaw of the vehicle and lean of the wall in the three probes of a datum."""
_PRESSING = (ContactMode.PRESS, ContactMode.SLIDE)
SETTLE_TICKS = 300
"""Ticks at the wanted force that do not count as steady."""


@dataclass(frozen=True, slots=True)
class Press:
    """What one flight shows; errors in percent of the wanted force, NaN without a steady press."""

    seed: int
    completed: bool
    crashed: bool
    true_error: float
    measured_error: float
    largest_true_n: float
    """While pressing with the rise of the force."""
    largest_measured_n: float
    largest_in_flight_n: float
    """True force, light touches included."""
    beside_mm: float
    """RMS distance of the pressing or sliding tip from its reference, across the press."""
    events: str
    rotor_distance_m: float
    normal_error_deg: float
    place_error_mm: float


def flown(seed: int, mission: str = "press", datum: bool = False, more: Sequence[str] = ()) -> Press:
    """Fly a mission (`press`, `probe`, `slide`) on the wall of a seed; with a datum, after a probe of a wall whose place is known.

    More settings are those of `companion fly --set`.
    """
    draw = random.Random(seed)
    stiffness_n_m, friction = 10.0 ** draw.uniform(3.0, 5.0), draw.uniform(0.1, 0.8)
    tilt_deg, place_m = [draw.uniform(-15.0, 15.0), draw.uniform(-15.0, 15.0)], draw.uniform(-0.05, 0.05)
    wall = {"point_m": [1.5, 0.0, 1.09], "normal": [-1.0, 0.0, 0.0], "stiffness_n_m": stiffness_n_m}
    wall |= {"friction": friction, "tilt_error_deg": tilt_deg, "place_error_m": place_m}
    sets = [f"world.surfaces={json.dumps([wall])}", f"world.seed={seed}", *more]
    if datum:
        sets.append(f"world.mocap.pivot_offset_m={json.dumps(_moved_pivot_m(seed))}")
    flight = FastFlight(load_sitl(f"configs/missions/{mission}.yaml", world="lab", overrides=sets))
    result = flight.run(300.0)
    contact, layout = flight.plant.machine.contact, result.layout
    assert contact is not None and layout is not None
    placed = contact.surfaces.placed[0]
    contacts = [outputs.contact for outputs in result.outputs]
    true_n = np.array([layout.contact(snapshot.sensors)[1] for snapshot in result.snapshots]) @ np.array(placed.normal)
    measured_n = np.array([math.nan if c is None else c.force_n for c in contacts])
    wanted_n = np.array([0.0 if c is None or c.mode not in _PRESSING else c.wanted_n for c in contacts])
    pressing = wanted_n > wanted_n[-1]
    most_n = float(wanted_n.max())
    steady = np.flatnonzero(pressing & (wanted_n == most_n))[SETTLE_TICKS:]
    sliding = np.flatnonzero([c is not None and c.mode is ContactMode.SLIDE for c in contacts])
    beside_m = (contact_summary(row_of(flight.config.flight, result, None)[1]) or {}).get("path_rms_m")
    found = next((c.surface for c in reversed(contacts) if c is not None and c.surface is not None), None)
    return Press(
        seed=seed,
        completed=result.outputs[-1].outcome is Outcome.COMPLETED,
        crashed=result.crashed,
        true_error=_rms(true_n[sliding], wanted_n[sliding]) if len(sliding) else _error(true_n[steady], most_n),
        measured_error=_rms(measured_n[sliding], wanted_n[sliding])
        if len(sliding)
        else _error(measured_n[steady], most_n),
        largest_true_n=float(true_n[pressing].max(initial=0.0)),
        largest_measured_n=float(measured_n[pressing].max(initial=0.0)),
        largest_in_flight_n=contact.force_max_n,
        beside_mm=math.nan if beside_m is None else 1e3 * beside_m,
        events=" ".join(e.id for o in result.outputs for e in o.events if e.severity is not Severity.INFO),
        rotor_distance_m=contact.rotor_distance_min_m,
        normal_error_deg=math.nan
        if found is None
        else math.degrees(math.acos(min(1.0, float(np.dot(found.normal_world, placed.normal))))),
        place_error_mm=math.nan if found is None else 1e3 * abs(placed.local_m(found.point_world_m)[2]),
    )


def _moved_pivot_m(seed: int) -> list[float]:
    """Return the pivot of the seed's laboratory, moved as `companion mocap pivot` says after three probes of a known wall."""
    probes = []
    for yaw_deg, lean_deg in DATUM_DEG:
        wall = {"point_m": [1.5, 0.0, 1.09], "normal": [-1.0, 0.0, 0.0], "tilt_error_deg": [0.0, lean_deg]}
        sets = [f"world.surfaces={json.dumps([wall])}", f"world.seed={seed}", f"mission.start.yaw_deg={yaw_deg}"]
        flight = FastFlight(load_sitl(PROBE, world="lab", overrides=sets))
        outputs = reversed(flight.run(300.0).outputs)
        found = next(o.contact.surface for o in outputs if o.contact and o.contact.surface)
        assert flight.plant.scene.surfaces is not None
        placed = flight.plant.scene.surfaces.placed[0]
        probes.append(Probed(placed.normal, math.radians(yaw_deg), placed.local_m(found.point_world_m)[2]))
    pivot_m = flight.config.world.mocap.pivot_offset_m
    return [at - off for at, off in zip(pivot_m, tip_off_m(probes), strict=True)]


def _error(force_n: Array, wanted_n: float) -> float:
    """Return the error of the mean force, %."""
    return 100.0 * abs(float(force_n.mean()) / wanted_n - 1.0) if len(force_n) else math.nan


def _rms(force_n: Array, wanted_n: Array) -> float:
    """Return the RMS error of the force, %."""
    return 100.0 * float(np.sqrt(np.mean((force_n / wanted_n - 1.0) ** 2)))


def main() -> None:
    """Fly and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=5001)
    parser.add_argument("--mission", choices=["press", "probe", "slide"], default="press")
    parser.add_argument("--datum", action="store_true")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="as of companion fly")
    arguments = parser.parse_args()
    presses = []
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.draws):
        presses.append(flown(seed, arguments.mission, arguments.datum, arguments.set))
        print(presses[-1], flush=True)
    completed = [press for press in presses if press.completed]
    print(f"{len(completed)} of {len(presses)} completed, {sum(press.crashed for press in presses)} crashed")
    if not completed:
        return
    print(f"nearest rotor {min(press.rotor_distance_m for press in presses):.2f} m")
    for name in (
        *("true_error", "measured_error", "largest_true_n", "largest_measured_n"),
        *("largest_in_flight_n", "beside_mm", "normal_error_deg", "place_error_mm"),
    ):
        values = [getattr(press, name) for press in completed]
        low, high, most = np.nanpercentile(values, (50, 95, 100))
        print(f"{name}: p50 {low:.2f}, p95 {high:.2f}, largest {most:.2f}")


if __name__ == "__main__":
    main()
