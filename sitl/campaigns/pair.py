"""Flies the flights of `companion robustness` of a team file.

A flight is {name, number}; its laboratory is drawn from the job's seed and the number. The configurations of the job are those of the
left and of the right member.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.mission.phase import phases_of
from companion.model.types import Outcome, SafetyAction
from companion.phases.carry.grip import GripHandle
from companion.sitl_config.bar import Bar
from companion.sitl_config.loader import SitlConfig
from companion.sitl_config.team import SEED_APART, TeamConfig
from sitl.campaigns.flights import laboratory_of, limit_s, outcome_of, with_world
from sitl.campaigns.runner import Data
from sitl.fast.result import FastResult
from sitl.fast.team import FastTeam, TeamResult

DOWN_M = 0.03
"""Height of a vehicle above its place on the floor below which it is down."""
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
    mission), error (exception that ended the flight), the figures of the bar (`PairTruth.report`), share_wanted (of the left vehicle:
    that of a level bar at rest), dropped (whether the bar fell to the floor), rotors_touched (by the bar or by each other), down_s
    (time from the beginning of the first fault until both stand on the floor; None without a fault, or if their rotors still turn at
    the end), events (left, right).
    """
    left = with_world(config, {"seed": flight["seed"]})
    right = with_world(SitlConfig.model_validate_json(flight["right"]), {"seed": flight["seed"] + SEED_APART})
    error, result, team = None, TeamResult(), None
    report: Data = {}
    try:
        team = FastTeam(TeamConfig("", "", left, right))
        result = team.run(limit_s(left))
        assert result.truth is not None
        report = result.truth.report()
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    happened = set() if team is None else {event.kind for event in team.scene.take_events()}
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
            "share_wanted": _share_wanted(left),
            "dropped": "bar_dropped" in happened,
            "rotors_touched": bool(happened & {"rotor_hit", "rotors_touched"}),
            "down_s": None if team is None else down_s(team, result),
            "events": [
                [event.id for event in (*(e for o in member.outputs for e in o.events), *member.guardian_events)]
                for member in result.members
            ],
        }
    }


def _share_wanted(left: SitlConfig) -> float:
    """Return the left vehicle's share of the weight of a level bar at rest, which its centre of mass determines."""
    true = left.world.bar or Bar()
    grip = next(phase for phase in phases_of(left.mission) if isinstance(phase, GripHandle))
    return 0.5 + true.centre_offset_m / (grip.bar.length_m + true.length_error_m)


def down_s(team: FastTeam, result: TeamResult) -> float | None:
    """Return the time from the beginning of the first fault until both stand on the floor; None as in a row."""
    begun_s = min((flight.faults.begun_s for flight in team.flights if flight.faults.begun_s is not None), default=None)
    if begun_s is None or any(flight.px4.armed or flight.plant.machine.crashed for flight in team.flights):
        return None
    latest_s = begun_s
    for flight, member in zip(team.flights, result.members, strict=True):
        low_m = flight.config.vehicle.airframe.ground_clearance_m + DOWN_M
        above_s = (state.t_s for state in (*member.snapshots, *member.after) if state.q[2] > low_m)
        latest_s = max(latest_s, *above_s)
    return round(latest_s - begun_s, 3)


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
