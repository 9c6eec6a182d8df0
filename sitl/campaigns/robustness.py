"""Flies the flights of `companion robustness`.

A flight is {name, number, world}. If `world` is null, the world is drawn at random; `number` is the number of the draw. Payload,
throw and catch point are drawn here, because they depend on the mission; the rest is drawn as the world file specifies. The job also
has `seed` (seed of the random draws) and `fixed` (names of world keys that keep their configured values).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.analysis import metrics
from companion.analysis.log import FlightLog
from companion.campaigns.process import CampaignError
from companion.campaigns.robustness.draws import DRAWN
from companion.config.mission import Mission
from companion.config.vehicle import Vehicle
from companion.control.arm_model import manipulator_of
from companion.mission.plan import Plan
from companion.model.constants import GRAVITY_M_S2
from companion.model.types import Outcome, PhaseKind, SafetyAction
from companion.sitl_config.loader import SitlConfig
from sitl.campaigns.flights import Flown, fly_to_end, laboratory_of, mission_s, row_of, with_world
from sitl.campaigns.runner import Data
from sitl.world.throws import with_throws

PAYLOAD_KG = (0.05, 0.4)
THROW_SPEED_M_S = (0.5, 4.0)
"""Range of the payload's horizontal speed at the catch. It comes from any side; the descent is drawn separately."""
DESCENT_MAX_M_S = 2.5

ALONG_MIN_M_S = 0.08
"""Smallest speed of the vehicle in the +x direction at a catch point."""
END_MARGIN_M = 0.08
"""Smallest distance of a catch point from the ends of the line, which a vehicle displaced by wind might not reach."""
HAND_HEIGHT_M = 0.1
"""Smallest height above the floor at which the payload is released."""
FELT_S = 0.05
"""Time after the catch within which the force sensor must have sent a sample taken after the catch."""
_STEP_S = 0.01


@dataclass(frozen=True, slots=True)
class Throw:
    """A point on the flight line at which a payload can be caught."""

    at_m: tuple[float, float]
    descent_m_s: tuple[float, float]
    """Range of the descent speed: the slowest throw starts at `HAND_HEIGHT_M`; the fastest still clears the rotors."""


def throws(mission: Mission, vehicle: Vehicle, flight_s: float = 0.45) -> list[Throw]:
    """Return the catch points along the first pass in the +x direction, in flight order.

    Raises:
        CampaignError: the mission has no such pass.
    """
    plan = Plan.build(mission, vehicle)
    manipulator, rotors_m = manipulator_of(vehicle), vehicle.airframe.rotor_layout.height_m
    times = [n * _STEP_S for n in range(int(plan.duration_s / _STEP_S))]
    forwards = [t_s for t_s in times if plan.reference(t_s).velocity_world_m_s[0] > 0.0]
    begun_s = next((t_s for t_s in forwards if plan.segment(t_s).kind is PhaseKind.FLIGHT), math.inf)
    ended_s = next(
        (t_s for t_s in times if t_s > begun_s and plan.reference(t_s).velocity_world_m_s[0] <= 0.0), math.inf
    )
    line = [t_s for t_s in forwards if begun_s <= t_s < ended_s]
    found: list[Throw] = []
    for t_s in line:
        now, later = plan.reference(t_s), plan.reference(t_s + flight_s)
        # The simulated world extrapolates the vehicle from its speed at the throw.
        x_m = now.position_world_m[0] + now.velocity_world_m_s[0] * flight_s
        if x_m > plan.reference(line[-1]).position_world_m[0] - END_MARGIN_M:
            break
        slow = now.velocity_world_m_s[0] < ALONG_MIN_M_S
        if slow or x_m < plan.reference(line[0]).position_world_m[0] + END_MARGIN_M:
            continue
        net_below_m = -manipulator.net_body_m(later.arm_rad)[2]
        net_z_m = later.position_world_m[2] - net_below_m
        rise_m = 0.5 * GRAVITY_M_S2 * flight_s**2
        slowest = max(0.0, (rise_m + HAND_HEIGHT_M - net_z_m) / flight_s)
        fastest = math.sqrt(2.0 * GRAVITY_M_S2 * max(0.0, net_below_m + rotors_m))
        fastest = max(slowest, min(DESCENT_MAX_M_S, fastest))
        found.append(Throw((x_m, later.position_world_m[1]), (slowest, fastest)))
    if not found:
        raise CampaignError(
            f"mission '{mission.name}' never flies in the +x direction, so no payload can be thrown to the vehicle",
            bad_input=True,
        )
    return found


def draw(seed: int, number: int, places: list[Throw]) -> Data:
    """Draw the payload, the throw, the catch point and the seed for the rest of the world; return these keys of the world.

    Args:
        places: catch points from `throws`.
    """
    rng = np.random.default_rng([seed, number])

    def between(span: tuple[float, float], digits: int = 4) -> float:
        return round(float(rng.uniform(*span)), digits)

    payload_kg = between(PAYLOAD_KG, 3)
    speed, to_rad = between(THROW_SPEED_M_S), between((-math.pi, math.pi))
    # Uniform in position, not in time: otherwise most catches would be at the slow ends of the line.
    x_m = between((places[0].at_m[0], places[-1].at_m[0]))
    place = min(places, key=lambda one: abs(one.at_m[0] - x_m))
    descent = between(place.descent_m_s)
    return {
        "payload_kg": payload_kg,
        "throw_velocity_m_s": [round(speed * math.cos(to_rad), 3), round(speed * math.sin(to_rad), 3), -descent],
        "catch_at_m": [x_m, round(place.at_m[1], 4)],
        "seed": int(rng.integers(1, 1_000_000)),
    }


def prepare(job: Data, configs: Sequence[SitlConfig]) -> list[Data]:
    """Return the flights of the job, each with the world keys in which it differs from the configuration.

    Raises:
        CampaignError: no payload can be thrown to the vehicle in this mission.
    """
    (config,), flights = configs, job["flights"]
    draws = any(flight["world"] is None for flight in flights)
    world, fixed = with_throws(config).world, set(job["fixed"])
    hovers = world.throw_to == "hovering"
    places = [Throw(world.catch_at_m, (0.0, 0.0))] if hovers else []
    if draws and not hovers:
        places = throws(config.mission, config.vehicle, world.throw_flight_s)

    def world_of(flight: Data) -> Data:
        if flight["world"] is not None:
            found = flight["world"]
        else:
            found = draw(job["seed"], flight["number"], places)
            found |= {} if config.world.throw_to != "either" else {"throw_to": world.throw_to}
        return {key: value for key, value in found.items() if key not in fixed}

    return [{**flight, "world": world_of(flight)} for flight in flights]


def fly(config: SitlConfig, flight: Data) -> Data:
    """Fly one flight; return its row.

    The row has: name, number (of the draw), world (every key that is not at its default, and those of `DRAWN`), world_seed,
    model_error, outcome, why (event that ended the mission early), error (exception that ended the flight), thrown, caught (truly),
    felt (the force sensor still worked), caught_s (true catch, mission clock), catch_t_s (the companion's event, mission clock), e_p_m
    (RMS after the catch, or of the whole flight if nothing was caught), pre_e_p_m, e_q_deg, e_alpha_deg, peak_e_p_m, final_e_z_m,
    tilt_max_deg, slack_min_m, home_m (distance of the landing from the start), events. A value that was not measured is None.
    """
    flown = fly_to_end(with_world(config, flight["world"]))
    caught_t_s = flown.caught_t_s
    return {
        "row": {
            "name": flight["name"],
            "number": flight["number"],
            "world": _world_of(flown.config),
            **laboratory_of(flown.config),
            **_graded(flown),
            "thrown": flown.fast is not None and flown.fast.plant.scene.payload.thrown_t_s is not None,
            "felt": caught_t_s is not None and _felt(flown, caught_t_s),
            "caught_s": mission_s(flown.result, caught_t_s),
        }
    }


def _world_of(config: SitlConfig) -> Data:
    whole = config.world.model_dump(mode="json")
    return config.world.model_dump(mode="json", exclude_defaults=True) | {key: whole[key] for key in DRAWN}


def _felt(flown: Flown, caught_t_s: float) -> bool:
    """Return whether the force sensor still worked after the catch."""
    after = next((i for i in flown.result.inputs if i.t_s >= caught_t_s + FELT_S), None)
    return after is not None and after.force is not None and after.force.stamp_s > caught_t_s


def _graded(flown: Flown) -> Data:
    graded, log = row_of(flown.config.flight, flown.result, flown.caught_t_s, flown.error)
    events = [event for outputs in flown.result.outputs for event in outputs.events]
    gave_up = [event for event in events if event.action.rank >= SafetyAction.HOLD.rank]
    # The event that caused a landing is more informative than an earlier one that caused a hold.
    gave_up.sort(key=lambda event: event.action.rank < SafetyAction.LAND.rank)
    ended = gave_up[0] if gave_up and graded["outcome"] != Outcome.COMPLETED.value else None
    before, after = graded["rms"]["pre"], graded["rms"]["post"]
    whole = after if after["e_p_m"] is not None else before
    return {
        "outcome": graded["outcome"],
        "why": f"{ended.id}: {ended.text}" if ended is not None else None,
        "error": graded["error"],
        "caught": graded["caught"],
        "miss_m": flown.result.miss_m,
        "catch_t_s": graded["catch_t_s"],
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
    """Return the largest tilt, the smallest tether slack and the distance of the landing from the start; None if unknown."""
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
