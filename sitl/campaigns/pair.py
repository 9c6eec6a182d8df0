"""Flies the flights of `companion robustness` of a team file.

A flight is {name, number}; its laboratory is drawn from the job's seed and the number. The configurations of the job are those of the
left and of the right member.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.model.types import Outcome, SafetyAction
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.team import SEED_APART, TeamConfig
from sitl.campaigns.flights import laboratory_of, limit_s, with_world
from sitl.campaigns.runner import Data
from sitl.fast.result import FastResult
from sitl.fast.team import FastTeam, TeamResult

_WORSE = (Outcome.COMPLETED, Outcome.REFUSED, Outcome.ABORTED, Outcome.LOST, Outcome.CRASHED)


def prepare(job: Data, configs: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job, each with the seed of its laboratory and the right member's configuration."""
    right = configs[1].model_dump_json()
    return [
        {
            **flight,
            "seed": int(np.random.default_rng([job["seed"], flight["number"]]).integers(1, SEED_APART)),
            "right": right,
        }
        for flight in job["flights"]
    ]


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row.

    The row has: name, number, world_seed, outcome (the worse of both), outcomes (left, right), why (the first event that ended the
    mission), error (exception that ended the flight), the figures of the bar (`PairTruth.report`), events (left, right).
    """
    left = with_world(config, {"seed": flight["seed"]})
    right = with_world(SitlConfig.model_validate_json(flight["right"]), {"seed": flight["seed"] + SEED_APART})
    error, result = None, TeamResult()
    report: Data = {}
    try:
        team = FastTeam(TeamConfig("", "", left, right))
        result = team.run(limit_s(left))
        assert result.truth is not None
        report = result.truth.report()
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    found = [outcome_of(member) for member in result.members]
    return {
        "row": {
            "name": flight["name"],
            "number": flight["number"],
            **laboratory_of(left),
            "outcome": max(found, key=_WORSE.index).value,
            "outcomes": [outcome.value for outcome in found],
            "why": _why(result.members),
            "error": error,
            **{
                key: report.get(key)
                for key in ("bar_p_rms_m", "bar_tilt_rms_deg", "internal_force_rms_n", "share", "let_go")
            },
            "events": [
                [event.id for outputs in member.outputs for event in outputs.events] for member in result.members
            ],
        }
    }


def outcome_of(result: FastResult) -> Outcome:
    """Return the outcome of one member's flight."""
    last = result.outputs[-1] if result.outputs else None
    return Outcome.CRASHED if result.crashed else (last and last.outcome) or Outcome.LOST


def _why(members: Sequence[FastResult]) -> str | None:
    events = [
        (event.t_s, name, event)
        for name, member in zip(("left", "right"), members, strict=True)
        for outputs in member.outputs
        for event in outputs.events
        if event.action.rank >= SafetyAction.HOLD.rank
    ]
    first = min(events, key=lambda found: found[0], default=None)
    return None if first is None else f"{first[1]}: {first[2].id}: {first[2].text}"
