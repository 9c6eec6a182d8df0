"""Checks whether two vehicles can carry their bar together as planned."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from companion import __version__
from companion.config.loader import FlightConfig
from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.model.algebra import dot, minus, plus, scaled
from companion.model.types import Vec3
from companion.phases.carry.bar import End
from companion.phases.carry.carry import Carry
from companion.phases.carry.grip import APART_M, GripHandle

STEP_S: Final = 0.05
PLACES_M: Final = 0.05
"""Distance of the places of a way that are compared with those of the other vehicle's."""
ROUNDING_M: Final = 1e-6
"""Difference of two computed distances that are equal."""
TETHERS_APART_M: Final = 0.3
"""Least distance of the straight line of a tether from that of the other vehicle, and from its rotors."""


def pair_problems(left: FlightConfig, right: FlightConfig) -> Iterator[str]:
    """Yield each reason not to let these two members fly together; one line each."""
    for what, one, other, advice in (
        ("devices.mocap.rigid_body_id", _body(left), _body(right), "give each vehicle a rigid body of its own"),
        (
            "ground.topic",
            left.vehicle.ground.topic,
            right.vehicle.ground.topic,
            "give each vehicle a name of its own on the broker",
        ),
        (
            "devices.team.port",
            _port(left),
            _port(right),
            "both are on one computer in simulation: give each a port of its own",
        ),
    ):
        if one == other:
            yield f"both members have {what} {one}; {advice}"
    if _shared(left) != _shared(right):
        yield "both members must fly the same phases from grip on, as often, and with the same limits: they move one bar"
        return
    if left.vehicle.safety.land_speed_m_s != right.vehicle.safety.land_speed_m_s:
        yield "safety.land_speed_m_s differs between the members; an event lands both with the bar, whose ends must descend alike"
    if left.vehicle.devices.mocap.bar_id != right.vehicle.devices.mocap.bar_id:
        yield "devices.mocap.bar_id differs between the members; both carry one bar"
    for key in ("type", "server", "command_port"):
        if getattr(left.vehicle.devices.mocap, key) != getattr(right.vehicle.devices.mocap, key):
            yield f"devices.mocap.{key} differs between the members; both must receive the frames of one server, whose clock they share"
    if left.vehicle.devices.mocap.external:
        yield "devices.mocap.type is external, but the members share the clock of the frames: let both receive them (natnet)"
    if _port(left) != _port(right):
        yield from _unheard("left", left, "right", right)
        yield from _unheard("right", right, "left", left)
    yield from _near(left, right)


def agreement(left: FlightConfig, right: FlightConfig) -> str:
    """Return a digest of all that these checks have read, and of the version that plans: both computers must have it alike."""
    read = [
        {
            "mission": config.mission.model_dump(
                mode="json", include={"limits": True, "phases": True, "repeat": True, "start": _START}
            ),
            "safety": config.vehicle.safety.land_speed_m_s,
            "radius": config.vehicle.airframe.radius_m,
            "tether": None if config.vehicle.tether is None else config.vehicle.tether.anchor_world_m,
            "mocap": config.vehicle.devices.mocap.model_dump(mode="json", include=_MOCAP),
        }
        for config in (left, right)
    ]
    return hashlib.sha256(json.dumps([__version__, read], sort_keys=True).encode()).hexdigest()[:16]


_START: Final = {"position_m", "yaw_deg", "arm_deg"}
_MOCAP: Final = {"type", "server", "command_port", "rigid_body_id", "bar_id"}


def _shared(config: FlightConfig) -> list[Any]:
    """Return limits, repetitions and the settings of the phases from the first `grip` on, without what each member has of its own."""
    phases = phases_of(config.mission)
    first = next(number for number, phase in enumerate(phases) if isinstance(phase, GripHandle))
    own = {"end", "arm_deg", "compliance"}
    return [config.mission.limits, config.mission.repeat, *(phase.model_dump(exclude=own) for phase in phases[first:])]


def _body(config: FlightConfig) -> int:
    return config.vehicle.devices.mocap.rigid_body_id


def _port(config: FlightConfig) -> int | None:
    team = config.vehicle.devices.team
    return None if team is None else team.port


def _unheard(end: End, config: FlightConfig, other: End, partner: FlightConfig) -> Iterator[str]:
    """Yield why what this member sends does not reach the other."""
    link, port = config.vehicle.devices.team, _port(partner)
    if link is not None and link.partner_port != port:
        yield (
            f"{end} sends to port {link.partner_port} (devices.team.partner_port), but {other} receives at {port} (devices.team.port); "
            "make them equal"
        )


def _near(left: FlightConfig, right: FlightConfig) -> Iterator[str]:
    """Yield where the vehicles or their tethers come too near to each other, one line for each of the two."""
    plans = [Plan.build(config.mission, config.vehicle) for config in (left, right)]
    radii_m = [config.vehicle.airframe.radius_m for config in (left, right)]
    least_m = sum(radii_m) + APART_M
    anchors = [
        None if config.vehicle.tether is None else config.vehicle.tether.anchor_world_m for config in (left, right)
    ]
    stretches = [_stretches(config, plan) for config, plan in zip((left, right), plans, strict=True)]
    held_m = math.dist(*(each[1].places[0][:2] for each in stretches))
    vehicles, tethers, rotors = _Nearest(), _Nearest(), _Nearest()
    for one, other in zip(*stretches, strict=True):
        # With the bar both move at once. On the way to it and from it each moves at a time of its own, so that no place of one may be
        # near any of the other.
        pairs = (
            zip(one.places, other.places, strict=False) if one.together else itertools.product(one.places, other.places)
        )
        for n, at in enumerate(pairs):
            where = f"{n * STEP_S:.1f} s after the lift" if one.together else one.where
            apart_m = math.dist(at[0][:2], at[1][:2])
            # The bar keeps them apart by one distance: if that is too short, it is not the ways that are wrong.
            if one.together or apart_m < held_m - ROUNDING_M:
                vehicles.take(apart_m, where, one.together)
            lines = [None if anchor is None else (anchor, place) for anchor, place in zip(anchors, at, strict=True)]
            if lines[0] is not None and lines[1] is not None:
                tethers.take(segments_apart_m(lines[0], lines[1]), where, one.together)
            for line, centre, radius_m in zip(lines, at[::-1], radii_m[::-1], strict=True):
                if line is not None:
                    rotors.take(max(0.0, segments_apart_m(line, (centre, centre)) - radius_m), where, one.together)
    if vehicles.distance_m < least_m:
        yield (
            f"the vehicles come as near as {vehicles.distance_m:.2f} m {vehicles.where} (minimum {least_m:.2f} m: two rotor circles "
            f"and {APART_M:g} m); {'use a longer bar, or change the waypoints' if vehicles.together else _PART}"
        )
    near = tethers if tethers.distance_m < TETHERS_APART_M else rotors
    if near.distance_m < TETHERS_APART_M:
        what = "the tethers come" if near is tethers else "one's tether and the other's rotors come"
        yield (
            f"{what} as near as {near.distance_m:.2f} m {near.where} (minimum {TETHERS_APART_M:g} m): they may cross; move the anchors "
            f"apart, or {'change the waypoints' if near.together else _PART}"
        )


_PART: Final = "let each start and end at its own end of the bar (mission.start.position_m)"


@dataclass
class _Nearest:
    """The nearest of many approaches."""

    distance_m: float = math.inf
    where: str = ""
    together: bool = False

    def take(self, distance_m: float, where: str, together: bool) -> None:
        """Keep an approach if it is the nearest so far."""
        if distance_m < self.distance_m:
            self.distance_m, self.where, self.together = distance_m, where, together


@dataclass(frozen=True)
class _Stretch:
    """Part of a member's mission: with the bar, or the way to it or from it."""

    together: bool
    where: str
    places: list[Vec3]
    """Positions of the body: with the bar one every `STEP_S`, else one every `PLACES_M`, and the last."""


def _stretches(config: FlightConfig, plan: Plan) -> list[_Stretch]:
    """Return the way to the bar, the stretch with it, and the way from it; and so on if the mission carries it several times."""
    phases, found = phases_of(config.mission), list[_Stretch]()
    for together, segments in itertools.groupby(
        plan.segments, key=lambda segment: isinstance(phases[segment.index], Carry)
    ):
        places: list[Vec3] = []
        for segment in segments:
            count = math.ceil((segment.end_s - segment.start_s) / STEP_S)
            for t_s in (*(segment.start_s + n * STEP_S for n in range(count)), segment.end_s):
                place = plan.reference(t_s).position_world_m
                if together or not places or t_s == segment.end_s or math.dist(place, places[-1]) >= PLACES_M:
                    places.append(place)
        where = "with the bar" if together else "on the ways from the bar" if found else "on the ways to the bar"
        found.append(_Stretch(together, where, places))
    return found


def segments_apart_m(one: tuple[Vec3, Vec3], other: tuple[Vec3, Vec3]) -> float:
    """Return the distance between two line segments, each given by its ends, which may be equal."""
    (a, b), (c, d) = one, other
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, uv, vv, uw, vw = dot(u, u), dot(u, v), dot(v, v), dot(u, w), dot(v, w)
    divisor = uu * vv - uv * uv
    if divisor > 0.0:
        s, t = (uv * vw - vv * uw) / divisor, (uu * vw - uv * uw) / divisor
        if 0.0 < s < 1.0 and 0.0 < t < 1.0:  # nearest between the ends of both; otherwise an end of one is nearest
            return math.dist(plus(a, scaled(u, s)), plus(c, scaled(v, t)))
    return min(_to_segment_m(a, other), _to_segment_m(b, other), _to_segment_m(c, one), _to_segment_m(d, one))


def _to_segment_m(point: Vec3, line: tuple[Vec3, Vec3]) -> float:
    along, length2 = minus(line[1], line[0]), math.dist(*line) ** 2
    share = 0.0 if length2 == 0.0 else dot(minus(point, line[0]), along) / length2
    return math.dist(point, plus(line[0], scaled(along, min(1.0, max(0.0, share)))))
