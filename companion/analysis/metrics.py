"""Metrics of a flight; pure functions of a `FlightLog`. Position and attitude errors are measured by motion capture, never by the
estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.analysis.arm_skeleton import pose
from companion.analysis.log import Array, FlightLog
from companion.control.sensing import CatchDetector, ObservedCatchDetector
from companion.model.best_pose import best_pose
from companion.model.constants import TICK_PERIOD_S
from companion.model.frames import quat_rotate
from companion.model.types import PhaseKind

Mask = npt.NDArray[np.bool_]
SLIDING_LOWPASS_HZ = 10.0
FINAL_WINDOW_S = 0.5
TARGET = ((1.0, 0.1), (40.0, 0.7), (144.0, 1.225))
"""The impedance (M_d, K_d, K_p, each for x, y and z and for every joint) against which every law is graded, from the paper
(tab:control_parameters).
"""
DESIRED_FORCE_TIME_S = 0.5
"""Time constant with which the desired force F_d follows the measured force, so that a lasting load is carried rather than
yielded to.
"""


@dataclass(frozen=True, slots=True)
class TrackingRms:
    """RMS of the error norms; None where nothing was measured."""

    e_p_m: float | None
    e_q_deg: float | None
    e_alpha_deg: float | None


def catch_index(log: FlightLog) -> int | None:
    """Return the tick (index in the log) of the catch: the tick at the time of the first "catch" event.

    The detector confirms a catch with a delay and dates its event back to the contact, so that the impact belongs to the time
    after the catch. Without such an event, return the tick of an unconfirmed catch (`unconfirmed_catch_index`), or None if no
    contact was measured.
    """
    confirmed = _confirmed_catch_index(log)
    return confirmed if confirmed is not None else unconfirmed_catch_index(log)


def unconfirmed_catch_index(log: FlightLog) -> int | None:
    """Return the tick of an impact that the detector did not confirm before the flight was killed or left its mission plan. To
    find it, the catch detector is run again on the logged forces. None if a catch was confirmed, or no contact was measured.
    """
    if _confirmed_catch_index(log) is not None:
        return None
    measured, observed = CatchDetector(), ObservedCatchDetector()
    detector: CatchDetector = measured
    for outputs in log.outputs:
        if outputs.phase_kind is PhaseKind.FLIGHT and (control := outputs.control) is not None:
            force = control.force_observed_world_n
            detector = measured if force is None else observed
            detector.update(outputs.t_s, control.force_ext_world_n if force is None else force)
    felt_s = detector.unconfirmed_s
    return None if felt_s is None else int(np.searchsorted(log.columns.t_s, felt_s))


def _confirmed_catch_index(log: FlightLog) -> int | None:
    for k, outputs in enumerate(log.outputs):
        for event in outputs.events:
            if event.id == "catch":
                return min(k, int(np.searchsorted(log.columns.t_s[: k + 1], event.t_s)))
    return None


def flight_masks(log: FlightLog) -> tuple[Mask, Mask]:
    """Return two masks of the ticks of kind FLIGHT: before the catch, and from the catch on, which is empty without a catch."""
    flight = np.array([o.phase_kind is PhaseKind.FLIGHT for o in log.outputs], dtype=np.bool_)
    caught = catch_index(log)
    after = np.arange(len(flight)) >= (len(flight) if caught is None else caught)
    return flight & ~after, flight & after


def position_error_m(log: FlightLog) -> Array:
    """Return motion capture minus reference, world frame, (ticks, 3).

    A frame shows the vehicle at its exposure, a few milliseconds before the tick, and is compared with the reference of that moment.
    Otherwise a frame that is 10 ms old would count as an error of 5 mm at 0.5 m/s.
    """
    c = log.columns
    reference = c.reference_position_world_m - c.mocap_age_s[:, None] * c.reference_velocity_world_m_s
    return c.mocap_position_world_m - reference


def attitude_error_rad(log: FlightLog) -> Array:
    """Return roll, pitch, yaw measured by motion capture minus the law's desired attitude, wrapped to +-pi, (ticks, 3)."""
    return _wrapped(log.columns.mocap_attitude_rad - log.columns.attitude_desired_rad)


def arm_error_rad(log: FlightLog) -> Array:
    """Return joint angles minus reference, (ticks, joints)."""
    return log.columns.arm_rad - log.columns.arm_reference_rad


def tracking_rms(log: FlightLog, mask: Mask) -> TrackingRms:
    """Return the RMS of ||e_p||, ||e_q||, ||e_alpha|| over the ticks of the mask."""
    e_q, e_alpha = rms_norm(attitude_error_rad(log)[mask]), rms_norm(arm_error_rad(log)[mask])
    return TrackingRms(
        rms_norm(position_error_m(log)[mask]),
        None if e_q is None else math.degrees(e_q),
        None if e_alpha is None else math.degrees(e_alpha),
    )


def rms_norm(rows: Array) -> float | None:
    """Return sqrt(mean ||row||^2) over the rows without NaN, or None if there are none or they have no columns."""
    known = rows[np.isfinite(rows).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known * known, axis=1)))) if known.size else None


def final_e_z_m(log: FlightLog) -> float | None:
    """Return the mean height error over the last 0.5 s of FLIGHT, m."""
    pre, post = flight_masks(log)
    flight = pre | post
    if not flight.any():
        return None
    t_s = log.columns.t_s
    window = flight & (t_s > t_s[flight][-1] - FINAL_WINDOW_S)
    e_z = position_error_m(log)[window, 2]
    e_z = e_z[np.isfinite(e_z)]
    return float(np.mean(e_z)) if len(e_z) else None


def force_observer_error_n(log: FlightLog) -> tuple[float, float] | None:
    """Return RMS and peak of the norm of observed minus measured force over FLIGHT, N; None if not both were logged."""
    observed = log.column(lambda i, o, s: o.control.force_observed_world_n if o.control else None, 3)
    measured = log.column(lambda i, o, s: o.control.force_measured_world_n if o.control else None, 3)
    pre, post = flight_masks(log)
    error = np.linalg.norm((observed - measured)[pre | post], axis=1)
    error = error[np.isfinite(error)]
    return (float(np.sqrt(np.mean(error * error))), float(error.max())) if len(error) else None


def impedance_error(log: FlightLog) -> tuple[float | None, float | None]:
    """Return the RMS of ||dI|| after the catch, for the position rows (N) and for the joint rows (N m); None if a required value
    was not logged or the log is thinned.

    dI = M_d e'' + K_d e' + K_p e - e_tau, with the same `TARGET` for every law: if each law were graded against its own gains, a
    stiff one would look worse by definition. On the joints, e_tau is J'(F - F_d), where F_d is F low-passed with
    `DESIRED_FORCE_TIME_S`; on the base, e_tau is 0. Derivatives are central differences, low-passed at 10 Hz without phase shift.
    """
    if log.stride > 1:
        return None, None  # derivatives need every tick
    pre, post = flight_masks(log)
    joints = log.joint_count
    known = [
        o.control is not None and i.vehicle is not None and (i.arm is not None or not joints) for i, o, _ in log.rows()
    ]
    used = np.array(known, dtype=np.bool_) & (pre | post)
    t_s = log.columns.t_s[used]
    if not (used & post).any() or len(t_s) < 10 or not (np.diff(t_s) > 0).all():
        return None, None
    rows = [0, 1, 2, *range(6, 6 + joints)]
    rate = log.column(lambda i, o, s: o.control.error_rate if o.control else None, 6 + joints)[used][:, rows]
    error = log.column(lambda i, o, s: o.control.error if o.control else None, 6 + joints)[used][:, rows]
    e_tau = np.hstack([np.zeros((len(t_s), 3)), _joint_torque_error_nm(log, used)])
    if not all(np.isfinite(values).all() for values in (error, rate, e_tau)):
        return None, None
    inertia, damping, stiffness = (np.array([base] * 3 + [joint] * joints) for base, joint in TARGET)
    spring = damping * rate + stiffness * error - e_tau
    slow = lowpass_zero_phase(np.hstack([rate, spring]), TICK_PERIOD_S, SLIDING_LOWPASS_HZ)
    d_i = inertia * np.gradient(slow[:, : len(rows)], t_s, axis=0) + slow[:, len(rows) :]
    after = d_i[post[used]]
    return rms_norm(after[:, 0:3]), rms_norm(after[:, 3:])


def _joint_torque_error_nm(log: FlightLog, used: Mask) -> Array:
    """Return J'(F - F_d) for the ticks of the mask, N m, (ticks, joints); NaN if the logged configuration does not describe the arm."""
    joints = log.joint_count
    skeleton = log.arm_skeleton
    if skeleton is None:
        return np.full((int(used.sum()), joints), np.nan)
    force = log.column(lambda i, o, s: o.control.force_ext_world_n if o.control else None, 3)[used]
    passing = np.stack([_passing(column, TICK_PERIOD_S / DESIRED_FORCE_TIME_S) for column in force.T.tolist()], axis=1)
    quats = log.column(lambda i, o, s: i.vehicle.attitude_wxyz if i.vehicle else None, 4)[used]
    w, x, y, z = quats.T
    body_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    body_y = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1)
    body_z = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    force_body = np.stack([(passing * axis).sum(axis=1) for axis in (body_x, body_y, body_z)], axis=1)
    points, axes = pose(skeleton, log.columns.arm_rad[used])
    torques = [(np.cross(axes[:, j], points[:, -1] - points[:, j]) * force_body).sum(axis=1) for j in range(joints)]
    return np.stack(torques, axis=1) if torques else np.zeros((len(force_body), 0))


def _passing(values: list[float], k: float) -> list[float]:
    """Return the values minus their low-pass, which moves by `k` of the difference with each value."""
    lasting, passing = 0.0, []
    for value in values:
        passing.append(value - lasting)
        lasting += k * passing[-1]
    return passing


def lowpass_zero_phase(rows: Array, period_s: float, cutoff_hz: float) -> Array:
    """Filter `rows`, (ticks, columns), by a Butterworth low-pass of order 2 forwards and backwards; gain 1/2 at the cutoff."""
    k = math.tan(math.pi * min(cutoff_hz * period_s, 0.49))
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    a1, a2 = 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm
    pad = min(len(rows) - 1, math.ceil(1.0 / (cutoff_hz * period_s)))
    head, tail = 2.0 * rows[0] - rows[pad:0:-1], 2.0 * rows[-1] - rows[-2 : -pad - 2 : -1]
    signal = np.concatenate([head, rows, tail])

    def once(x: Array) -> Array:
        first = x[:1]
        driven = b0 * (x + 2.0 * np.concatenate([first, x[:-1]]) + np.concatenate([first, first, x[:-2]]))
        columns = []
        # The recursion takes floats: with arrays of one tick each, a catch takes 75 instead of 18 ms.
        for start, column in zip(x[0].tolist(), driven.T.tolist(), strict=True):
            y1 = y2 = start
            out = []
            for value in column:
                y1, y2 = value - a1 * y1 - a2 * y2, y1
                out.append(y1)
            columns.append(out)
        return np.array(columns).T

    return once(once(signal)[::-1])[::-1][pad : pad + len(rows)]


def loop_rate_hz(log: FlightLog) -> float | None:
    """Return the mean rate of the ticks' actual starts, Hz."""
    timing = log.timing
    return (timing.last_tick - timing.first_tick) / timing.span_s if timing.span_s > 0 else None


def missed_deadlines(log: FlightLog) -> int:
    """Return the number of ticks that started more than one period late."""
    return int((log.timing.lateness_s > TICK_PERIOD_S).sum())


def percentiles(durations_s: Array) -> dict[str, float | None]:
    """Return `p50`, `p99` and `max` of durations in ms; each is None if there are no values."""
    known = durations_s[np.isfinite(durations_s)]
    if not len(known):
        return {"p50": None, "p99": None, "max": None}
    return {name: float(np.percentile(known, q)) * 1e3 for name, q in (("p50", 50), ("p99", 99), ("max", 100))}


def slack_m(log: FlightLog) -> Array:
    """Return each tick's tether length minus mocap's distance from anchor to attachment; NaN on the ground and where unknown."""
    slack = np.full(len(log.inputs), np.nan)
    tether = (log.config.get("vehicle") or {}).get("tether")
    if not isinstance(tether, dict) or not {"anchor_world_m", "length_m"} <= tether.keys():
        return slack
    anchor, offset = tether["anchor_world_m"], tuple(tether.get("attachment_body_m", (0.0, 0.0, 0.0)))
    known = np.isfinite(log.columns.mocap_position_world_m[:, 0])
    for k, (i, o, _) in enumerate(log.rows()):
        if o.phase_kind not in (PhaseKind.GROUND, PhaseKind.DONE) and known[k] and (pose := best_pose(i)) is not None:
            arm = quat_rotate(pose.attitude_wxyz, offset)
            point = [p + a for p, a in zip(pose.position_world_m, arm, strict=True)]
            slack[k] = float(tether["length_m"]) - math.dist(point, anchor)
    return slack


def min_slack_m(log: FlightLog) -> float | None:
    """Return the smallest `slack_m`, or None if it is never known."""
    slack = slack_m(log)
    return float(np.nanmin(slack)) if np.isfinite(slack).any() else None


def _wrapped(angles_rad: Array) -> Array:
    out: Array = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return out
