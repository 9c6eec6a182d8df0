"""Metrics of a flight; pure functions of a `FlightLog`. Position and attitude errors are measured by motion capture, never by the
estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from companion.analysis.log import Array, FlightLog
from companion.control.sensing import CatchDetector
from companion.model.frames import quat_rotate
from companion.model.types import PhaseKind

Mask = npt.NDArray[np.bool_]
SLIDING_LOWPASS_HZ = 10.0
FINAL_WINDOW_S = 0.5


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of durations, ms."""

    p50_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True, slots=True)
class TrackingRms:
    """RMS of the error norms; None where nothing was measured."""

    e_p_m: float | None
    e_q_deg: float | None
    e_alpha_deg: float | None


def catch_index(log: FlightLog) -> int | None:
    """Return the tick (position in the log) of the catch, at the time of the first event "catch".

    The detector confirms a catch after some time and dates its event back to the contact, so that the impact counts as after the catch.
    Without such an event it is the tick of an unconfirmed catch (`unconfirmed_catch_index`). None if no contact was measured.
    """
    confirmed = _confirmed_catch_index(log)
    return confirmed if confirmed is not None else unconfirmed_catch_index(log)


def unconfirmed_catch_index(log: FlightLog) -> int | None:
    """Return the tick of an impact with a force after it that was not confirmed before the flight was killed or left its plan.

    The logged forces pass through the flight's own detector again. None if a catch was confirmed, or no contact was measured.
    """
    if _confirmed_catch_index(log) is not None:
        return None
    detector = CatchDetector()
    for outputs in log.outputs:
        if outputs.phase_kind is PhaseKind.FLIGHT and outputs.control is not None:
            detector.update(outputs.t_s, outputs.control.force_ext_world_n)
    felt_s = detector.unconfirmed_s
    return None if felt_s is None else int(np.searchsorted(log.columns.t_s, felt_s))


def _confirmed_catch_index(log: FlightLog) -> int | None:
    for k, outputs in enumerate(log.outputs):
        for event in outputs.events:
            if event.id == "catch":
                return min(k, int(np.searchsorted(log.columns.t_s[: k + 1], event.t_s)))
    return None


def flight_masks(log: FlightLog) -> tuple[Mask, Mask]:
    """Return the ticks of kind FLIGHT before the catch, and from the catch on; without a catch the second is empty."""
    flight = np.array([o.phase_kind is PhaseKind.FLIGHT for o in log.outputs], dtype=np.bool_)
    caught = catch_index(log)
    after = np.arange(len(flight)) >= (len(flight) if caught is None else caught)
    return flight & ~after, flight & after


def position_error_m(log: FlightLog) -> Array:
    """Return motion capture minus reference, world frame, (ticks, 3).

    A frame shows the vehicle at its exposure, some milliseconds before the tick, and is compared with the reference of that moment.
    Otherwise a frame that is 10 ms old would count as an error of 5 mm at 0.5 m/s.
    """
    c = log.columns
    reference = c.reference_position_world_m - c.mocap_age_s[:, None] * c.reference_velocity_world_m_s
    return c.mocap_position_world_m - reference


def attitude_error_rad(log: FlightLog) -> Array:
    """Return roll, pitch, yaw by motion capture minus the law's desired attitude, wrapped, (ticks, 3)."""
    return _wrapped(log.columns.mocap_attitude_rad - log.columns.attitude_desired_rad)


def arm_error_rad(log: FlightLog) -> Array:
    """Return joint angles minus reference, (ticks, 2)."""
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
    """Return sqrt(mean ||row||^2) over rows without NaN, or None if there is none."""
    known = rows[np.isfinite(rows).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known * known, axis=1)))) if len(known) else None


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


def impedance_error(log: FlightLog) -> tuple[float | None, float | None]:
    """Return the RMS after the catch of ||dI|| on the position rows (N) and on the joint rows (N m). None for rows without a desired
    impedance, and for a log with ticks left out.

    dI = M_d e'' + K_d e' + K_p e - e_tau is the deviation from the desired impedance. Laws with a sliding variable s log the same as
    M_d s' + (K_d - M_d Phi) s. Derivatives are central differences, low-passed at 10 Hz without phase shift.
    """
    if log.stride > 1:
        return None, None  # derivatives need every tick
    pre, post = flight_masks(log)
    used = np.array([o.control is not None for o in log.outputs], dtype=np.bool_) & (pre | post)
    if not (used & post).any() or int(used.sum()) < 10:
        return None, None
    t_s = log.columns.t_s[used]
    if not (np.diff(t_s) > 0).all():
        return None, None
    d_i = _impedance_residual(log, used, t_s)
    if d_i is None:
        return None, None
    after = d_i[post[used]]
    return rms_norm(after[:, 0:3]), rms_norm(after[:, 6:8])


def _impedance_residual(log: FlightLog, used: Mask, t_s: Array) -> Array | None:
    """Return dI of the ticks of the mask, 8 rows; NaN on rows without an impedance."""
    controller = log.config.get("controller")
    period = float(np.median(np.diff(t_s)))

    def rows(name: str) -> Array:
        return log.column(lambda i, o, s: getattr(o.control, name) if o.control else None, 8)[used]

    def smooth(values: Array) -> Array:
        return lowpass_zero_phase(values, period, SLIDING_LOWPASS_HZ)

    gains = _diagonals(controller, "inertia_md", "damping_kd", "phi")
    if gains is not None:
        inertia, damping, phi = gains
        sliding = rows("sliding")
        if not np.isfinite(sliding).all():
            return None
        out: Array = inertia * np.gradient(smooth(sliding), t_s, axis=0) + (damping - inertia * phi) * sliding
        return out
    gains = _diagonals(controller, "inertia_md", "damping_kd", "stiffness_kp") or _arm_diagonals(controller)
    error, rate, e_tau = rows("error"), rows("error_rate"), rows("e_tau")
    if gains is None or not all(np.isfinite(values).all() for values in (error, rate, e_tau)):
        return None
    inertia, damping, stiffness = gains
    # e_tau is smoothed as e'' is, or a blow would be held against itself, smoothed.
    out = inertia * np.gradient(smooth(rate), t_s, axis=0) + damping * rate + stiffness * error - smooth(e_tau)
    return out


def lowpass_zero_phase(rows: Array, period_s: float, cutoff_hz: float) -> Array:
    """Filter with a second-order Butterworth forwards and backwards along axis 0 (gain 1/2 at the cutoff), odd reflection at
    the ends.
    """
    k = math.tan(math.pi * min(cutoff_hz * period_s, 0.49))
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    a1, a2 = 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm
    pad = min(len(rows) - 1, math.ceil(1.0 / (cutoff_hz * period_s)))
    head, tail = 2.0 * rows[0] - rows[pad:0:-1], 2.0 * rows[-1] - rows[-2 : -pad - 2 : -1]
    signal = np.concatenate([head, rows, tail])

    def once(x: Array) -> Array:
        out = np.empty_like(x)
        x1 = x2 = y1 = y2 = x[0]
        for n in range(len(x)):
            y = b0 * (x[n] + 2.0 * x1 + x2) - a1 * y1 - a2 * y2
            x2, x1, y2, y1 = x1, x[n], y1, y
            out[n] = y
        return out

    return once(once(signal)[::-1])[::-1][pad : pad + len(rows)]


def loop_rate_hz(log: FlightLog) -> float | None:
    """Return the mean rate of the ticks' actual starts, Hz."""
    timing = log.timing
    return (timing.last_tick - timing.first_tick) / timing.span_s if timing.span_s > 0 else None


def missed_deadlines(log: FlightLog) -> int:
    """Return the number of ticks that started more than one period late."""
    return int((log.timing.lateness_s > log.timing.period_s).sum())


def lateness(log: FlightLog) -> Percentiles | None:
    """Return the delay of the ticks' starts after their deadlines."""
    return percentiles(log.timing.lateness_s)


def percentiles(durations_s: Array) -> Percentiles | None:
    """Return p50, p99 and maximum in ms, or None for no values."""
    known = durations_s[np.isfinite(durations_s)]
    if not len(known):
        return None
    p50, p99 = np.percentile(known, [50, 99])
    return Percentiles(float(p50) * 1e3, float(p99) * 1e3, float(known.max()) * 1e3)


def slack_m(log: FlightLog) -> Array:
    """Return the tether length minus the distance from the anchor to the attachment point, by motion capture, for each tick.

    NaN on the ground and where it is not known.
    """
    slack = np.full(len(log.inputs), np.nan)
    tether = (log.config.get("vehicle") or {}).get("tether")
    if not isinstance(tether, dict) or not {"anchor_world_m", "length_m"} <= tether.keys():
        return slack
    anchor, offset = tether["anchor_world_m"], tuple(tether.get("attachment_body_m", (0.0, 0.0, 0.0)))
    known = np.isfinite(log.columns.mocap_position_world_m[:, 0])
    for k, (i, o, _) in enumerate(log.rows()):
        if o.phase_kind not in (PhaseKind.GROUND, PhaseKind.DONE) and known[k] and i.mocap is not None:
            arm = quat_rotate(i.mocap.attitude_wxyz, offset)
            point = [p + a for p, a in zip(i.mocap.position_world_m, arm, strict=True)]
            slack[k] = float(tether["length_m"]) - math.dist(point, anchor)
    return slack


def min_slack_m(log: FlightLog) -> float | None:
    """Return the least of `slack_m`; None if it is never known."""
    slack = slack_m(log)
    return float(np.nanmin(slack)) if np.isfinite(slack).any() else None


def _diagonals(controller: Any, *names: str) -> tuple[Array, ...] | None:
    """Return the diagonals of eight rows from the controller's configuration, or None if the law has no such gains."""
    if not isinstance(controller, dict):
        return None
    rows = [controller.get(name) for name in names]
    if not all(isinstance(row, list) and len(row) == 8 for row in rows):
        return None
    return tuple(np.array(row, dtype=np.float64) for row in rows)


def _arm_diagonals(controller: Any) -> tuple[Array, ...] | None:
    """Return M_d, K_d, K_p of a law whose arm alone has an impedance: NaN above the joint rows."""
    if not isinstance(controller, dict):
        return None
    rows = [controller.get(f"arm_{name}") for name in ("inertia_md", "damping_kd", "stiffness_kp")]
    if not all(isinstance(row, list) and len(row) == 2 for row in rows):
        return None
    return tuple(np.array([np.nan] * 6 + [float(value) for value in row or ()]) for row in rows)


def _wrapped(angles_rad: Array) -> Array:
    out: Array = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return out
