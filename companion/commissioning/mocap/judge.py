"""Evaluates rate, jitter, latency and bodies of a recorded motion-capture stream, and names remedies. Pure functions.

The preflight's rows (`companion.preflight.mocap`) are reused; the other rows are for a new set-up.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from companion.config.base import Location
from companion.config.document import Data
from companion.config.vehicle import Vehicle
from companion.io.mocap.frames import RigidBody
from companion.io.mocap.natnet import NEWEST_DESCRIBED_VERSION, ServerInfo, z_up_from_y_up
from companion.model.check_row import Row
from companion.model.markers import MarkerFrame
from companion.model.observations import MocapStream, Observations
from companion.model.types import MocapPose
from companion.preflight import mocap as preflight
from companion.preflight.checks import Check
from companion.px4.required import WANTED

SERVER = Check("mocap.server", "mocap server", why="nothing is streamed to the vehicle")
OWN = Check("mocap.own", "rigid body of the vehicle", why="the pose of another body would be used")
STEADY = Check("mocap.steady", "mocap jitter", why="EKF2 subtracts the same fixed delay from all poses", warns=True)
DELAY = Check(
    "mocap.delay",
    "mocap latency compared with EKF2_EV_DELAY",
    why="PX4 fuses each pose at the wrong time: the estimate oscillates with the vehicle's motion",
)
NETWORK = Check(
    "mocap.network", "route to the server", why="Wi-Fi delays frames and delivers them in bursts", warns=True
)

MOVED_MIN_M: Final = 0.05
RATE_TOLERANCE: Final = 0.05
DELAY_TOLERANCE_S: Final = 0.003
EV_DELAY_MS: Final = next(float(one.value or 0.0) for one in WANTED if one.name == "EKF2_EV_DELAY")
"""EKF2_EV_DELAY in the project's parameter file."""
_BINS: Final = 9
_BAR: Final = 40


@dataclass(frozen=True, slots=True)
class FrameSeen:
    """One frame of data with all of its rigid bodies, in the axes that the server streams."""

    arrived_s: float
    """Flight clock when its datagram was read."""
    number: int
    timestamp_s: float
    """Time stamp on the server's clock."""
    latency_s: float | None
    """Time from mid-exposure to transmission."""
    bodies: tuple[RigidBody, ...]
    markers: MarkerFrame | None = None
    """Its single markers, or those of the ball's rigid body, in the world frame."""


@dataclass(frozen=True, slots=True)
class Route:
    """How datagrams reach this computer."""

    transport: str
    local_address: str
    interface: str
    """Name of the network interface; empty if unknown."""
    wireless: bool


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """One rigid body during the recording."""

    id: int
    name: str
    frames: int
    tracked: int
    moved_m: float
    """Diagonal of the bounding box of its tracked positions."""
    error_m: float
    """Mean marker error."""

    @property
    def label(self) -> str:
        """Return the id, and the name if there is one."""
        return f'id {self.id} "{self.name}"' if self.name else f"id {self.id}"


@dataclass(frozen=True, slots=True)
class Timing:
    """Regularity of the frames' arrival."""

    rate_hz: float
    server_rate_hz: float | None
    """Rate computed from frame numbers and the server's time stamps; None if the server sends no time stamps."""
    period_s: float
    lost: int
    gap_s: float
    """Longest time between two arrivals."""
    off_s: tuple[float, ...]
    """Delay of each arrival relative to a perfectly regular stream, sorted; the 5th percentile is 0."""
    latency_s: tuple[float, ...]
    """Times from mid-exposure to transmission, sorted."""

    def percentile_off_s(self, share: float) -> float:
        """Return a percentile of `off_s`; `share` is 0 to 1."""
        return _percentile(self.off_s, share)


def timing(frames: Sequence[FrameSeen]) -> Timing | None:
    """Return the regularity of arrivals, by a fit of arrival time over frame number; None for fewer than 10 or repeated frames."""
    if len(frames) < 10 or frames[-1].number <= frames[0].number:
        return None
    n = [frame.number - frames[0].number for frame in frames]
    t = [frame.arrived_s - frames[0].arrived_s for frame in frames]
    period_s, first_s = statistics.linear_regression(n, t)
    if period_s <= 0.0:
        return None
    off = sorted(b - first_s - period_s * a for a, b in zip(n, t, strict=True))
    early = _percentile(off, 0.05)
    stamped_s = frames[-1].timestamp_s - frames[0].timestamp_s
    return Timing(
        rate_hz=(len(frames) - 1) / t[-1],
        server_rate_hz=n[-1] / stamped_s if stamped_s > 0.0 else None,
        period_s=period_s,
        lost=n[-1] + 1 - len(frames),
        gap_s=max(b - a for a, b in itertools.pairwise(t)),
        off_s=tuple(value - early for value in off),
        latency_s=tuple(sorted(frame.latency_s for frame in frames if frame.latency_s is not None)),
    )


def bodies(frames: Sequence[FrameSeen], names: Mapping[int, str]) -> list[BodyMotion]:
    """Return every rigid body that was streamed or that the server describes, by id."""
    ids = {body.id for frame in frames for body in frame.bodies} | set(names)
    found = []
    for number in sorted(ids):
        seen = [body for frame in frames for body in frame.bodies if body.id == number]
        tracked = [body for body in seen if body.tracking_valid]
        axes = zip(*(body.position_m for body in tracked), strict=True)
        found.append(
            BodyMotion(
                id=number,
                name=names.get(number, ""),
                frames=len(seen),
                tracked=len(tracked),
                moved_m=math.hypot(*(max(values) - min(values) for values in axes)),
                error_m=statistics.fmean(body.error_m for body in tracked) if tracked else 0.0,
            )
        )
    return found


def histogram(t: Timing) -> list[str]:
    """Return a histogram of the delays relative to a regular stream; the last bar contains all longer delays."""
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
class Watched:
    """Recording of a stream."""

    frames: Sequence[FrameSeen]
    names: Mapping[int, str]
    """Names of the rigid bodies, by id."""
    info: ServerInfo
    route: Route
    duration_s: float
    moving: bool
    """Whether the vehicle was moved during the recording."""


def judge(watched: Watched, vehicle: Vehicle) -> tuple[list[Row], dict[Location, Data]]:
    """Return all rows of a recorded stream, and the corrections to the vehicle file."""
    frames, info, device = watched.frames, watched.info, vehicle.devices.mocap
    changes = dict[Location, Data]()
    version = ".".join(map(str, info.application_version))
    seen = bodies(frames, watched.names)
    rows = [
        _server(info, f"{info.application} {version}, NatNet {info.version}, {watched.route.transport}"),
        _network(watched.route),
        _own(seen, len(frames), device.rigid_body_id, watched.moving, changes),
    ]
    t = timing(frames)
    if t is None:
        return rows, changes
    poses = _poses(frames, device.rigid_body_id, device.up_axis)
    others = tuple(body.id for body in seen if body.id != device.rigid_body_id and body.frames)
    stream = MocapStream(
        frames=len(frames),
        lost=t.lost,
        application=info.application,
        other_bodies=others,
        body_name=watched.names.get(device.rigid_body_id, ""),
    )
    markers = tuple(frame.markers for frame in frames if frame.markers is not None)
    observed = Observations(
        start_s=0.0, duration_s=watched.duration_s, mocap=tuple(poses), mocap_stream=stream, markers=markers
    )
    rate = _rate(t, device.rate_hz, changes)
    # The preflight's device row is replaced by the server's row, and its rate by a row with the cause.
    rows += [
        rate if row.id == preflight.RATE.id else row
        for row in preflight.rows(observed, vehicle)
        if row.id not in (preflight.DEVICE.id, preflight.CLOCK.id)
    ]
    return [*rows, _steady(t), *([_delay(t)] if t.latency_s else [])], changes


def _server(info: ServerInfo, read: str) -> Row:
    if info.natnet_version[:2] <= NEWEST_DESCRIBED_VERSION:
        return SERVER.good(read)
    newest = ".".join(map(str, NEWEST_DESCRIBED_VERSION))
    fix = "compare the poses with those that Motive shows; if no latency is reported, the end of these frames has an unknown layout"
    return SERVER.doubtful(read, f"NatNet {newest} or older", fix)


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
                MocapPose(
                    stamp_s=frame.arrived_s,
                    latency_s=frame.latency_s,
                    frame_number=frame.number,
                    position_world_m=p,
                    attitude_wxyz=q,
                    tracking_valid=body.tracking_valid,
                    marker_error_m=body.error_m,
                )
            )
    return poses


def _own(seen: Sequence[BodyMotion], frames: int, own_id: int, moving: bool, changes: dict[Location, Data]) -> Row:
    streamed = {body.id: body for body in seen if body.frames}
    moved = [body for body in streamed.values() if body.moved_m >= MOVED_MIN_M] if moving else []
    read = ", ".join(
        body.label + (f" moved {100.0 * body.moved_m:.0f} cm" if moving else "") for body in streamed.values()
    )
    read = read or "no rigid body is streamed"
    if any(body.frames > frames for body in streamed.values()):
        twice = ", ".join(body.label for body in streamed.values() if body.frames > frames)
        return OWN.bad(f"two rigid bodies with {twice}", "one body per id", "give each its own streaming id in Motive")
    key: Location = ("devices", "mocap", "rigid_body_id")
    if len(moved) == 1 and moved[0].id != own_id:
        changes[key] = moved[0].id
        fix = f"the vehicle is {moved[0].label}: set devices.mocap.rigid_body_id: {moved[0].id}"
        return OWN.bad(read, f"id {own_id} moves", fix)
    if moving and not moved:
        return OWN.bad(read, f"id {own_id} moves", "nothing moved: repeat, and carry the vehicle about 30 cm")
    if len(moved) > 1 and own_id in [body.id for body in moved]:
        return OWN.bad(read, f"id {own_id} is the only one that moves", "move only the vehicle, and repeat")
    if own_id in streamed:
        result = "moved as the vehicle did" if moving else "is streamed; --move shows whether it is the vehicle's"
        return OWN.good(f"{streamed[own_id].label} {result}")
    if len(streamed) == 1:
        (changes[key],) = streamed
        fix = f"set devices.mocap.rigid_body_id: {changes[key]}, if that is the vehicle"
    elif streamed:
        fix = "find the vehicle's id: companion mocap check --move"
    else:
        fix = "in Motive, create a rigid body from the vehicle's markers, and stream rigid bodies"
    return OWN.bad(read, f"id {own_id}", fix)


def _rate(t: Timing, expected_hz: float, changes: dict[Location, Data]) -> Row:
    wanted = f"{expected_hz:g} Hz"
    camera_hz = t.server_rate_hz or 1.0 / t.period_s
    read = f"{t.rate_hz:.1f} Hz; the cameras run at {camera_hz:.1f} Hz"
    if abs(t.rate_hz / expected_hz - 1.0) <= RATE_TOLERANCE:
        return preflight.RATE.good(read, wanted)
    fix = "frames are being lost on the network: use a cable, a separate network or a less busy computer"
    if abs(camera_hz / expected_hz - 1.0) > RATE_TOLERANCE:
        changes["devices", "mocap", "rate_hz"] = float(round(camera_hz))
        fix = f"set the camera rate to {expected_hz:g} Hz in Motive; or fly at this rate with devices.mocap.rate_hz: {round(camera_hz)}"
    return preflight.RATE.bad(read, wanted, fix)


def _steady(t: Timing) -> Row:
    late_s, limit_s = t.percentile_off_s(0.99), 0.5 * t.period_s
    median, worst = t.percentile_off_s(0.5), t.off_s[-1]
    read = f"late by {1e3 * median:.1f} ms (median), {1e3 * late_s:.1f} ms (99 %), {1e3 * worst:.1f} ms (worst)"
    fix = "use a cable, disable power saving of the network card, and stop other programs on this computer"
    return STEADY.row(late_s <= limit_s, read, f"99 % within {1e3 * limit_s:.1f} ms", fix)


def _delay(t: Timing) -> Row:
    latency_s = _percentile(t.latency_s, 0.5)
    read = f"{1e3 * latency_s:.1f} ms from exposure to transmission (median)"
    fix = (
        "reduce Motive's load (no video, fewer bodies, labelled markers off); measure the rest with companion latency, and set "
        f"PX4's EKF2_EV_DELAY to the result, about {1e3 * latency_s:.0f} ms or a little more"
    )
    near = abs(latency_s - 1e-3 * EV_DELAY_MS) <= DELAY_TOLERANCE_S
    return DELAY.row(near, read, f"{EV_DELAY_MS:g} ms, as in the parameter file", fix)


def _network(route: Route) -> Row:
    read = f"{route.transport} on {route.interface or 'an unknown interface'} ({route.local_address})"
    if route.wireless:
        return NETWORK.bad(read + ", Wi-Fi", "a cable", "use a cable, or unicast on a separate 5 GHz Wi-Fi")
    return NETWORK.good(read)


def text(watched: Watched) -> list[str]:
    """Return the bodies and the histogram of delays for display."""
    lines = [f"bodies of {watched.info.application}, {watched.route.transport}:"]
    for body in bodies(watched.frames, watched.names):
        share = f"{100.0 * body.tracked / body.frames:.0f} % tracked" if body.frames else "not streamed"
        lines.append(
            f"  id {body.id:<5} {body.name or '-':<20} {share}, moved {100.0 * body.moved_m:.1f} cm, "
            f"marker error {1e3 * body.error_m:.1f} mm"
        )
    lines.append("single markers per frame: {} to {}".format(*_marker_counts(watched.frames)))
    t = timing(watched.frames)
    if t is not None:
        lines += ["delay of the frames relative to a regular stream:", *histogram(t)]
    return [*lines, ""]


def _marker_counts(frames: Sequence[FrameSeen]) -> tuple[int, int]:
    counts = [len(frame.markers.markers) for frame in frames if frame.markers is not None] or [0]
    return min(counts), max(counts)


def as_json(watched: Watched) -> dict[str, Any]:
    """Return the stream's part of the JSON document; seconds, metres, Hz."""
    t, info, route = timing(watched.frames), watched.info, asdict(watched.route)
    del route["wireless"]
    version = ".".join(map(str, info.application_version))
    return {
        "server": {"application": info.application, "version": version, "natnet": info.version, **route},
        "bodies": [asdict(body) for body in bodies(watched.frames, watched.names)],
        "single_markers": _marker_counts(watched.frames),
        "timing": t
        and {
            "rate_hz": t.rate_hz,
            "server_rate_hz": t.server_rate_hz,
            "lost": t.lost,
            "gap_s": t.gap_s,
            "late_s": _percentiles(t.off_s) | {"max": t.off_s[-1]},
            "latency_s": _percentiles(t.latency_s) if t.latency_s else None,
        },
    }


def _percentiles(ordered: Sequence[float]) -> dict[str, float]:
    return {"p50": _percentile(ordered, 0.5), "p99": _percentile(ordered, 0.99)}


def _percentile(ordered: Sequence[float], share: float) -> float:
    return ordered[int(share * (len(ordered) - 1))]
