"""Checks of the motion-capture stream: rate, jitter, latency, gaps, the vehicle's rigid body. `frames` checks its axes. Pure
functions.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator

from companion.config.devices import TrackedBall
from companion.config.tether import Room
from companion.config.vehicle import Vehicle
from companion.model.check_row import Row
from companion.model.markers import MarkerFrame
from companion.model.observations import MocapStream, Observations
from companion.model.types import MocapPose, Vec3
from companion.preflight.checks import Check, longest_unchanged_s

DEVICE = Check("mocap.device", "motion capture", "the server answers and streams", "PX4 needs it for its position")
NOT_CHECKED = (
    "another program feeds PX4 (devices.mocap.type: external): rate, latency, axes and lost frames are not checked; in flight, poses "
    "that jump, freeze, drift or belong to another body are noticed only as far as PX4's estimator rejects them"
)
RATE = Check(
    "mocap.rate",
    "mocap rate",
    "at least 90 % of `devices.mocap.rate_hz`; refused below `safety.mocap_rate_min_hz`",
    "PX4's estimate becomes slow and noisy; in flight this is a fault",
)
JITTER = Check(
    "mocap.jitter",
    "mocap regularity",
    "no gap between frames longer than 50 ms",
    "EKF2 subtracts one fixed delay: frames that arrive in bursts are fused at the wrong time",
    warns=True,
)
LATENCY = Check(
    "mocap.latency",
    "mocap latency",
    "from exposure to arrival; reported by the server and below `safety.mocap_latency_warn_s`; refused above "
    "`safety.mocap_latency_max_s`",
    "EKF2_EV_DELAY is 5 ms: older poses are fused as if they were current",
)
LOST = Check(
    "mocap.lost",
    "mocap frames lost",
    "at most 0.5 %; refused above 5 %",
    "a network that loses frames at rest loses more of them in flight",
)
TRACKED = Check(
    "mocap.tracked",
    "body tracked",
    "in every frame; refused below 95 % and more than `safety.mocap_timeout_s` without",
    "a body that is lost on the ground will be lost in flight: PX4 then drifts",
)
FROZEN = Check(
    "mocap.frozen",
    "pose changes",
    "the same pose for at most 1 s",
    "cameras at rest measure a little noise: a pose that is the same to the last bit is not measured",
)
BODY = Check(
    "mocap.body",
    "rigid body",
    "`devices.mocap.rigid_body_id`, and no other body that could be mistaken for it",
    "the pose of another body would be used",
    warns=True,
)
ERROR = Check(
    "mocap.error",
    "marker error",
    "at most 2 mm on average",
    "bent or swapped markers rotate the body's axes",
    warns=True,
)
CLOCK = Check(
    "mocap.clock",
    "mocap clock compared with the companion's",
    "frames arrive at the times that their frame numbers predict: rate within 1 %, jitter below 20 ms",
    "diverging clocks, or a server that stalls and catches up, make every age wrong",
    warns=True,
)
BALL = Check(
    "mocap.ball",
    "thrown ball",
    "with `devices.mocap.ball`: single markers, or the ball's rigid body, in the stream",
    "nothing is followed: the mission waits, and goes on without a catch",
    warns=True,
)
BAR = Check(
    "mocap.bar",
    "bar's rigid body",
    "with `devices.mocap.bar_id`: the bar's rigid body in the stream",
    "the bar is taken to stand exactly at its place in the mission",
    warns=True,
)
CHECKS = (DEVICE, RATE, JITTER, LATENCY, LOST, TRACKED, FROZEN, BODY, ERROR, CLOCK, BALL, BAR)

RATE_GOOD = 0.9
GAP_GOOD_S = 0.05
LOST_GOOD, LOST_MAX = 0.005, 0.05
TRACKED_MIN = 0.95
FROZEN_MAX_S = 1.0
ERROR_GOOD_M = 0.002
CLOCK_GOOD, WANDER_GOOD_S = 0.01, 0.020


def rows(o: Observations, vehicle: Vehicle) -> Iterator[Row]:
    """Return the rows of motion capture."""
    if vehicle.devices.mocap.external:
        yield DEVICE.doubtful(NOT_CHECKED)
        return
    failure, stream = o.failures.get("mocap"), o.mocap_stream
    if failure is not None or stream is None:
        yield DEVICE.bad(failure or "not checked")
        return
    yield DEVICE.good(stream.application or "answers")
    yield _rate(o, stream, vehicle)
    if len(o.mocap) < 3:
        return
    yield _jitter(o.mocap, vehicle)
    yield _latency(o.mocap, vehicle)
    yield _lost(stream)
    yield _tracked(o.mocap, vehicle.safety.mocap_timeout_s)
    yield _frozen(o.mocap)
    yield _body(stream, vehicle)
    yield _error(o.mocap)
    yield _clock(o.mocap, vehicle)
    if vehicle.devices.mocap.ball is not None:
        yield _ball(o.markers, stream, vehicle.devices.mocap.ball, vehicle)
    if vehicle.devices.mocap.bar_id is not None:
        yield _bar(stream, vehicle.devices.mocap.bar_id)


def _rate(o: Observations, stream: MocapStream, vehicle: Vehicle) -> Row:
    rate_hz, expected_hz = stream.frames / o.duration_s, vehicle.devices.mocap.rate_hz
    least_hz = vehicle.safety.mocap_rate_min_hz
    read, wanted = f"{rate_hz:.0f} Hz", f"{expected_hz:g} Hz"
    fix = "set the camera rate in Motive or devices.mocap.rate_hz; check for a slow network or a busy computer"
    return RATE.graded(rate_hz >= RATE_GOOD * expected_hz, rate_hz >= least_hz, read, wanted, fix)


def _jitter(poses: tuple[MocapPose, ...], vehicle: Vehicle) -> Row:
    gap_s = max(b.stamp_s - a.stamp_s for a, b in itertools.pairwise(poses))
    read, wanted = f"longest gap {gap_s * 1e3:.0f} ms", f"{GAP_GOOD_S * 1e3:.0f} ms"
    fix = "use a cable, not Wi-Fi; disable power saving of the network card; see the rows on processor and real-time permission"
    return JITTER.row(gap_s <= max(GAP_GOOD_S, 2.5 / vehicle.devices.mocap.rate_hz), read, wanted, fix)


def _latency(poses: tuple[MocapPose, ...], vehicle: Vehicle) -> Row:
    limit_s, worst_s = vehicle.safety.mocap_latency_warn_s, vehicle.safety.mocap_latency_max_s
    wanted = f"{limit_s * 1e3:.0f} ms"
    latency_s = sorted(pose.latency_s for pose in poses if pose.latency_s is not None)
    fix = "use cameras that stamp exposure, and NatNet 3.0 to 4.4"
    if vehicle.devices.team is not None and all(pose.exposure_server_s is None for pose in poses):
        return LATENCY.bad(
            "the server does not stamp exposures", wanted, f"two vehicles begin together by its clock: {fix}"
        )
    if not latency_s:
        return LATENCY.doubtful("the server does not report it", wanted, fix)
    high_s = latency_s[int(0.99 * (len(latency_s) - 1))]
    read = f"{latency_s[len(latency_s) // 2] * 1e3:.1f} ms, {high_s * 1e3:.1f} ms at the 99th percentile"
    fix = "lower Motive's load: fewer markers and bodies, no video, labelled markers off; use a cable, not Wi-Fi"
    return LATENCY.graded(high_s <= limit_s, high_s <= worst_s, read, wanted, fix)


def _lost(stream: MocapStream) -> Row:
    share = stream.lost / max(1, stream.frames + stream.lost)
    read, wanted = f"{stream.lost} of {stream.frames + stream.lost} frames, {share:.1%}", f"{LOST_GOOD:.1%}"
    fix = "connect by cable on a separate network; on Wi-Fi, use unicast (devices.mocap.transport)"
    return LOST.graded(share <= LOST_GOOD, share <= LOST_MAX, read, wanted, fix)


def _tracked(poses: tuple[MocapPose, ...], gap_max_s: float) -> Row:
    share = sum(pose.tracking_valid for pose in poses) / len(poses)
    untracked_s = (1.0 - share) * (poses[-1].stamp_s - poses[0].stamp_s)
    read = f"{share:.1%} of the frames"
    fix = "clean or move the markers, make sure that the cameras can see them, calibrate the volume"
    bearable = share >= TRACKED_MIN or untracked_s <= gap_max_s
    return TRACKED.graded(share == 1.0, bearable, read, "all", fix)


def _frozen(poses: tuple[MocapPose, ...]) -> Row:
    longest_s = longest_unchanged_s((one.stamp_s, (one.position_world_m, one.attitude_wxyz)) for one in poses)
    read, wanted = f"the same pose for {longest_s:.2f} s at most", f"{FROZEN_MAX_S:g} s"
    fix = "Motive is paused, in edit mode or plays a take, or its smoothing holds the pose: restart live streaming"
    return FROZEN.row(longest_s <= FROZEN_MAX_S, read, wanted, fix)


def _body(stream: MocapStream, vehicle: Vehicle) -> Row:
    mocap = vehicle.devices.mocap
    number, known = mocap.rigid_body_id, (mocap.ball and mocap.ball.id, mocap.bar_id)
    others = tuple(one for one in stream.other_bodies if one not in known)
    name = f' "{stream.body_name}"' if stream.body_name else ""
    if not others:
        return BODY.good(f"id {number}{name}, no other", f"id {number}")
    if vehicle.devices.team is not None and len(others) == 1:
        return BODY.good(f"id {number}{name}, and {others[0]}, the other vehicle's", f"id {number} and one more")
    fix = "make sure that this is the vehicle's body; disable the others in Motive, or change their shape"
    return BODY.bad(f"id {number}{name}, and others: {', '.join(map(str, others))}", f"id {number} alone", fix)


def _ball(frames: tuple[MarkerFrame, ...], stream: MocapStream, ball: TrackedBall, vehicle: Vehicle) -> Row:
    """Return the row on what could be the ball; markers that are there before the throw are reflections, or the ball in a hand."""
    if ball.id is not None:
        share = sum(bool(frame.markers) for frame in frames) / max(1, len(frames))
        if ball.id not in stream.other_bodies:
            fix = "create it in Motive from the ball's markers, or set devices.mocap.ball.id to its streaming id"
            return BALL.bad(_without(stream, ball.id), f"body {ball.id}", fix)
        return BALL.row(
            share > 0.0, f"body {ball.id}, in {share:.0%} of the frames", "tracked", "show the ball to the cameras"
        )
    counts = [len(frame.markers) for frame in frames]
    if not any(counts):
        fix = "stream unlabelled markers in Motive, and show the ball to the cameras"
        return BALL.bad(f"no single marker in {len(frames)} frames", "the ball, once it is shown", fix)
    inside = {len([one for one in frame.markers if _in_room(one.position_world_m, vehicle.room)]) for frame in frames}
    read = f"{min(counts)} to {max(counts)} single markers, {min(inside)} to {max(inside)} of them in the room"
    return BALL.row(
        max(inside) <= 1, read, "at most the ball", "cover or mask what reflects in the room, such as other markers"
    )


def _bar(stream: MocapStream, bar_id: int) -> Row:
    if bar_id in stream.other_bodies:
        return BAR.good(f"body {bar_id}", f"body {bar_id}")
    fix = "create it in Motive from the bar's markers, or set devices.mocap.bar_id to its streaming id"
    return BAR.bad(_without(stream, bar_id), f"body {bar_id}", fix)


def _without(stream: MocapStream, body_id: int) -> str:
    return f"no rigid body {body_id}; other bodies: {', '.join(map(str, stream.other_bodies)) or 'none'}"


def _in_room(position_m: Vec3, room: Room) -> bool:
    sides = zip(position_m, (room.x_m, room.y_m, room.z_m), strict=True)
    return all(low <= value <= high for value, (low, high) in sides)


def _error(poses: tuple[MocapPose, ...]) -> Row:
    mean_m = sum(pose.marker_error_m for pose in poses) / len(poses)
    read, wanted = f"{mean_m * 1e3:.1f} mm", f"{ERROR_GOOD_M * 1e3:.0f} mm"
    fix = "create the rigid body again in Motive; fasten its markers; calibrate the volume"
    return ERROR.row(mean_m <= ERROR_GOOD_M, read, wanted, fix)


def _clock(poses: tuple[MocapPose, ...], vehicle: Vehicle) -> Row:
    """Return the row on a fit of arrival time over frame number: the slope is the server's period, the residual is jitter."""
    first = poses[0]
    n = [pose.frame_number - first.frame_number for pose in poses]
    t = [pose.stamp_s - first.stamp_s for pose in poses]
    period_s, first_s = statistics.linear_regression(n, t) if any(n) else (0.0, 0.0)
    expected_hz = vehicle.devices.mocap.rate_hz
    wanted = f"{1e3 / expected_hz:.3f} ms per frame, steady within {WANDER_GOOD_S * 1e3:.0f} ms"
    if not period_s > 0.0:
        return CLOCK.bad(
            "the frame number does not advance", wanted, "Motive is paused or is playing a take: restart live streaming"
        )
    # Late frames are jitter; only the median of each tenth of the time is used here.
    off_s = sorted(_medians([b - first_s - period_s * a for a, b in zip(n, t, strict=True)]))
    wander_s = off_s[-1] - off_s[0]
    read = f"{period_s * 1e3:.3f} ms per frame, jitter {wander_s * 1e3:.1f} ms"
    steady = abs(period_s * expected_hz - 1.0) <= CLOCK_GOOD and wander_s <= WANDER_GOOD_S
    fix = "set devices.mocap.rate_hz to the camera rate; check for a server that stalls, or for clock steps by time synchronisation"
    return CLOCK.row(steady, read, wanted, fix)


def _medians(values: list[float]) -> list[float]:
    size = max(1, len(values) // 10)
    parts = [sorted(values[i : i + size]) for i in range(0, len(values) - size + 1, size)]
    return [part[len(part) // 2] for part in parts]
