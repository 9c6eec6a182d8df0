"""Output-error fit of a linear response with coloured residuals. Pure functions.

The parameters are those for which the simulated response agrees best with the measured one. Gusts and the feedback of the position
loop make the residuals coloured, which would bias the parameters and make a plain covariance several times too small. The fit is
therefore repeated with input and output filtered by the whitening filter of the last residuals (generalised least squares), and the
covariance is that of Newey and West.

Responses are computed from the spectrum of the input, up to the frequency at which they are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Spectrum = npt.NDArray[np.complex128]
STEP_S = 0.005
"""Period of the uniform grid of inputs and outputs."""
_PAD_S = 2.0
"""Time after the end of a piece in which the input fades out, so that its end does not act on its beginning."""
_EDGE_S = 0.2
"""Time at both ends of a piece that the low-pass disturbs."""
_ITERATIONS = 4


@dataclass(frozen=True)
class Piece:
    """Input and output of one uninterrupted part of a flight on the grid."""

    input: Array
    output: Array


@dataclass(frozen=True)
class Prior:
    """What is known of a number before the flight."""

    mean: float
    sigma: float


Transfer = Callable[[Array, Spectrum], Spectrum]
"""Returns the transfer function of the response for its parameters at these values of s = j omega."""


@dataclass(frozen=True)
class Fit:
    """Result of a fit."""

    parameters: Array
    covariance: Array

    def of(self, value: Callable[[Array], float]) -> tuple[float, float]:
        """Return a function of the parameters and its standard error."""
        small = 1e-5
        centre = value(self.parameters)
        shifted = self.parameters + small * np.eye(len(self.parameters))
        gradient = np.array([(value(row) - centre) / small for row in shifted])
        return centre, math.sqrt(max(0.0, float(gradient @ self.covariance @ gradient)))


class _Low:
    """A piece below the cutoff frequency, at a lower rate."""

    def __init__(self, piece: Piece, cutoff_hz: float, slow_hz: float) -> None:
        every = max(1, int(1.0 / (3.0 * cutoff_hz * STEP_S)))
        edge = math.ceil(_EDGE_S / (every * STEP_S))
        count = len(piece.input)
        self._padded = every * math.ceil((count + _PAD_S / STEP_S) / every)
        self._few = self._padded // every
        self._kept = slice(edge, count // every - edge)
        hertz = np.fft.rfftfreq(self._padded, STEP_S)[: self._few // 2 + 1]
        self.s = np.asarray(2j * np.pi * hertz, dtype=np.complex128)
        self._weight = 1.0 / (1.0 + (hertz / cutoff_hz) ** 8) * self._few / self._padded
        self._begin = float(piece.input[0])
        self._input = self._spectrum(piece.input - self._begin)
        self._output_begin = float(piece.output[0])
        self.output = self._values(self._spectrum(piece.output - self._output_begin)) + self._output_begin
        half_turns = np.pi * (np.arange(len(self.output)) + 0.5) / len(self.output)
        cosines = np.arange(1 + int(2.0 * slow_hz * every * STEP_S * len(self.output)))
        self.slow = np.column_stack([half_turns, np.cos(np.outer(half_turns, cosines))])
        """Columns of a drift, an offset and the cosines up to `slow_hz`."""

    def response(self, transfer: Spectrum) -> Array:
        """Return the response to the input."""
        return self._values(self._input * transfer) + self._begin * float(transfer[0].real)

    def _spectrum(self, values: Array) -> Spectrum:
        fade = 0.5 + 0.5 * np.cos(np.linspace(0.0, np.pi, self._padded - len(values)))
        return np.fft.rfft(np.concatenate([values, values[-1] * fade]))[: self._few // 2 + 1]

    def _values(self, spectrum: Spectrum) -> Array:
        return np.asarray(np.fft.irfft(spectrum * self._weight, self._few)[self._kept], dtype=np.float64)


def fit_response(
    pieces: Sequence[Piece],
    transfer: Transfer,
    starts: Sequence[Array],
    priors: Sequence[Prior],
    bounds: tuple[Array, Array],
    cutoff_hz: float,
    slow_hz: float,
    order: int,
    gain: Prior | None = None,
) -> Fit:
    """Fit the parameters of a response.

    Args:
        starts: first guesses; the best result counts, because the cost may have several minima.
        priors: one for each parameter.
        bounds: lower and upper bounds of the parameters.
        cutoff_hz: frequency up to which the response is compared.
        slow_hz: frequency below which each piece has a disturbance of its own, which is fitted, too: the position loop answers slow
            disturbances with setpoints, and these would pass for their cause.
        order: order of the autoregressive model of the residuals.
        gain: prior of a factor of the response, which each piece has for itself; None if the factor is 1.
    """
    from scipy.optimize import least_squares  # the import takes half a second

    low = [_Low(piece, cutoff_hz, slow_hz) for piece in pieces]
    white = np.ones(1)
    noise = float(np.std(np.concatenate([one.output - one.output.mean() for one in low])))

    def evaluate(parameters: Array) -> tuple[Array, list[Array]]:
        residuals, raw = list[Array](), list[Array]()
        for one in low:
            response = one.response(transfer(parameters, one.s))
            columns, wanted = one.slow, one.output
            if gain is None:
                wanted = wanted - response
            else:
                columns = np.column_stack([response, columns])
            a, b = _filtered(white, columns), _filtered(white, wanted)
            if gain is not None:
                row = np.zeros(a.shape[1])
                row[0] = noise / gain.sigma
                a, b = np.vstack([a, row]), np.append(b, row[0] * gain.mean)
            factors = np.linalg.lstsq(a, b, rcond=None)[0]
            residuals.append(b - a @ factors)
            raw.append(wanted - columns @ factors)
        prior = [noise * (p - one.mean) / one.sigma for p, one in zip(parameters, priors, strict=True)]
        return np.concatenate([*residuals, prior]), raw

    def refined(start: Array) -> tuple[float, Array, Array]:
        found = least_squares(lambda p: evaluate(p)[0], start, bounds=bounds, x_scale=[one.sigma for one in priors])
        return float(found.cost), found.x, found.jac

    tried: Sequence[Array] = starts
    for _ in range(_ITERATIONS):
        _, best, jacobian = min((refined(start) for start in tried), key=lambda one: one[0])
        residual, raw = evaluate(best)
        covariance = _newey_west(jacobian, residual, 2 * order)
        white, noise = _whitening(raw, order)
        tried = [best]
    return Fit(best, covariance)


def _filtered(white: Array, values: Array) -> Array:
    """Return the values after the whitening filter, without its transient."""
    return np.asarray(np.apply_along_axis(np.convolve, 0, values, white, "valid"), dtype=np.float64)


def _whitening(residuals: Sequence[Array], order: int) -> tuple[Array, float]:
    """Return the filter that makes the residuals white, and the standard deviation of what is left."""
    rows = np.concatenate(
        [np.stack([r[order - 1 - k : len(r) - 1 - k] for k in range(order)], axis=1) for r in residuals]
    )
    values = np.concatenate([r[order:] for r in residuals])
    factors = np.linalg.lstsq(rows, values, rcond=None)[0]
    return np.concatenate([[1.0], -factors]), float(np.std(values - rows @ factors))


def _newey_west(jacobian: Array, residual: Array, lags: int) -> Array:
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    return np.asarray(inverse @ long_run(jacobian * residual[:, None], lags) @ inverse, dtype=np.float64)


def long_run(scores: Array, lags: int) -> Array:
    """Return the covariance of the sum of correlated rows (Newey and West, Bartlett's weights)."""
    total = scores.T @ scores
    for lag in range(1, min(lags, len(scores) - 1) + 1):
        cross = scores[lag:].T @ scores[:-lag]
        total = total + (1.0 - lag / (lags + 1.0)) * (cross + cross.T)
    return np.asarray(total, dtype=np.float64)
