"""Response of PX4's attitude loop, and the delay of motion capture against PX4's attitude."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np

from companion.commissioning.identify.quantity import SIGMAS_95, Quantity, combined
from companion.commissioning.identify.response import Array, Fit, Piece, Prior, Spectrum, fit_response, long_run
from companion.commissioning.identify.samples import Flight
from companion.model.frames import quat_conjugate, quat_multiply
from companion.model.types import Quat, Vec3

AXES = ("roll", "pitch")
_ANGLE_GAIN_LN = Prior(math.log(6.5), 0.15)
"""Gain of the angle loop, 1/s (MC_ROLL_P, MC_PITCH_P)."""
_RATE_GAIN_LN = Prior(math.log(30.0), 0.4)
"""Gain of the rate loop: angular acceleration over rate error, 1/s."""
_ROTOR_LAG_LN = Prior(math.log(0.05), 0.25)
_DELAY = Prior(0.012, 0.008)
_INTEGRAL_1_S, _DERIVATIVE_S = 4.0 / 3.0, 0.02
"""Integral and derivative gains of PX4's rate loop over its proportional gain (defaults of MC_ROLLRATE_* and MC_PITCHRATE_*)."""
_DERIVATIVE_HZ = 30.0
_MEASURED_S = 0.005
"""Time from the gyroscope to the motor signal."""
_CUTOFF_HZ = 8.0
_SLOW_HZ = 1.0
"""Below it, the attitude also follows the arm's motion and gusts, which the position loop answers with setpoints."""
_LAG_SHARE = 0.05
_BANDWIDTH_SHARE = 0.09
"""Standard errors, relative, that no fit of one flight shows. The bandwidth follows the arm: folded and unfolded, it differs by 20 %
about roll and 10 % about pitch (docs/internals/identify.md), and a flight shows one mean of it.
"""
_MOVED_MIN_RAD = math.radians(0.3)
"""Smallest standard deviation of the setpoint that excites the loop."""
_LAG_SIGMA_MAX_S = 0.02
_SLOW_S = 0.4
"""Averaging time that separates the slow difference between motion capture and PX4: tilt, hidden markers."""
_RATE_OVER = 4
_DELAY_SIGMA_S = 0.0015
"""Standard error from the unknown age of PX4's attitude."""
_SERVER_SIGMA_S = 0.0005
_DELAY_SIGMA_MAX_S = 0.005
_RATE_MIN_RAD_S = math.radians(0.5)


def loop(flight: Flight, axis: int) -> tuple[Quantity, Quantity]:
    """Return lag and bandwidth of the attitude loop about body x (0) or y (1)."""
    name = AXES[axis]
    lag = Quantity(f"{name}_lag_s", f"{name}: lag of the attitude loop", "ms", 0, scale=1e3)
    bandwidth = Quantity(f"{name}_bandwidth_hz", f"{name}: bandwidth (-3 dB)", "Hz", 2)
    pieces = []
    for begin, end in flight.airborne:
        grid_s = flight.grid(begin, end)
        setpoint = flight.on_grid(grid_s, flight.t_s, flight.attitude_setpoint_rad[:, axis])
        attitude = flight.on_grid(grid_s, flight.attitude_stamp_s, flight.attitude_rad[:, axis])
        pieces.append(Piece(setpoint, attitude))
    moved = float(np.std(np.concatenate([piece.input - piece.input.mean() for piece in pieces])))
    if moved < _MOVED_MIN_RAD:
        how = f"the setpoint moved by {math.degrees(moved):.2f} deg (standard deviation); fly a circuit"
        return replace(lag, how=how), replace(bandwidth, how=how)
    fit = fit_response(
        pieces,
        _transfer,
        [np.array([prior.mean for prior in _PRIORS])],
        _PRIORS,
        (np.append(np.log([2.0, 5.0, 0.01]), 0.0), np.append(np.log([20.0, 200.0, 0.2]), 0.1)),
        cutoff_hz=_CUTOFF_HZ,
        slow_hz=_SLOW_HZ,
        order=8,
    )
    return _lag(fit, lag), _bandwidth(fit, bandwidth)


_PRIORS = (_ANGLE_GAIN_LN, _RATE_GAIN_LN, _ROTOR_LAG_LN, _DELAY)


def _transfer(p: Array, s: Spectrum) -> Spectrum:
    """Return the response of PX4's cascade. Parameters: logarithms of angle gain, rate gain and rotors' lag; the delay."""
    angle_1_s, rate_1_s, lag_s = np.exp(p[:3])
    rotors = rate_1_s * np.exp(-_MEASURED_S * s) / (1.0 + lag_s * s)
    forward = (s + _INTEGRAL_1_S) * rotors
    damping = _DERIVATIVE_S * s * s / (1.0 + s / (2.0 * math.pi * _DERIVATIVE_HZ)) * rotors
    rate = forward / (s * s + forward + damping)
    return np.asarray(np.exp(-p[3] * s) * angle_1_s * rate / (s + angle_1_s * rate), dtype=np.complex128)


def lag_s(p: Array) -> float:
    """Return the lag of the response to slow setpoints."""
    hertz = 0.25
    response = _transfer(p, np.array([2j * math.pi * hertz]))[0]
    return -cmath.phase(complex(response)) / (2.0 * math.pi * hertz)


def bandwidth_hz(p: Array) -> float:
    """Return the frequency at which the response has fallen to 1 / sqrt(2)."""
    hertz = np.linspace(0.3, 10.0, 500)
    size = np.abs(_transfer(p, np.asarray(2j * math.pi * hertz, dtype=np.complex128)))
    low = int(np.argmax(size < math.sqrt(0.5)))
    return float(np.interp(math.sqrt(0.5), size[[low, low - 1]], hertz[[low, low - 1]]))


def _lag(fit: Fit, lag: Quantity) -> Quantity:
    value, sigma = fit.of(lag_s)
    sigma = combined(sigma, _LAG_SHARE * value)
    if sigma > _LAG_SIGMA_MAX_S:
        return replace(lag, how=f"known only to ± {1e3 * SIGMAS_95 * sigma:.0f} ms; fly a circuit")
    angle_1_s, rate_1_s, rotors_s = np.exp(fit.parameters[:3])
    how = (
        f"setpoint to attitude: PX4's cascade with gains {angle_1_s:.1f} 1/s (angle) and {rate_1_s:.0f} 1/s (rate), "
        f"rotors {1e3 * rotors_s:.0f} ms, after {1e3 * fit.parameters[3]:.0f} ms"
    )
    return replace(lag, how=how, value=value, sigma=sigma, now="lab about 165 ms")


def _bandwidth(fit: Fit, bandwidth: Quantity) -> Quantity:
    value, sigma = fit.of(bandwidth_hz)
    sigma = combined(sigma, _BANDWIDTH_SHARE * value)
    if sigma > 0.15 * value:
        return replace(bandwidth, how=f"known only to ± {SIGMAS_95 * sigma:.1f} Hz; fly a circuit with faster turns")
    how = "of the same response, mean over the arm's poses in this flight"
    return replace(bandwidth, how=how, value=value, sigma=sigma)


def mocap_delay(flight: Flight) -> Quantity:
    """Return the delay from exposure to the arrival of a pose, against PX4's attitude, which the gyroscopes keep current.

    `companion latency` measures the same more precisely by taps, which move the vehicle faster than any flight. Here the difference
    between both attitudes is regressed on the body's rate: a late pose lags by rate times delay.
    """
    delay = Quantity("mocap_delay_s", "delay of motion capture", "ms", 1, scale=1e3)
    stamps, differences, rates = list[float](), list[Vec3](), list[Array]()
    number = None
    for begin, end in flight.airborne:
        attitude_s, attitude = flight.attitude_stamp_s[begin:end], np.unwrap(flight.attitude_rad[begin:end], axis=0)
        # Not the gyroscopes' rate, whose vibration would make the delay too small.
        rate_rad_s = _rate(attitude_s, attitude)
        for (i, _, _), stamp_s, rate in zip(flight.rows(begin, end), attitude_s, rate_rad_s, strict=True):
            pose, vehicle = i.mocap, i.vehicle
            if pose is None or vehicle is None or not pose.tracking_valid or pose.frame_number == number:
                continue
            number = pose.frame_number
            roll, pitch, _ = _small_angle(vehicle.attitude_wxyz, pose.attitude_wxyz)
            # The pose is compared with the attitude at the time of its own arrival.
            ahead_s = stamp_s - pose.stamp_s
            stamps.append(pose.stamp_s)
            rates.append(rate[:2])
            differences.append((roll + ahead_s * rate[0], pitch + ahead_s * rate[1], 0.0))
    if len(stamps) < 400:
        how = "PX4 got its poses from another program, or motion capture was lost; fly with motion capture"
        return replace(delay, how=how)
    width = max(3, round(_SLOW_S / float(np.median(np.diff(stamps)))))
    y, x = _without_mean(np.array(differences)[:, :2], width), _without_mean(np.array(rates), width)
    rate_rms = float(np.sqrt(np.mean(x**2)))
    power = float(np.sum(x * x))
    delay_s = -float(np.sum(x * y)) / power
    variance = float(np.trace(long_run(x * (y + delay_s * x), width))) / power**2
    sigma = combined(math.sqrt(max(0.0, variance)), _DELAY_SIGMA_S)
    if sigma > _DELAY_SIGMA_MAX_S or rate_rms < _RATE_MIN_RAD_S:
        how = f"the attitude moved by {math.degrees(rate_rms):.1f} deg/s (RMS); companion latency measures it by taps"
        return replace(delay, how=how)
    seen = f"lag of the poses behind PX4's attitude, {1e3 * delay_s:.1f} ± {1e3 * SIGMAS_95 * sigma:.1f} ms"
    latencies = [i.mocap.latency_s for i in flight.log.inputs if i.mocap is not None and i.mocap.latency_s is not None]
    if not latencies:
        return replace(delay, how=seen, value=delay_s, sigma=sigma, now="lab 5 ms")
    middle_s = float(np.median(latencies))
    spread_s = 1.4826 * float(np.median(np.abs(np.array(latencies) - middle_s)))
    how = f"the server's stamps, without the network; {seen}"
    return replace(delay, how=how, value=middle_s, sigma=combined(spread_s, _SERVER_SIGMA_S), now="lab 5 ms")


def _rate(t_s: Array, attitude_rad: Array) -> Array:
    """Return the rates of roll, pitch and yaw, rad/s, from differences over `_RATE_OVER` ticks to both sides."""
    ahead = np.minimum(np.arange(len(t_s)) + _RATE_OVER, len(t_s) - 1)
    behind = np.maximum(np.arange(len(t_s)) - _RATE_OVER, 0)
    since_s = np.maximum(t_s[ahead] - t_s[behind], 1e-3)
    return np.asarray((attitude_rad[ahead] - attitude_rad[behind]) / since_s[:, None], dtype=np.float64)


def _small_angle(a: Quat, b: Quat) -> tuple[float, float, float]:
    """Return the rotation from attitude a to attitude b, which is small, in a's axes, rad."""
    w, x, y, z = quat_multiply(quat_conjugate(a), b)
    k = 2.0 if w >= 0.0 else -2.0
    return k * x, k * y, k * z


def _without_mean(values: Array, width: int) -> Array:
    kernel = np.ones(width) / width
    mean = np.stack([np.convolve(values[:, axis], kernel, mode="same") for axis in range(values.shape[1])], axis=1)
    return np.asarray((values - mean)[width:-width], dtype=np.float64)
