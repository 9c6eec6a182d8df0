"""Random missions, checked and flown in the fast closed loop.

* A mission that was accepted never comes within `tether.margin_m` of the taut tether, nor do rotors, arm or net leave the room, by the
  world's truth, with wind up to 3 m/s and, where a catch is announced, a payload up to the announced mass.
* It ends as `completed`.
* A mission that was refused says why: every line names what, and how to change it.

Mission number N is drawn from the seed N, whatever else is flown.
"""

from __future__ import annotations

import json
import math
import random
from dataclasses import dataclass, field
from typing import Any

from companion.control.arm_model import manipulator_of
from companion.mission.check import check_mission
from companion.mission.sample_check import TRACKING_M
from companion.model.frames import quat_rotate
from companion.model.types import PhaseKind
from companion.safety.governor import BODY_TOP_M
from companion.safety.tether import slack_m
from companion.sitl_config.loader import SitlConfig, load_sitl
from sitl.fast.loop import FastFlight
from sitl.fast.result import FastResult
from tests.support import ROOT, tether_of, tool_of

FLIGHT_LIMIT_S = 120.0

Data = dict[str, Any]


@dataclass
class Row:
    """One mission."""

    number: int
    refused: list[str] = field(default_factory=list)
    outcome: str | None = None
    tether_m: float = math.inf
    """Least slack beyond `tether.margin_m`."""
    fence_m: float = math.inf
    """Least distance of rotors, arm and net from the walls and the ceiling."""
    events: list[str] = field(default_factory=list)
    constrained: int = 0
    """Ticks in which the governor changed the reference."""

    @property
    def failures(self) -> list[str]:
        """Claims that the mission violates."""
        if self.refused:
            return [f"says not how to change it: {line}" for line in self.refused if "; " not in line or "\n" in line]
        found = []
        if self.tether_m < 0.0:
            found.append(f"{-self.tether_m:.3f} m into the tether's margin")
        if self.fence_m < 0.0:
            found.append(f"{-self.fence_m:.3f} m out of the room")
        if self.outcome != "completed":
            found.append(f"ended as {self.outcome}: {', '.join(self.events)}")
        return found


def drawn(number: int, phases_max: int = 4) -> SitlConfig:
    """Return mission `number` with random vehicle, room, tether, wind and phases, some of them infeasible."""
    rng = random.Random(number)
    data: Data = json.loads(load_sitl(ROOT / "configs/missions/catch.yaml").model_dump_json())
    vehicle, mission, world = data["vehicle"], data["mission"], data["world"]
    half_x, half_y, top = rng.uniform(1.7, 2.5), rng.uniform(1.5, 2.2), rng.uniform(1.8, 2.6)
    vehicle["room"] = {"x_m": [-half_x, half_x], "y_m": [-half_y, half_y], "z_m": [0.0, top]}
    vehicle["tether"] |= {
        "anchor_world_m": [rng.uniform(-0.9, 0.9), rng.uniform(-1.3, 1.3), rng.choice([0.0, 0.0, 0.1])],
        "length_m": rng.uniform(2.3, 3.6),
        "margin_m": rng.uniform(0.15, 0.35),
        "attachment_body_m": rng.choice([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.05, 0.0, -0.08], [0.0, -0.13, -0.05]]),
    }
    acceleration = rng.uniform(0.6, 1.8)
    mission["limits"] |= {
        "speed_max_m_s": rng.uniform(0.4, 1.2),
        "acceleration_max_m_s2": acceleration,
        "jerk_max_m_s3": rng.uniform(3.0, 5.0) * acceleration,
    }
    at = [rng.uniform(-1.2, 1.2), rng.uniform(-0.9, 0.9), rng.uniform(0.7, 1.4)]
    mission["start"] |= {"position_m": at[:2], "yaw_deg": rng.choice([0.0, 0.0, rng.uniform(-90.0, 90.0)])}
    speed = mission["limits"]["speed_max_m_s"]
    takeoff_s = max(3.2, 2.3 * at[2] / speed, math.sqrt(8.5 * at[2] / acceleration))
    phases: list[Data] = [{"type": "takeoff", "height_m": at[2], "duration_s": takeoff_s}]
    lines: list[tuple[list[float], list[float]]] = []
    for _ in range(rng.randint(1, phases_max)):
        kind = rng.choice(["line", "line", "line", "path", "arm", "hold"])
        if kind == "line":
            to = _point(rng, vehicle)
            lines.append((at, to))
            phases.append({"type": "line", "to_m": to} | _arm_on_the_way(rng))
            at = to
        elif kind == "path":
            through = [_point(rng, vehicle) for _ in range(rng.randint(1, 2))]
            phases.append({"type": "path", "waypoints_m": through})
            at = through[-1]
        elif kind == "arm":
            phases.append({"type": "arm", "arm_deg": rng.choice([[100.0, 60.0], [120.0, 90.0], [165.0, 140.0]])})
        else:
            phases.append({"type": "hold", "duration_s": rng.uniform(0.5, 1.5)})
    phases += [
        {"type": "arm", "arm_deg": [165.0, 140.0]},
        {"type": "hold", "duration_s": 0.5},
        {"type": "land", "speed_m_s": rng.uniform(0.2, 0.45)},
    ]
    mission |= {"phases": phases, "catch": None, "name": f"random {number}"}
    world |= {"seed": number, "payload_kg": 0.0, "wind_m_s": _wind(rng)}
    flown_to_the_right = [line for line in lines if line[1][0] - line[0][0] > 0.6]
    if flown_to_the_right and rng.random() < 0.5:
        begin, end = flown_to_the_right[0]
        middle = [(a + b) / 2 for a, b in zip(begin, end, strict=True)]
        payload_kg = rng.uniform(0.1, 0.4)
        mission["catch"] = {"expected_at_m": middle[:2], "payload_max_kg": payload_kg}
        world |= {"payload_kg": payload_kg, "catch_at_m": middle[:2]}
    return SitlConfig.model_validate_json(json.dumps(data))


def _point(rng: random.Random, vehicle: Data) -> list[float]:
    """Return a point in the middle of the room, or close to the limit of the tether or of a wall, on either side of it."""
    (half_x, half_y, top), tether = (vehicle["room"][key][1] for key in ("x_m", "y_m", "z_m")), vehicle["tether"]
    point = [rng.uniform(-0.6, 0.6) * half_x, rng.uniform(-0.6, 0.6) * half_y, rng.uniform(0.75, 0.55 + 0.4 * top)]
    kind = rng.choice(["middle", "tether", "wall", "wall"])
    if kind == "tether":
        anchor, lever_m = tether["anchor_world_m"], math.hypot(*tether["attachment_body_m"])
        range_m = tether["length_m"] - tether["margin_m"] - lever_m - TRACKING_M - rng.uniform(-0.01, 0.06)
        share = range_m / math.dist(point, anchor)
        point = [a + share * (p - a) for p, a in zip(point, anchor, strict=True)]
    elif kind == "wall":
        axis = rng.randrange(3)
        free_m = TRACKING_M + rng.uniform(-0.01, 0.06)
        if axis == 2:
            point[2] = top - BODY_TOP_M - free_m
        else:
            edge_m = (half_x, half_y)[axis] - vehicle["airframe"]["radius_m"] - free_m
            point[axis] = rng.choice([-edge_m, edge_m])
    return point


def _arm_on_the_way(rng: random.Random) -> Data:
    return rng.choice([{}, {"arm_deg": [100.0, 60.0]}, {"arm_deg": [140.0, 110.0]}])


def _wind(rng: random.Random) -> list[float]:
    speed, towards = rng.uniform(0.0, 3.0), rng.uniform(-math.pi, math.pi)
    return [speed * math.cos(towards), speed * math.sin(towards), 0.0]


def fly(number: int, phases_max: int = 4) -> Row:
    """Check mission `number` and fly it if it is accepted."""
    config = drawn(number, phases_max)
    row = Row(number=number, refused=check_mission(config.mission, config.vehicle))
    if row.refused:
        return row
    flight = FastFlight(config)
    result = flight.run(FLIGHT_LIMIT_S)
    ended = result.outputs[-1]
    row.outcome = "crashed" if result.crashed else ended.outcome.value if ended.outcome else "lost"
    row.events = [event.id for outputs in result.outputs for event in outputs.events]
    row.constrained = sum(bool(outputs.limited_by) for outputs in result.outputs)
    row.tether_m, row.fence_m = margins_m(config, result)
    return row


def margins_m(config: SitlConfig, result: FastResult) -> tuple[float, float]:
    """Return the true minimum in flight of the slack beyond the margin, and of the distance to walls and ceiling."""
    vehicle, room = config.vehicle, config.vehicle.room
    manipulator = manipulator_of(vehicle)
    reach_m, net_reach_m = vehicle.airframe.radius_m, tool_of(vehicle).radius_m
    tether_m = fence_m = math.inf
    for outputs, truth in zip(result.outputs, result.truth, strict=True):
        if outputs.phase_kind in (PhaseKind.GROUND, PhaseKind.DONE):
            continue
        p, q = truth.position_world_m, truth.attitude_wxyz
        tether_m = min(tether_m, slack_m(tether_of(vehicle), p, q) - tether_of(vehicle).margin_m)
        dx, dy, dz = quat_rotate(q, manipulator.net_body_m(truth.joint_angle_rad))
        for at, to, span in ((p[0], p[0] + dx, room.x_m), (p[1], p[1] + dy, room.y_m)):
            low, high = min(at - reach_m, to - net_reach_m), max(at + reach_m, to + net_reach_m)
            fence_m = min(fence_m, low - span[0], span[1] - high)
        fence_m = min(fence_m, room.z_m[1] - max(p[2] + BODY_TOP_M, p[2] + dz + net_reach_m))
    return tether_m, fence_m
