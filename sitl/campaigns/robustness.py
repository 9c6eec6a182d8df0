"""`python -m sitl.campaigns.robustness`: one mission flown in many worlds, each drawn at random. Started by `companion robustness`.

Standard input: one line of JSON, then nothing; when it ends, so does the campaign.
    config        effective configuration (`SitlConfig`)
    seed          of the draws
    first, count  numbers of the draws: a draw depends on the seed and its own number, not on how many are flown
    fixed         keys of the world that are not drawn, nor a case's: as the configuration has them
    cases         null, or {name, world} to be flown instead of draws
    jobs          processes; null: one per core
    scheduler     address of a Dask scheduler instead; null: this machine
Standard output: JSON lines as from `sitl.campaigns.flights`; a row is described at `fly`.
"""

from __future__ import annotations

import json
import math
import sys
import time
from dataclasses import dataclass

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import FlightLog
from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.control.manipulator import GRAVITY_M_S2, Manipulator
from companion.mission.plan import Plan
from companion.model.types import Outcome, PhaseKind, SafetyAction
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns import flights as campaign
from sitl.campaigns.flights import CampaignError, Data
from sitl.fast.loop import FastFlight, FastResult
from sitl.world.world import _THROW_LEAD_S

PAYLOAD_KG = (0.05, 0.4)
THROW_SPEED_M_S = (0.5, 4.0)
"""Horizontal part on arrival, from any side; downwards comes on top of it."""
DESCENT_MAX_M_S = 2.5
HOVER_THRUST_ERROR = 0.10
LINK_MASS_ERROR = 0.20
SETPOINT_DELAY_S = (0.005, 0.060)
ARM_DELAY_S = (0.002, 0.010)
ROTOR_LAG_S = (0.020, 0.060)
WIND_MAX_M_S = 3.0
FORCE_BIAS_N = (3.0, 12.0)
"""Larger than the default knob's."""
FORCE_BIASED, FORCE_MISSING = 0.5, 0.75
"""Up to the first share of draws the force sensor is biased, up to the second it is silent from arming on, else from some time on."""

ALONG_MIN_M_S = 0.08
"""The payload is thrown at a vehicle that flies in the direction of +x; slower than this counts as standing."""
END_MARGIN_M = 0.08
"""Nearer to the ends of the line, a vehicle that the wind has pushed aside may never be seen to come past the catch point."""
HAND_HEIGHT_M = 0.1
"""The payload leaves a hand above the floor."""
ROTORS_ABOVE_BODY_M = 0.03
FELT_S = 0.05
"""So long after the catch there must be a sample from after it."""
_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Throw:
    """A place on the flight line where a payload can arrive."""

    at_m: tuple[float, float]
    descent_m_s: tuple[float, float]
    """Slowest: thrown from a hand above the floor. Fastest: the payload comes over the net without passing through the rotors."""


def throws(mission: Mission, vehicle: Vehicle) -> list[Throw]:
    """Catch points along the first pass in the direction of +x, in the order of the flight.

    Raises:
        CampaignError: there is no such pass.
    """
    plan = Plan.build(mission, vehicle)
    manipulator = Manipulator(vehicle.arm, vehicle.tool)
    times = [n * _STEP_S for n in range(int(plan.duration_s / _STEP_S))]
    forwards = [t_s for t_s in times if plan.reference(t_s).velocity_world_m_s[0] > 0.0]
    begun_s = next((t_s for t_s in forwards if plan.segment(t_s).kind is PhaseKind.FLIGHT), math.inf)
    ended_s = next(
        (t_s for t_s in times if t_s > begun_s and plan.reference(t_s).velocity_world_m_s[0] <= 0.0), math.inf
    )
    line = [t_s for t_s in forwards if begun_s <= t_s < ended_s]
    found: list[Throw] = []
    for t_s in line:
        now, later = plan.reference(t_s), plan.reference(t_s + _THROW_LEAD_S)
        # Where the world expects it, by its speed when the payload is thrown.
        x_m = now.position_world_m[0] + now.velocity_world_m_s[0] * _THROW_LEAD_S
        if x_m > plan.reference(line[-1]).position_world_m[0] - END_MARGIN_M:
            break
        slow = now.velocity_world_m_s[0] < ALONG_MIN_M_S
        if slow or x_m < plan.reference(line[0]).position_world_m[0] + END_MARGIN_M:
            continue
        net_below_m = -manipulator.net_body_m(later.arm_rad)[2]
        net_z_m = later.position_world_m[2] - net_below_m
        rise_m = 0.5 * GRAVITY_M_S2 * _THROW_LEAD_S**2
        slowest = max(0.0, (rise_m + HAND_HEIGHT_M - net_z_m) / _THROW_LEAD_S)
        fastest = math.sqrt(2.0 * GRAVITY_M_S2 * max(0.0, net_below_m + ROTORS_ABOVE_BODY_M))
        fastest = max(slowest, min(DESCENT_MAX_M_S, fastest))
        found.append(Throw((x_m, later.position_world_m[1]), (slowest, fastest)))
    if not found:
        raise CampaignError(
            f"mission '{mission.name}' never flies in the direction of +x, so that nothing can be thrown at it",
            bad_input=True,
        )
    return found


def draw(seed: int, number: int, places: list[Throw]) -> Data:
    """Knobs of the world of one draw, rounded so that a command line can repeat them to the bit.

    Args:
        seed: of the whole campaign.
        number: of the draw.
        places: as from `throws`.
    """
    rng = np.random.default_rng([seed, number])

    def between(span: tuple[float, float], digits: int = 4) -> float:
        return round(float(rng.uniform(*span)), digits)

    # Everything is drawn every time, in this order: what one draw does not use shifts nothing in it.
    payload_kg = between(PAYLOAD_KG, 3)
    speed, to_rad = between(THROW_SPEED_M_S), between((-math.pi, math.pi))
    # By place, not by time, or the slow ends of the line would have most of the catches.
    x_m = between((places[0].at_m[0], places[-1].at_m[0]))
    place = min(places, key=lambda one: abs(one.at_m[0] - x_m))
    descent = between(place.descent_m_s)
    wind, wind_to_rad = between((0.0, WIND_MAX_M_S)), between((-math.pi, math.pi))
    bias = rng.standard_normal(3)
    bias *= between(FORCE_BIAS_N) / float(np.linalg.norm(bias))
    sensor, lost_s = float(rng.uniform()), between((0.0, 20.0), 2)
    knobs: Data = {
        "payload_kg": payload_kg,
        "throw_velocity_m_s": [round(speed * math.cos(to_rad), 3), round(speed * math.sin(to_rad), 3), -descent],
        "catch_at_m": [x_m, round(place.at_m[1], 4)],
        "hover_thrust_error": between((-HOVER_THRUST_ERROR, HOVER_THRUST_ERROR)),
        "link_mass_error": [between((-LINK_MASS_ERROR, LINK_MASS_ERROR)) for _ in range(2)],
        "setpoint_delay_s": between(SETPOINT_DELAY_S),
        "arm_delay_s": between(ARM_DELAY_S),
        "rotor_lag_s": between(ROTOR_LAG_S),
        "wind_m_s": [round(wind * math.cos(wind_to_rad), 3), round(wind * math.sin(wind_to_rad), 3), 0.0],
        "seed": int(rng.integers(1, 1_000_000)),
    }
    if sensor < FORCE_BIASED:
        knobs["force_bias_n"] = [round(float(value), 2) for value in bias]
    else:
        knobs["faults"] = [{"kind": "force_loss", "t_s": 0.0 if sensor < FORCE_MISSING else lost_s}]
    return knobs


def fly(config_json: str, flight: Data) -> Data:
    """One flight: {row, wall_s}.

    The row has: name, number (of the draw), world (the knobs drawn), outcome, why (what ended the mission early), error (what ended
    the flight from within), thrown, caught (truly), felt (the force sensor lived to tell), caught_s and noticed_s (mission clock),
    e_p_m (RMS after the catch; of the whole flight if nothing was caught), pre_e_p_m, e_q_deg, e_alpha_deg, peak_e_p_m, final_e_z_m,
    tilt_max_deg, slack_min_m, home_m (from the start, at the end), events. Where nothing was measured a value is None.

    Args:
        config_json: effective configuration.
        flight: {name, number, world}.
    """
    begun_s = time.perf_counter()
    data = json.loads(config_json)
    data["world"].update(flight["world"])
    config = SitlConfig.model_validate_json(json.dumps(data))
    result, error = FastResult(), None
    thrown = felt = False
    caught_t_s: float | None = None
    try:
        fast = FastFlight(config)
        result = fast.run()
        config = fast.config
        thrown, caught_t_s = fast.plant.world.thrown_t_s is not None, fast.plant.world.caught_t_s
        felt = caught_t_s is not None and _felt(result, caught_t_s)
    # A law that cannot go on ends its flight process: that flight is lost, and the others are flown all the same.
    except Exception as failure:
        error = f"{type(failure).__name__}: {failure}"
    graded, log = campaign.row_of(config.flight, result, caught_t_s, error)
    row = {
        **{key: flight[key] for key in ("name", "number", "world")},
        **_row(graded, log, result),
        "thrown": thrown,
        "caught": caught_t_s is not None,
        "felt": felt,
        "caught_s": _mission_s(result, caught_t_s),
    }
    return {"row": row, "wall_s": time.perf_counter() - begun_s}


def _felt(result: FastResult, caught_t_s: float) -> bool:
    """Whether the force sensor lived to tell of the catch."""
    after = next((i for i in result.inputs if i.t_s >= caught_t_s + FELT_S), None)
    return after is not None and after.force is not None and after.force.stamp_s > caught_t_s


def _row(graded: Data, log: FlightLog, result: FastResult) -> Data:
    events = [event for outputs in result.outputs for event in outputs.events]
    gave_up = [event for event in events if event.action.rank >= SafetyAction.HOLD.rank]
    # What made it land tells more than what made it stop and wait before.
    gave_up.sort(key=lambda event: event.action.rank < SafetyAction.LAND.rank)
    ended = gave_up[0] if gave_up and graded["outcome"] != Outcome.COMPLETED.value else None
    noticed = next((event.t_s for event in events if event.id == "catch"), None)
    before, after = graded["rms"]["pre"], graded["rms"]["post"]
    whole = after if after["e_p_m"] is not None else before
    return {
        "outcome": graded["outcome"],
        "why": f"{ended.id}: {ended.text}" if ended is not None else None,
        "error": graded["error"],
        "noticed_s": _mission_s(result, noticed),
        "e_p_m": whole["e_p_m"],
        "pre_e_p_m": before["e_p_m"],
        "e_q_deg": whole["e_q_deg"],
        "e_alpha_deg": whole["e_alpha_deg"],
        "peak_e_p_m": graded["peak_e_p_m"],
        "final_e_z_m": graded["final_e_z_m"],
        **_extremes(log),
        "events": [event.id for event in events],
    }


def _extremes(log: FlightLog) -> Data:
    """What shows how near to the edge a flight was."""
    nothing = {"tilt_max_deg": None, "slack_min_m": None, "home_m": None}
    if not log.inputs:
        return nothing
    position, attitude = log.columns.mocap_position_world_m, log.columns.mocap_attitude_rad
    known = np.isfinite(position).all(axis=1)
    if not known.any():
        return nothing
    tilt = np.arccos(np.clip(np.cos(attitude[known, 0]) * np.cos(attitude[known, 1]), -1.0, 1.0))
    first, last = position[known][0], position[known][-1]
    return {
        "tilt_max_deg": math.degrees(float(tilt.max())),
        "slack_min_m": metrics.min_slack_m(log),
        "home_m": math.dist(first[:2], last[:2]),
    }


def _mission_s(result: FastResult, t_s: float | None) -> float | None:
    """A time of the flight on the mission clock."""
    begun = next((o.t_s - o.mission_t_s for o in result.outputs if o.mission_t_s > 0), None)
    return None if t_s is None or begun is None else t_s - begun


def grid(job: Data) -> tuple[list[str], list[Data]]:
    """Configurations and flights of a job.

    Raises:
        CampaignError: nothing can be thrown at the mission.
    """
    config = SitlConfig.model_validate_json(json.dumps(job["config"]))
    if job["cases"] is not None:
        flights = [{"name": case["name"], "number": None, "world": case["world"]} for case in job["cases"]]
    else:
        places = throws(config.mission, config.vehicle)
        numbers = range(job["first"], job["first"] + job["count"])
        flights = [{"name": f"draw {n}", "number": n, "world": draw(job["seed"], n, places)} for n in numbers]
    fixed = {key: job["config"]["world"][key] for key in job["fixed"]}
    for flight in flights:
        flight["world"] |= fixed
        flight["variant"] = 0
    return [config.model_dump_json()], flights


def main() -> int:
    """Fly what standard input asks for."""
    return campaign.serve(grid, fly)


if __name__ == "__main__":
    # Workers find the functions by the module's name, which is not __main__ for them.
    from sitl.campaigns import robustness

    sys.exit(robustness.main())
