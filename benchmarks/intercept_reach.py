"""Compares the balls that an interception catches with those that the vehicle could reach at best.

    python -m benchmarks.intercept_reach --draws 200 --seed 401 --scatter 1 3 6 --out DIR

The flights are those of `companion robustness intercept --world careless --set world.thrower.scatter=S`. For each throw, the smallest
distance between ball and net's centre that is possible during the flight is computed from the world's truth. These are bounds, in
favour of the vehicle:

* `best`: the ball's whole path is known when `ball_seen` is reported, or after 8 frames without it. The tilt turns at PX4's
  MC_ROLLRATE_MAX at once, up to `airframe.tilt_max_deg` to one side and then to the other; the thrust is at once anything up to
  `airframe.thrust_max_n`, also while the tilt turns. The net is fixed to the body, which need not stop, and no part of the vehicle is
  in the ball's way. The body is in the room and within the tether's reach, give or take the net's radius and the swing by the tilt.
* `arm`: the same, and the arm moves the net by up to 0.15 m in its plane (x, z).
* `late`: as `best`, with the dead time and the swing of the net that were found in the fast loop, and the mission's limit of thrust.
* `box`: as `late`, with the body in the phase's box, and only where the ball comes from before the opening.
* `flown`: no bound, but an example: with one change of the tilt and a constant vertical acceleration, a vehicle that accelerates like
  the one in the fast loop meets the ball as in `box`, keeps it 40 mm away from the rotor disks until then, and can stop in the room.
* `planner`: the phase's own choice of a meeting for the true path, without the rotors' clearance.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.report import commit, print_table, write_json
from companion.analysis.plot_style import COLOURS, INK, SOFT, dress, figure_legend, new_figure, write_png, write_svg
from companion.config.document import ConfigError
from companion.control.arm_model import manipulator_of
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Vec3
from companion.phases.intercept.ball import HORIZON_S, STEP_S, Point, carried
from companion.phases.intercept.choice import CHASED_M
from companion.phases.intercept.lag import Lag
from companion.phases.intercept.meeting import FACING, SWINGS, Reach, meetings
from companion.phases.intercept.motion import Bounds, State
from companion.phases.intercept.net import opening
from companion.phases.intercept.phase import Intercept
from companion.phases.intercept.rotors import clearance_m
from companion.safety.governor import SafeSet
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.campaigns.flights import limit_s, row_of, with_world
from sitl.campaigns.robustness import prepare
from sitl.fast.loop import FastFlight

SEEN_FRAMES = 8
STOP_S = 0.1
"""Time for which the body goes on before it brakes at full tilt."""
TILT_RAD_S = 3.84
"""PX4's MC_ROLLRATE_MAX and MC_PITCHRATE_MAX."""
DEAD_S, SIDEWAYS = 0.07, 0.82
"""Time from the setpoint until the tilt turns at that rate, and the horizontal acceleration as a share of that of the tilt: fitted to
flights at full tilt both ways without a law, as in the test of this module."""
ARM_M = 0.15
SLOPES = np.radians(np.arange(-90.0, 90.1, 5.0))
"""Directions, from the horizontal, in which the reach is known; the set of the places in reach is the convex one that they bound."""
LEVELS = BEST, ARM, LATE, BOX, FLOWN, PLANNER = "best", "arm", "late", "box", "flown", "planner"
TIMES_S = STEP_S * np.arange(1, round(HORIZON_S / STEP_S) + 1)

Array = np.ndarray[Any, np.dtype[np.float64]]
Row = dict[str, Any]


class Reachable:
    """How far the net can come in each direction, at `TIMES_S` from the start.

    Args:
        config: vehicle.
        net_m: the net ahead of and below the body's origin of the level vehicle.
        thrust_share: largest thrust as a fraction of the airframe's.
        dead_s: time after which tilt and thrust begin to change.
    """

    def __init__(self, config: SitlConfig, net_m: tuple[float, float], thrust_share: float, dead_s: float) -> None:
        airframe, most = config.vehicle.airframe, STEP_S * TILT_RAD_S
        self.net_m, self.dead_s, late = net_m, dead_s, round(dead_s / STEP_S)
        turned = np.where(np.arange(0.0, HORIZON_S, 2.0 * STEP_S)[:, None] >= TIMES_S, 1.0, -1.0)
        wanted = np.radians(airframe.tilt_max_deg) * np.concatenate(
            [share * turned for share in (1.0, 0.75, 0.5, 0.25, 0.0)]
        )
        tilt = np.zeros((len(wanted), len(TIMES_S)))
        for k in range(late, len(TIMES_S)):
            tilt[:, k] = tilt[:, k - 1] + np.clip(wanted[:, k - late] - tilt[:, k - 1], -most, most)
        self.sin, self.cos = np.sin(tilt), np.cos(tilt)
        self._aside, self._up = np.cos(SLOPES)[:, None, None], np.sin(SLOPES)[:, None, None]
        # Thrust is full while it moves the body in the direction, and 0 otherwise.
        self.thrust_m_s2 = thrust_share * airframe.thrust_max_n / airframe.mass_kg
        push = (
            self.thrust_m_s2 * np.maximum(0.0, self._aside * self.sin + self._up * self.cos) - GRAVITY_M_S2 * self._up
        )
        push[:, :, :late] = 0.0
        self._moved = STEP_S**2 * np.cumsum(np.cumsum(push, axis=2), axis=2)

    def swing_m(self, ahead: Array | float) -> tuple[Array, Array]:
        """Return how far each tilt swings the net, along the motion and up; `ahead` is the cosine of its angle to the net."""
        (x, z), rises = self.net_m, 1.0 - self.cos
        return z * self.sin - x * ahead * rises, -z * rises - x * ahead * self.sin

    def _reach_m(self, ahead: Array | float) -> Array:
        """Return the reach by `SLOPES` and `TIMES_S`."""
        aside, up = self.swing_m(ahead)
        return np.asarray(np.max(self._moved + self._aside * aside + self._up * up, axis=1))

    def distance_m(self, needed_m: Array) -> Array:
        """Return the smallest distances of the net from places given relative to it, one for each of `TIMES_S`."""
        level = np.hypot(needed_m[:, 0], needed_m[:, 1])
        reach = self._reach_m(needed_m[:, 0] / np.maximum(level, 1e-9))
        over = np.outer(np.cos(SLOPES), level) + np.outer(np.sin(SLOPES), needed_m[:, 2]) - reach
        return np.asarray(np.maximum(0.0, over.max(axis=0)))

    def sideways_m(self) -> Array:
        """Return how far the net comes sideways at its own height."""
        return np.asarray((self._reach_m(0.0)[1:-1] / np.cos(SLOPES)[1:-1, None]).min(axis=0))


def fly(config: SitlConfig) -> Row | None:
    """Fly one laboratory; return its throw and what became of it, or None if nothing was thrown."""
    fast = FastFlight(config)
    found: list[Any] = []
    scene, world = fast.plant.scene, fast.config.world
    net, payload = scene.data.xpos[scene.model.body("net").id], scene.payload

    def watch(outputs: Any) -> bool:
        ball, q, v = payload.ball, scene.data.qpos, scene.data.qvel
        if not found and ball is not None and payload.flying is not None:
            places = (q[ball.q : ball.q + 3], v[ball.v : ball.v + 3], net)
            found.append((scene.t_s, *(tuple(place.tolist()) for place in places), outputs.reference))
        return False

    result = fast.run(limit_s(config), until=watch)
    if not found:
        return None
    t_s, ball_m, ball_m_s, net_m, home = found[0]
    events = [event for outputs in result.outputs for event in outputs.events if event.t_s >= t_s]
    unseen_s = t_s + SEEN_FRAMES / config.vehicle.devices.mocap.rate_hz
    seen_s = next((event.t_s for event in events if event.id == "ball_seen"), unseen_s)
    row, _ = row_of(fast.config.flight, result, payload.caught_t_s)
    area_m2 = np.pi * world.payload_radius_m**2
    return {
        "seed": world.seed, "t_s": t_s, "ball_m": ball_m, "ball_m_s": ball_m_s, "net_m": net_m, "home": home, "seen_s": seen_s,
        "drag_per_m": 0.6 * world.payload_drag_coefficient * area_m2 / world.payload_kg, "miss_m": result.miss_m,
        "caught": row["caught"], "outcome": row["outcome"], "e_p_m": row["rms"]["post"]["e_p_m"],
        "events": [f"{event.t_s - seen_s:+.2f} {event.id}: {event.text}" for event in events if event.t_s < seen_s + 3.0],
    }  # fmt: skip


def bounds_of(config: SitlConfig, throw: Row) -> tuple[Reachable, Reachable, Reach, Bounds]:
    """Return the reach of `best` and of `late`, that of the phase's planner, and its limits."""
    vehicle, mission, home = config.vehicle, config.mission, throw["home"]
    (box_m,) = [phase.box_m for phase in mission.phases if isinstance(phase, Intercept)]
    x, _, z = manipulator_of(vehicle).net_body_m(home.arm_rad)
    best = Reachable(config, (x, z), 1.0, 0.0)
    late = Reachable(config, (x, SWINGS * z), mission.limits.thrust_share_max, DEAD_S)
    limits = Bounds(vehicle, mission.limits, SafeSet(vehicle), home.position_world_m, box_m)
    return best, late, Reach(-z, HORIZON_S), limits


def judged(config: SitlConfig, throw: Row) -> Row:
    """Return the throw with when and where its ball passes the waiting net, and whether each of `LEVELS` reaches it."""
    best, late, planned, bounds = bounds_of(config, throw)
    radius_m, safe, home = config.vehicle.tip_radius_m, SafeSet(config.vehicle), throw["home"].position_world_m
    out = opening(manipulator_of(config.vehicle), throw["home"])
    t_s, p, v, path = throw["t_s"], throw["ball_m"], throw["ball_m_s"], []
    for at_s in (throw["seen_s"] + TIMES_S).tolist():
        p, v = carried(p, v, (0.0, 0.0, 0.0), at_s - t_s, throw["drag_per_m"])
        t_s = at_s
        path.append(Point(t_s, p, v, 0.0))
    places, ways = (np.array([getattr(point, name) for point in path]) for name in ("position_m", "velocity_m_s"))
    needed, offset = places - throw["net_m"], np.subtract(throw["net_m"], home)
    bodies = [tuple(body) for body in (places - offset).tolist()]
    beyond_m = np.array([max(safe.breach_walls_m(body), safe.breach_tether_m(body)) for body in bodies])
    slack_m = radius_m - best.net_m[1] * np.sin(np.radians(config.vehicle.airframe.tilt_max_deg))
    flies = places[:, 2] > radius_m
    room, faces = flies & (beyond_m <= slack_m), -(ways @ out) >= FACING * np.linalg.norm(ways, axis=1)
    box = flies & faces & np.array([bounds.in_box(body) for body in bodies])
    by_arm = needed.copy()
    by_arm[:, ::2] *= np.maximum(0.0, 1.0 - ARM_M / np.hypot(needed[:, 0], needed[:, 2]))[:, None]
    tried = {
        BEST: (best, needed, room),
        ARM: (best, by_arm, room),
        LATE: (late, needed, room),
        BOX: (late, needed, box),
    }
    least_m = {
        level: np.min(reach.distance_m(to), where=at, initial=np.inf) for level, (reach, to, at) in tried.items()
    }
    clear_m = room_m(config, late, home, needed, places, box) if least_m[BOX] <= radius_m else -np.inf
    begin, seen_s, flown = State(home, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), throw["seen_s"], path[: int(flies.sum())]
    plans = meetings(seen_s, begin, Lag(), flown, tuple(offset.tolist()), out, bounds, planned, None)
    passing = int(np.argmin(np.linalg.norm(needed, axis=1)))
    return {
        **{key: value for key, value in throw.items() if key != "home"},
        **{level: bool(distance_m <= radius_m) for level, distance_m in least_m.items()},
        FLOWN: clear_m >= CHASED_M,
        PLANNER: next(plans, None) is not None,
        "left_s": float(TIMES_S[passing]),
        "away_m": needed[passing].tolist(),
        "least_m": {level: round(float(distance_m), 3) for level, distance_m in least_m.items()},
    }


def room_m(config: SitlConfig, late: Reachable, home_m: Vec3, needed_m: Array, ball_m: Array, where: Array) -> float:
    """Return the largest distance from the rotor disks at which a flight leaves a ball before it meets it; -inf if none meets it.

    Args:
        home_m: place of the waiting body.
        needed_m: places of the ball relative to the waiting net, at `TIMES_S`.
        ball_m: the same, relative to the world.
        where: where it may be met.
    """
    airframe, safe, most = config.vehicle.airframe, SafeSet(config.vehicle), -np.inf
    slopes = SIDEWAYS * STEP_S * np.cumsum(late.sin / late.cos, axis=1)
    ways = np.cumsum(slopes, axis=1) * STEP_S
    for k in np.flatnonzero(where)[::2].tolist():
        level, flies_s = max(1e-9, math.hypot(*needed_m[k, :2])), TIMES_S - late.dead_s
        ux, uy = (needed_m[k, :2] / level).tolist()
        aside, up = late.swing_m(ux)
        rise = GRAVITY_M_S2 + 2.0 * (needed_m[k, 2] - up[:, k]) / max(STEP_S, flies_s[k]) ** 2
        lightest = late.cos[:, : k + 1].min(axis=1)
        meets = np.abs(rise * ways[:, k] + aside[:, k] - level) <= config.vehicle.tip_radius_m
        for n in np.flatnonzero(meets & (rise > 0.0) & (rise <= late.thrust_m_s2 * lightest)).tolist():
            along, high = rise[n] * ways[n], 0.5 * (rise[n] - GRAVITY_M_S2) * np.maximum(0.0, flies_s) ** 2
            speed = rise[n] * slopes[n, k]
            rest = (
                along[k]
                + STOP_S * speed
                + speed * abs(speed) / (2.0 * GRAVITY_M_S2 * math.tan(math.radians(airframe.tilt_max_deg)))
            )
            if not safe.holds((home_m[0] + rest * ux, home_m[1] + rest * uy, home_m[2] + high[k])):
                continue
            x, y, z = (ball_m[: k + 1] - home_m).T
            ahead, across, z = x * ux + y * uy - along[: k + 1], y * ux - x * uy, z - high[: k + 1]
            sin, cos = late.sin[n, : k + 1], late.cos[n, : k + 1]
            ahead, z = ahead * cos - z * sin, ahead * sin + z * cos
            places = np.stack([ahead * ux - across * uy, ahead * uy + across * ux, z], axis=1).tolist()
            most = max(most, clearance_m(airframe, [(px, py, pz) for px, py, pz in places]))
    return most


def counts(scatter: float, thrown: Sequence[Row]) -> dict[str, str]:
    """Return the line of the table of one scatter."""
    missed = [row for row in thrown if not row["caught"]]
    errors = [1e3 * row["e_p_m"] for row in thrown if row["e_p_m"] is not None] or [np.nan]
    p50, p95 = np.percentile(errors, [50, 95])
    return {
        "scatter": f"{scatter:g}", "thrown": str(len(thrown)), **{level: str(sum(r[level] for r in thrown)) for level in LEVELS},
        "caught": str(len(thrown) - len(missed)), **{f"missed {level}": str(sum(r[level] for r in missed)) for level in LEVELS},
        "beyond": str(sum(row["caught"] and not row[BEST] for row in thrown)), "e_p": f"{p50:.0f}, {p95:.0f}",
    }  # fmt: skip


def draw(config: SitlConfig, flown: dict[float, list[Row]], throw: Row, path: Path) -> None:
    """Draw where the balls pass the waiting net, and how far it can come."""
    figure = new_figure(4.4)
    panels = np.atleast_1d(figure.subplots(1, len(flown), sharey=True))
    best, late, planned, bounds = bounds_of(config, throw)
    pushed = [min(bounds.acceleration_m_s2 * planned.of(t)[1], bounds.speed_m_s * t) for t in TIMES_S]
    lines = [
        ("best, sideways", best.sideways_m(), "-"),
        ("late, sideways", late.sideways_m(), "--"),
        ("reference of the phase, sideways", np.array(pushed), ":"),
    ]
    kinds = [
        ("caught", [True], [True, False], COLOURS[0], "o"),
        ("missed, within best", [False], [True], COLOURS[1], "X"),
        ("missed, beyond best", [False], [False], SOFT, "X"),
    ]
    for ax, (scatter, rows) in zip(panels, flown.items(), strict=True):
        dress(ax)
        for label, caught, reachable, colour, marker in kinds:
            points = [row for row in rows if row["caught"] in caught and row[BEST] in reachable]
            x, y = [row["left_s"] for row in points], [np.linalg.norm(row["away_m"]) for row in points]
            ax.plot(x, y, marker, color=colour, ms=5, mec="white", mew=0.4, label=label)
        for label, reach_m, style in lines:  # the reference's reach is known in steps of two
            ax.plot(TIMES_S[1::2], reach_m[1::2], style, color=INK, lw=1.3, label=label)
        ax.set(xlim=(0.0, 1.2), ylim=(0.0, 1.6), xlabel="time from seeing to arrival [s]")
        ax.set_title(f"scatter {scatter:g}", loc="left", fontsize=10, color=INK)
    panels[0].set_ylabel("distance of the ball from the waiting net [m]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure_legend(figure, "Balls that pass the waiting net", handles, labels, columns=3)
    (write_svg if path.suffix == ".svg" else write_png)(figure, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0, or 2 on bad input."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.intercept_reach")
    parser.add_argument("--draws", type=int, default=200, help="flights per scatter (%(default)s)")
    parser.add_argument("--seed", type=int, default=401, help="seed of the draws (%(default)s)")
    parser.add_argument("--scatter", type=float, nargs="+", default=[1.0, 3.0, 6.0], metavar="S")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures and figures")
    a = parser.parse_args(arguments)
    flown: dict[float, list[Row]] = {}
    flights, throw = [{"number": number, "world": None} for number in range(a.draws)], None
    for scatter in a.scatter:
        try:
            config = load_sitl("intercept", overrides=[f"world.thrower.scatter={scatter:g}"], world="careless")
        except ConfigError as error:
            print(f"intercept_reach: {error}", file=sys.stderr)
            return 2
        flown[scatter] = []
        for flight in prepare({"flights": flights, "seed": a.seed, "fixed": ["thrower"]}, [config]):
            if (found := fly(with_world(config, flight["world"]))) is not None:
                throw = found
                flown[scatter].append({"number": flight["number"], **judged(config, throw)})
    print_table("Interception", [counts(*each) for each in flown.items()], Console(width=160))
    a.out.mkdir(parents=True, exist_ok=True)
    write_json(a.out / "intercept_reach.json", flown)
    for suffix in ("svg", "png"):
        if throw is not None:
            draw(config, flown, throw, a.out / f"intercept_reach.{suffix}")
    print(f"Flown at commit {commit()}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
