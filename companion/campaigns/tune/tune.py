"""`companion tune`: searches gains, judges them in held-out laboratories, and writes them if they are better."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Any

from rich.console import Console

from companion.campaigns.cost import flight_cost
from companion.campaigns.plan import WORKERS, duration_text, where_flown
from companion.campaigns.process import CampaignError, Message
from companion.campaigns.runner import Row, print_lines, to_json, versions
from companion.campaigns.tune.draws import Draws, draws_of
from companion.campaigns.tune.flights import Flights, Interrupted
from companion.campaigns.tune.output import show, write
from companion.campaigns.tune.result import HeldOut, Result
from companion.campaigns.tune.search import Evaluation, Search, batches_of
from companion.campaigns.tune.space import Point, Space
from companion.config.controller import ControllerConfig
from companion.config.document import ConfigError
from companion.model.exit_codes import EXIT_ABORTED, EXIT_LOST, EXIT_OK, EXIT_REFUSED
from companion.plugins import CONTROL_LAWS, find
from companion.runtime.console import print_error
from companion.sitl_config.loader import SitlConfig

PLAN_SAMPLE = 4
"""Number of flights of the search, and of whole missions, that a plan flies."""


@dataclass(frozen=True, kw_only=True)
class Tune:
    """What to search.

    Raises:
        ConfigError: the control law declares too few gains.
    """

    config: SitlConfig
    """Effective configuration; its gains are the start."""
    budget: int
    """Number of candidates, the start included."""
    seed: int
    training: int
    """Number of laboratories of the search."""
    held_out: int
    command: str
    fly: str
    """The command line that flies the gains, without the option for the controller file."""
    overrides: Sequence[str] = ()
    jobs: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if len(self.space.axes) < 2:
            law = find(CONTROL_LAWS, self.config.controller.law)
            text = f"companion tune: {law}: expected a law that declares two or more gains to tune, found "
            raise ConfigError(f"{text}{len(self.space.axes)} (tuned_gains of its settings; docs/internals/tune.md)")

    @property
    def space(self) -> Space:
        """Return the search space."""
        return Space.of(self.config.controller, self.config.vehicle)

    @property
    def draws(self) -> tuple[Draws, Draws]:
        """Return the laboratories of the search and the held-out ones."""
        config = self.config
        return draws_of(config.mission, config.vehicle, self.overrides, self.seed, self.training, self.held_out)

    @property
    def job(self) -> Message:
        """Return the job for `sitl.campaigns`, whose flights follow in batches."""
        job = {"campaign": "tune", "configs": [self.config.model_dump(mode="json")], "batches": True}
        # More processes than a batch has flights would never fly.
        most = max(*batches_of(self.budget, len(self.space.axes), self.training), self.held_out)
        return {**job, "jobs": min(self.jobs or os.cpu_count() or 1, most), "scheduler": self.scheduler}

    def settings(self) -> dict[str, Any]:
        """Return what the result of the search depends on, except for the budget."""
        sources, controller = self.config.sources, self.config.controller
        plain = self.config.model_dump(mode="json", exclude={"sources"})
        whole = hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]
        used = {key: value for key, value in versions().items() if key in ("git", "companion", "mujoco", "numpy")}
        return {
            "controller": controller.law,
            "preset": controller.preset,
            "controller_file": sources.controller,
            "vehicle": sources.vehicle,
            "mission": sources.mission,
            "world": self.config.laboratory.name,
            "overrides": list(self.overrides),
            "seed": self.seed,
            "training_laboratories": self.training,
            "held_out_laboratories": self.held_out,
            "configuration": whole,
            "versions": {**used, "cma": importlib.metadata.version("cma")},
        }


def run(tune: Tune, out: Path, console: Console | None) -> int:
    """Search, judge, write the results into `out` and print them; return the exit code.

    Args:
        out: an existing folder; if it has the flights of the same search, that search goes on.
        console: where to print; None to print JSON instead.

    Raises:
        ConfigError: the folder holds another search.
    """
    space, (training, held_out) = tune.space, tune.draws
    total = sum(batches_of(tune.budget, len(space.axes), training.count)) + 2 * held_out.count

    def evaluate(points: Sequence[Point], numbers: Sequence[int]) -> list[list[float]]:
        settings = [space.settings(point) for point in points]
        best = f"best {search.best.cost:.4f}" if search.evaluations and search.start.costs else "start"
        rows = flights.fly(_flights(settings, training, numbers), f"{len(search.evaluations)}/{tune.budget}, {best}")
        costs = [flight_cost(row) for row in rows]
        return [costs[at : at + len(numbers)] for at in range(0, len(costs), len(numbers))]

    search = Search(space.start_point, training.count, tune.budget, tune.seed, evaluate)
    try:
        with Flights(tune.job, out, tune.settings(), total, out / "campaign.log") as flights:
            search.run(space.start_point)
            judged = _judge(search, space, held_out, flights)
        result = Result(tune.settings(), tune.command, tune.fly, space, search, training, held_out, judged)
        file = write(result, out)
    except OSError as error:
        print_error(f"companion tune: {error.filename or out}: cannot be written: {error.strerror}")
        return EXIT_LOST
    except Interrupted:
        print_error(f"companion tune: interrupted; the same command with --out {out} goes on from there")
        return EXIT_ABORTED
    except CampaignError as error:
        print_error(f"companion tune: {error}")
        return error.exit_code
    show(result, out, console, file)
    return EXIT_OK if result.better else EXIT_REFUSED


def _flights(settings: Sequence[ControllerConfig], draws: Draws, numbers: Sequence[int]) -> list[Message]:
    plain = [one.model_dump(mode="json") for one in settings]
    return [draws.flight(one, number) for one in plain for number in numbers]


def _judge(search: Search, space: Space, draws: Draws, flights: Flights) -> HeldOut:

    def rows_of(one: Evaluation, about: str) -> list[Row]:
        return flights.fly(_flights([space.settings(one.point)], draws, range(draws.count)), about)

    return HeldOut(rows_of(search.start, "held out, before"), rows_of(search.best, "held out, after"))


def plan(tune: Tune, console: Console | None) -> int:
    """Fly some flights of the start and print how long the whole search takes; no files are written; return the exit code."""
    space, (training, held_out) = tune.space, tune.draws
    with tempfile.TemporaryDirectory() as folder:
        flights = Flights(tune.job, None, {}, 2 * PLAN_SAMPLE, Path(folder) / "campaign.log")
        cpu_s = []
        try:
            with flights:
                for draws in (training, held_out):
                    flights.fly(_flights([space.start], draws, range(min(PLAN_SAMPLE, draws.count))), "")
                    cpu_s.append(mean(message["cpu_s"] for message in flights.flown))
                    at_once = flights.flown[-1]["at_once"]
                    flights.flown.clear()
        except Interrupted:
            print_error("companion tune: interrupted")
            return EXIT_ABORTED
        except CampaignError as error:
            print_error(f"companion tune: {error}")
            return error.exit_code
    batches = [(flown, cpu_s[0]) for flown in batches_of(tune.budget, len(space.axes), training.count)]
    batches.append((2 * held_out.count, cpu_s[1]))
    count = sum(flown for flown, _ in batches)
    # A batch ends with its last flight; each flight has a core of its own.
    seconds = {
        workers: sum(-(-flown // workers) * each_s for flown, each_s in batches) for workers in (at_once, *WORKERS)
    }
    if console is None:
        data = {"flights": count, "cpu_s": cpu_s[0], "whole_mission_cpu_s": cpu_s[1], "at_once": at_once}
        sys.stdout.write(to_json({**data, "duration_s": seconds[at_once], "durations_s": seconds}))
        return EXIT_OK
    print_lines(
        console,
        f"processor time of a flight: {cpu_s[0]:.2f} s in the search, {cpu_s[1]:.2f} s of a whole mission",
        f"{count} flights of {tune.budget} candidates, {at_once} at a time {where_flown(tune.scheduler)}: "
        f"{duration_text(seconds[at_once])}",
        *(f"on {workers} Dask workers, one core each: {duration_text(seconds[workers])}" for workers in WORKERS),
    )
    return EXIT_OK
