"""Numbers that grade a flight; pure functions of a `FlightLog`. Position and attitude are graded by mocap, never by the estimator."""

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
    """Of durations, in ms."""

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
    """Tick (position in the log) of the catch: the one at the time of the first event "catch".

    A detector needs some time to be sure; it may date its event back to the contact, so that the kick counts as after the catch.
    Without such an event it is the tick of an unconfirmed catch (`unconfirmed_catch_index`). None if nothing was felt.
    """
    confirmed = _confirmed_catch_index(log)
    return confirmed if confirmed is not None else unconfirmed_catch_index(log)


def unconfirmed_catch_index(log: FlightLog) -> int | None:
    """Tick of a blow with a pull after it that the flight was not given the time to confirm: it was killed, or left its course.

    The forces in the log go through the flight's own detector once more. None if a catch was confirmed, or none was felt.
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
    """Ticks of kind FLIGHT before the catch, and from the catch on; without a catch the second is empty."""
    flight = np.array([o.phase_kind is PhaseKind.FLIGHT for o in log.outputs], dtype=np.bool_)
    caught = catch_index(log)
    after = np.arange(len(flight)) >= (len(flight) if caught is None else caught)
    return flight & ~after, flight & after


def position_error_m(log: FlightLog) -> Array:
    """Mocap minus reference, world, (ticks, 3).

    A frame shows where the vehicle was at its exposure, some milliseconds before the tick: it is held against the reference of that
    moment. At 0.5 m/s a frame that is 10 ms old would else be an error of 5 mm that nobody made.
    """
    c = log.columns
    reference = c.reference_position_world_m - c.mocap_age_s[:, None] * c.reference_velocity_world_m_s
    return c.mocap_position_world_m - reference


def attitude_error_rad(log: FlightLog) -> Array:
    """Mocap roll, pitch, yaw minus the law's desired attitude, wrapped, (ticks, 3)."""
    return _wrapped(log.columns.mocap_attitude_rad - log.columns.attitude_desired_rad)


def arm_error_rad(log: FlightLog) -> Array:
    """Joint angles minus reference, (ticks, 2)."""
    return log.columns.arm_rad - log.columns.arm_reference_rad


def tracking_rms(log: FlightLog, mask: Mask) -> TrackingRms:
    """RMS of ||e_p||, ||e_q||, ||e_alpha|| over the ticks of the mask."""
    e_q, e_alpha = rms_norm(attitude_error_rad(log)[mask]), rms_norm(arm_error_rad(log)[mask])
    return TrackingRms(
        rms_norm(position_error_m(log)[mask]),
        None if e_q is None else math.degrees(e_q),
        None if e_alpha is None else math.degrees(e_alpha),
    )


def rms_norm(rows: Array) -> float | None:
    """sqrt(mean ||row||^2) over rows that are known throughout; None if there is none."""
    known = rows[np.isfinite(rows).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known * known, axis=1)))) if len(known) else None


def final_e_z_m(log: FlightLog) -> float | None:
    """Mean height error over the last 0.5 s of FLIGHT."""
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
    """RMS after the catch of ||dI|| on the position rows (N) and on the joint rows (N m); None for rows without a desired impedance,
    and of a log that was thinned out.

    dI = M_d e'' + K_d e' + K_p e - e_tau: what keeps the machine from its desired impedance. Laws with a sliding variable s log the
    same as M_d s' + (K_d - M_d Phi) s. Derivatives are central differences, low-passed at 10 Hz without phase shift.
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
    """dI of the ticks of the mask, 8 rows; NaN on rows that the law gives no impedance."""
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
    """Second-order Butterworth forwards and backwards along axis 0 (gain 1/2 at the cutoff), odd reflection at the ends."""
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
    """Mean rate of ticks as they really started."""
    timing = log.timing
    return (timing.last_tick - timing.first_tick) / timing.span_s if timing.span_s > 0 else None


def missed_deadlines(log: FlightLog) -> int:
    """Ticks that started later than one whole period."""
    return int((log.timing.lateness_s > log.timing.period_s).sum())


def lateness(log: FlightLog) -> Percentiles | None:
    """Tick start after its deadline."""
    return percentiles(log.timing.lateness_s)


def percentiles(durations_s: Array) -> Percentiles | None:
    """p50, p99 and maximum in ms; None if there are none."""
    known = durations_s[np.isfinite(durations_s)]
    if not len(known):
        return None
    p50, p99 = np.percentile(known, [50, 99])
    return Percentiles(float(p50) * 1e3, float(p99) * 1e3, float(known.max()) * 1e3)


def min_slack_m(log: FlightLog) -> float | None:
    """Least of tether length minus distance from the anchor to the attachment point, between take-off and touchdown, by mocap."""
    tether = (log.config.get("vehicle") or {}).get("tether")
    if not isinstance(tether, dict) or not {"anchor_world_m", "length_m"} <= tether.keys():
        return None
    anchor, offset = tether["anchor_world_m"], tuple(tether.get("attachment_body_m", (0.0, 0.0, 0.0)))
    least: float | None = None
    known = np.isfinite(log.columns.mocap_position_world_m[:, 0])
    for k, (i, o, _) in enumerate(log.rows()):
        if o.phase_kind in (PhaseKind.GROUND, PhaseKind.DONE) or not known[k] or i.mocap is None:
            continue
        arm = quat_rotate(i.mocap.attitude_wxyz, offset)
        point = [p + a for p, a in zip(i.mocap.position_world_m, arm, strict=True)]
        slack = float(tether["length_m"]) - math.dist(point, anchor)
        least = slack if least is None else min(least, slack)
    return least


def _diagonals(controller: Any, *names: str) -> tuple[Array, ...] | None:
    """Diagonals of eight rows from the controller's configuration; None if the law has no such gains."""
    if not isinstance(controller, dict):
        return None
    rows = [controller.get(name) for name in names]
    if not all(isinstance(row, list) and len(row) == 8 for row in rows):
        return None
    return tuple(np.array(row, dtype=np.float64) for row in rows)


def _arm_diagonals(controller: Any) -> tuple[Array, ...] | None:
    """M_d, K_d, K_p of a law whose arm alone has an impedance: NaN above the joint rows."""
    if not isinstance(controller, dict):
        return None
    rows = [controller.get(f"arm_{name}") for name in ("inertia_md", "damping_kd", "stiffness_kp")]
    if not all(isinstance(row, list) and len(row) == 2 for row in rows):
        return None
    return tuple(np.array([np.nan] * 6 + [float(value) for value in row or ()]) for row in rows)


def _wrapped(angles_rad: Array) -> Array:
    out: Array = (angles_rad + np.pi) % (2.0 * np.pi) - np.pi
    return out
