"""Checks whether two vehicles can carry their bar together as planned."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from typing import Any, Final

from companion import __version__
from companion.config.loader import FlightConfig
from companion.config.vehicle import Vehicle
from companion.mission.phase import phases_of
from companion.mission.plan import Plan
from companion.model.types import Reference, Vec3
from companion.phases.carry.bar import End
from companion.phases.carry.carry import Carry
from companion.phases.carry.grip import APART_M, GripHandle

STEP_S: Final = 0.05
ROUNDING_M: Final = 1e-6
"""Difference of two computed distances that are equal."""
TETHERS_APART_M: Final = 0.3
"""Least distance between the straight lines of the two tethers."""


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
    if left.mission.limits != right.mission.limits or _shared(left) != _shared(right):
        yield "both members must fly the same phases from grip on, and with the same limits: they move one bar"
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


def _shared(config: FlightConfig) -> list[dict[str, Any]]:
    """Return the settings of the phases from the first `grip` on, without what each member has of its own."""
    phases = phases_of(config.mission)
    first = next(number for number, phase in enumerate(phases) if isinstance(phase, GripHandle))
    return [phase.model_dump(exclude={"end", "arm_deg", "compliance"}) for phase in phases[first:]]


def _carry_begins_s(config: FlightConfig, plan: Plan) -> float:
    index = next(number for number, phase in enumerate(phases_of(config.mission)) if isinstance(phase, Carry))
    return next(segment.start_s for segment in plan.segments if segment.index == index)


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
    """Yield where the vehicles or their tethers come too near to each other."""
    plans = [Plan.build(config.mission, config.vehicle) for config in (left, right)]
    least_m = left.vehicle.airframe.radius_m + right.vehicle.airframe.radius_m + APART_M
    near: tuple[float, float] | None = None
    crossed: tuple[float, float] | None = None
    begun = [_carry_begins_s(config, plan) for config, plan in zip((left, right), plans, strict=True)]
    end_s = max(plan.duration_s - start_s for plan, start_s in zip(plans, begun, strict=True))
    # Before the bar is lifted each moves at a time of its own, so that no place of one way may be near any of the other.
    ways = [_way(plan, start_s) for plan, start_s in zip(plans, begun, strict=True)]
    ways_m = min(math.dist(one, other) for one in ways[0] for other in ways[1])
    if ways_m < min(least_m, math.dist(ways[0][-1], ways[1][-1]) - ROUNDING_M):
        yield (
            f"the ways of the vehicles to the bar come as near as {ways_m:.2f} m (minimum {least_m:.2f} m: two rotor circles and "
            f"{APART_M:g} m); start each at its own end of the bar (mission.start.position_m)"
        )
    # Then both move at once.
    for n in range(int(end_s / STEP_S)):
        at = [plan.reference(start_s + n * STEP_S) for plan, start_s in zip(plans, begun, strict=True)]
        apart_m = math.dist(at[0].position_world_m[:2], at[1].position_world_m[:2])
        if apart_m < least_m and (near is None or apart_m < near[1]):
            near = (n * STEP_S, apart_m)
        lines_m = _tethers_apart_m(left.vehicle, at[0], right.vehicle, at[1])
        if lines_m < TETHERS_APART_M and (crossed is None or lines_m < crossed[1]):
            crossed = (n * STEP_S, lines_m)
    if near is not None:
        yield (
            f"the vehicles come as near as {near[1]:.2f} m, {near[0]:.1f} s after the lift (minimum {least_m:.2f} m: two rotor circles "
            f"and {APART_M:g} m); use a longer bar, or change the waypoints"
        )
    if crossed is not None:
        yield (
            f"the tethers come as near as {crossed[1]:.2f} m, {crossed[0]:.1f} s after the lift (minimum {TETHERS_APART_M:g} m): they "
            "may cross; move the anchors apart, or change the waypoints"
        )


def _way(plan: Plan, end_s: float) -> list[tuple[float, float]]:
    """Return the horizontal places of the vehicle until a time of its plan."""
    times_s = [*(n * STEP_S for n in range(math.ceil(end_s / STEP_S))), end_s]
    return [plan.reference(t_s).position_world_m[:2] for t_s in times_s]


def _tethers_apart_m(left: Vehicle, at_left: Reference, right: Vehicle, at_right: Reference) -> float:
    """Return the distance between the straight lines from anchor to vehicle; infinite without one of the tethers."""
    if left.tether is None or right.tether is None:
        return math.inf
    return _segments_apart_m(
        (left.tether.anchor_world_m, at_left.position_world_m), (right.tether.anchor_world_m, at_right.position_world_m)
    )


def _segments_apart_m(one: tuple[Vec3, Vec3], other: tuple[Vec3, Vec3]) -> float:
    """Return the distance between two line segments, sampled at a twentieth of their length."""
    return min(math.dist(_along(one, i / 20), _along(other, j / 20)) for i in range(21) for j in range(21))


def _along(line: tuple[Vec3, Vec3], share: float) -> Vec3:
    (ax, ay, az), (bx, by, bz) = line
    return (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az))
