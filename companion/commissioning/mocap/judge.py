"""What a watched stream of motion capture says: rates, jitter, latency, which body it is, and what to change. Pure.

The rows of the preflight are used as they are (`companion.preflight.mocap`); what is beside them is for a set-up that is new.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.io.mocap.natnet import RigidBody, ServerInfo, z_up_from_y_up
from companion.model.observations import MocapStream, Observations
from companion.model.rows import Row
from companion.model.types import MocapPose
from companion.preflight import mocap as preflight
from companion.preflight.checks import Check
from companion.px4.wanted import WANTED

SERVER = Check(
    "mocap.server", "mocap server", "answers at `devices.mocap.server`", "nothing is streamed to the vehicle"
)
OWN = Check(
    "mocap.own",
    "rigid body of the vehicle",
    "`devices.mocap.rigid_body_id` is streamed, and moves when the vehicle does",
    "another body's pose would be flown",
)
STEADY = Check(
    "mocap.steady",
    "mocap jitter",
    "99 % of the frames within half a period of even",
    "EKF2 subtracts one fixed delay from all of them",
    warns=True,
)
DELAY = Check(
    "mocap.delay",
    "mocap latency against EKF2_EV_DELAY",
    "exposure to transmission within 3 ms of what the project's parameter file says",
    "PX4 fuses each pose in the wrong place: the estimate swings with the machine",
)
NETWORK = Check("mocap.network", "way to the server", "a cable", "Wi-Fi holds frames back in bursts", warns=True)
CHECKS = (SERVER, OWN, STEADY, DELAY, NETWORK)

MOVED_MIN_M: Final = 0.05
STILL_MAX_M: Final = 0.02
RATE_TOLERANCE: Final = 0.05
DELAY_TOLERANCE_S: Final = 0.003
EV_DELAY_MS: Final = next(float(one.value or 0.0) for one in WANTED if one.name == "EKF2_EV_DELAY")
"""What the project's parameter file says."""
_BINS: Final = 9
_BAR: Final = 40


@dataclass(frozen=True, slots=True)
class FrameSeen:
    """One frame of data with all of its rigid bodies, in the axes that the server streams."""

    arrived_s: float
    """Flight clock, when its datagram was read."""
    number: int
    timestamp_s: float
    """On the server's own time base."""
    latency_s: float | None
    """Mid-exposure to transmission."""
    bodies: tuple[RigidBody, ...]


@dataclass(frozen=True, slots=True)
class Route:
    """How datagrams reach this computer."""

    transport: str
    local_address: str
    interface: str
    """Name of the network interface; empty: not found."""
    wireless: bool


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """One rigid body while it was watched."""

    id: int
    name: str
    frames: int
    tracked: int
    moved_m: float
    """Furthest apart of any coordinate, tracked frames only."""
    error_m: float
    """Mean marker error."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How evenly frames arrive; all of them, read together or not."""

    rate_hz: float
    server_rate_hz: float | None
    """Of the frame numbers by the server's own time stamps; None: it has none."""
    period_s: float
    lost: int
    share_lost: float
    gap_s: float
    """Longest between two arrivals."""
    off_s: tuple[float, ...]
    """Each arrival against an even stream, sorted; the earliest twentieth is 0."""
    latency_s: tuple[float, ...]
    """Mid-exposure to transmission, sorted."""

    def percentile_off_s(self, share: float) -> float:
        """Of `off_s`."""
        return _percentile(self.off_s, share)


def timing(frames: Sequence[FrameSeen]) -> Timing | None:
    """Least squares of arrival over frame number; None: fewer than 10 frames, or their number stands still."""
    if len(frames) < 10 or frames[-1].number <= frames[0].number:
        return None
    n = [frame.number - frames[0].number for frame in frames]
    t = [frame.arrived_s - frames[0].arrived_s for frame in frames]
    mean_n, mean_t = sum(n) / len(n), sum(t) / len(t)
    spread = sum((a - mean_n) ** 2 for a in n)
    period_s = sum((a - mean_n) * (b - mean_t) for a, b in zip(n, t, strict=True)) / spread
    if period_s <= 0.0:
        return None
    off = sorted(b - mean_t - period_s * (a - mean_n) for a, b in zip(n, t, strict=True))
    early = _percentile(off, 0.05)
    stamped_s = frames[-1].timestamp_s - frames[0].timestamp_s
    lost = n[-1] + 1 - len(frames)
    return Timing(
        rate_hz=(len(frames) - 1) / t[-1],
        server_rate_hz=n[-1] / stamped_s if stamped_s > 0.0 else None,
        period_s=period_s,
        lost=lost,
        share_lost=lost / (n[-1] + 1),
        gap_s=max(b - a for a, b in itertools.pairwise(t)),
        off_s=tuple(value - early for value in off),
        latency_s=tuple(sorted(frame.latency_s for frame in frames if frame.latency_s is not None)),
    )


def bodies(frames: Sequence[FrameSeen], names: Mapping[int, str]) -> list[BodyMotion]:
    """Every rigid body that was streamed or is described, by id."""
    ids = {body.id for frame in frames for body in frame.bodies} | set(names)
    found = []
    for number in sorted(ids):
        seen = [body for frame in frames for body in frame.bodies if body.id == number]
        tracked = [body for body in seen if body.tracking_valid]
        moved_m = 0.0
        if tracked:
            spans = [max(b.position_m[i] for b in tracked) - min(b.position_m[i] for b in tracked) for i in range(3)]
            moved_m = math.sqrt(sum(span * span for span in spans))
        error_m = sum(body.error_m for body in tracked) / len(tracked) if tracked else 0.0
        found.append(BodyMotion(number, names.get(number, ""), len(seen), len(tracked), moved_m, error_m))
    return found


def histogram(t: Timing) -> list[str]:
    """Arrivals against an even stream, as bars; the last one holds all that is later."""
    width_s = max(0.0005, _percentile(t.off_s, 0.99) / (_BINS - 1))
    counts = [0] * _BINS
    for off_s in t.off_s:
        counts[min(_BINS - 1, max(0, int(off_s / width_s)))] += 1
    most = max(counts)
    lines = []
    for k, count in enumerate(counts):
        span = f"{1e3 * k * width_s:5.1f} ms" + (" and more" if k == _BINS - 1 else "")
        bar = "#" * math.ceil(_BAR * count / most)
        lines.append(f"  {span:<18} {100.0 * count / len(t.off_s):5.1f} %  {bar}")
    return lines


@dataclass(frozen=True, slots=True)
class Judged:
    """Rows, and the changes of the vehicle file that would put right what is wrong."""

    rows: list[Row]
    changes: dict[Location, Data]


def judge(
    frames: Sequence[FrameSeen],
    names: Mapping[int, str],
    info: ServerInfo,
    vehicle: Vehicle,
    duration_s: float,
    route: Route,
    *,
    moving: bool,
) -> Judged:
    """All rows of a stream that was watched.

    Args:
        frames: in order of arrival.
        names: of the rigid bodies.
        info: what the server said about itself.
        vehicle: what the companion believes.
        duration_s: so long it was watched.
        route: how it comes.
        moving: somebody moved the vehicle meanwhile.
    """
    device, changes = vehicle.devices.mocap, dict[Location, Data]()
    version = ".".join(map(str, info.application_version))
    rows = [SERVER.good(f"{info.application} {version}, NatNet {info.version}, {route.transport}")]
    rows.append(_network(route))
    seen = bodies(frames, names)
    own_id = device.rigid_body_id
    rows.append(_own(seen, own_id, moving, changes))
    t = timing(frames)
    if t is None:
        return Judged(rows, changes)
    poses = _poses(frames, own_id, device.up_axis)
    others = tuple(body.id for body in seen if body.id != own_id and body.frames)
    stream = MocapStream(len(frames), t.lost, info.application, others, names.get(own_id, ""))
    observed = Observations(0.0, duration_s, mocap=tuple(poses), mocap_stream=stream)
    rate = _rate(t, device.rate_hz, changes)
    # The device's own row is the server's here, and the rate is told with its cause.
    rows += [
        rate if row.id == preflight.RATE.id else row
        for row in preflight.rows(observed, vehicle)
        if row.id not in (preflight.DEVICE.id, preflight.CLOCK.id)
    ]
    rows += [_steady(t), *([_delay(t)] if t.latency_s else [])]
    return Judged(rows, changes)


def _poses(frames: Sequence[FrameSeen], own_id: int, up_axis: str) -> list[MocapPose]:
    poses = []
    for frame in frames:
        for body in frame.bodies:
            if body.id != own_id:
                continue
            p, q = body.position_m, body.quat_wxyz
            if up_axis == "y":
                p, q = z_up_from_y_up(p, q)
            poses.append(
                MocapPose(frame.arrived_s, frame.latency_s, frame.number, p, q, body.tracking_valid, body.error_m)
            )
    return poses


def _own(seen: Sequence[BodyMotion], own_id: int, moving: bool, changes: dict[Location, Data]) -> Row:
    streamed = [body for body in seen if body.frames]
    moved = [body for body in streamed if body.moved_m >= MOVED_MIN_M]
    read = ", ".join(_label(body) + (f" moved {100.0 * body.moved_m:.0f} cm" if moving else "") for body in streamed)
    read = read or "no rigid body is streamed"
    key: Location = ("devices", "mocap", "rigid_body_id")
    if moving and len(moved) == 1 and moved[0].id != own_id:
        changes[key] = moved[0].id
        return OWN.bad(
            read, f"id {own_id} moves", f"it is {_label(moved[0])}: set devices.mocap.rigid_body_id: {moved[0].id}"
        )
    if moving and not moved:
        return OWN.bad(read, f"id {own_id} moves", "nothing moved: do it again and carry the vehicle some 30 cm")
    if moving and own_id in [body.id for body in moved] and len(moved) > 1:
        return OWN.bad(read, f"id {own_id} alone moves", "move nothing but the vehicle, and do it again")
    if own_id in [body.id for body in streamed]:
        told = "moved as the vehicle did" if moving else "is streamed; --move tells whether it is the vehicle's"
        name = next(_label(body) for body in streamed if body.id == own_id)
        return OWN.good(f"{name} {told}")
    if len(streamed) == 1:
        changes[key] = streamed[0].id
        fix = f"set devices.mocap.rigid_body_id: {streamed[0].id}, if that is the vehicle"
    elif streamed:
        fix = "find out which one the vehicle is: companion mocap check --move"
    else:
        fix = "in Motive create a rigid body of the vehicle's markers and stream rigid bodies"
    return OWN.bad(read, f"id {own_id}", fix)


def _label(body: BodyMotion) -> str:
    return f'id {body.id} "{body.name}"' if body.name else f"id {body.id}"


def _rate(t: Timing, expected_hz: float, changes: dict[Location, Data]) -> Row:
    wanted = f"{expected_hz:g} Hz"
    camera_hz = t.server_rate_hz or 1.0 / t.period_s
    read = f"{t.rate_hz:.1f} Hz, the cameras run at {camera_hz:.1f} Hz"
    if abs(t.rate_hz / expected_hz - 1.0) <= RATE_TOLERANCE:
        return preflight.RATE.good(read, wanted)
    if abs(camera_hz / expected_hz - 1.0) <= RATE_TOLERANCE:
        return preflight.RATE.bad(
            read, wanted, "frames are lost on the way: a cable, a network of its own, a computer less busy"
        )
    changes["devices", "mocap", "rate_hz"] = float(round(camera_hz))
    fix = f"set the camera rate to {expected_hz:g} Hz in Motive; or, to fly with this one, devices.mocap.rate_hz: {round(camera_hz)}"
    return preflight.RATE.bad(read, wanted, fix)


def _steady(t: Timing) -> Row:
    late_s, limit_s = t.percentile_off_s(0.99), 0.5 * t.period_s
    median, most = t.percentile_off_s(0.5), t.off_s[-1]
    read = f"late by {1e3 * median:.1f} ms (median), {1e3 * late_s:.1f} ms (99 %), {1e3 * most:.1f} ms (worst)"
    wanted = f"99 % within {1e3 * limit_s:.1f} ms"
    if late_s <= limit_s:
        return STEADY.good(read, wanted)
    return STEADY.bad(read, wanted, "a cable, no power saving of the network card, and nothing else on this computer")


def _delay(t: Timing) -> Row:
    value_ms = EV_DELAY_MS
    latency_s = _percentile(t.latency_s, 0.5)
    read = f"{1e3 * latency_s:.1f} ms from exposure to transmission (median)"
    wanted = f"{value_ms:g} ms, which the parameter file says"
    if abs(latency_s - 1e-3 * value_ms) <= DELAY_TOLERANCE_S:
        return DELAY.good(read, wanted)
    fix = (
        "take load off Motive (no video, fewer bodies, labelled markers off); what stays is measured by companion latency, and "
        f"goes into PX4's EKF2_EV_DELAY: {1e3 * latency_s:.0f} ms or a little more"
    )
    return DELAY.bad(read, wanted, fix)


def _network(route: Route) -> Row:
    read = f"{route.transport} on {route.interface or 'an unknown interface'} ({route.local_address})"
    if route.wireless:
        return NETWORK.bad(read + ", Wi-Fi", "a cable", "use a cable, or unicast and a Wi-Fi of its own at 5 GHz")
    return NETWORK.good(read)


def as_json(frames: Sequence[FrameSeen], names: Mapping[int, str], info: ServerInfo, route: Route) -> dict[str, Any]:
    """Figures for scripts; seconds, metres, Hz."""
    t = timing(frames)
    return {
        "server": {
            "application": info.application,
            "version": ".".join(map(str, info.application_version)),
            "natnet": info.version,
            "transport": route.transport,
            "local_address": route.local_address,
            "interface": route.interface,
        },
        "bodies": [
            {
                "id": b.id,
                "name": b.name,
                "frames": b.frames,
                "tracked": b.tracked,
                "moved_m": b.moved_m,
                "error_m": b.error_m,
            }
            for b in bodies(frames, names)
        ],
        "timing": None
        if t is None
        else {
            "rate_hz": t.rate_hz,
            "server_rate_hz": t.server_rate_hz,
            "lost": t.lost,
            "gap_s": t.gap_s,
            "late_s": {"p50": t.percentile_off_s(0.5), "p99": t.percentile_off_s(0.99), "max": t.off_s[-1]},
            "latency_s": {"p50": _percentile(t.latency_s, 0.5), "p99": _percentile(t.latency_s, 0.99)}
            if t.latency_s
            else None,
        },
    }


def _percentile(ordered: Sequence[float], share: float) -> float:
    return ordered[int(share * (len(ordered) - 1))]
