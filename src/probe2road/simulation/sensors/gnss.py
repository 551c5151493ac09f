"""Errors of a GNSS receiver along a drive: correlated in time, heavy-tailed, larger where the sky is hidden.

Strategy
--------
The error of one axis is a sum of Gauss-Markov processes (orbit, clock, atmosphere and the receiver's own filter change
slowly), white noise, and multipath bursts. A burst begins at random, at a rate that the surroundings set, and lasts
for a random time; while it does, an error vector of its own Gauss-Markov and white parts is added, with a scale drawn
anew for each burst from a log-normal distribution. Few bursts are large, and those make the tail that urban recordings
show. Every recursion is exact for uneven time steps, so that fixes may be any interval apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from probe2road.bounds import NotNegative, Positive
from probe2road.options import checked

__all__ = ["GnssErrors", "GnssModel", "gnss_errors"]

_VERTICAL = 2  # index of the up axis
_AWARENESS = 0.5  # share of a burst, on a logarithmic scale, that the receiver notices; chosen


@dataclass(frozen=True)
@checked
class GnssModel:
    """Error statistics of a single-point GNSS solution, the same for both horizontal axes."""

    slow_sigma: NotNegative[float]  # m, of the slow Gauss-Markov process
    slow_time: Positive[float]  # s, its time constant
    fast_sigma: NotNegative[float]  # m, of the fast Gauss-Markov process
    fast_time: Positive[float]  # s
    white_sigma: NotNegative[float]  # m, from fix to fix
    burst_rate: NotNegative[float]  # bursts a second where the exposure is 1
    burst_duration: Positive[float]  # s, mean (exponential)
    burst_median: NotNegative[float]  # m, median of the log-normal scale of a burst
    burst_spread: NotNegative[float]  # standard deviation of the natural logarithm of that scale
    burst_time: Positive[float]  # s, time constant of the error inside a burst
    burst_white: NotNegative[float]  # white part of the error inside a burst, as a share of its scale
    vertical_ratio: NotNegative[float]  # vertical error over the error of one horizontal axis, outside bursts
    burst_vertical_ratio: NotNegative[float]  # and inside


@dataclass(frozen=True)
class GnssErrors:
    """The errors of n fixes."""

    error: NDArray[np.float64]  # (n, 3): east, north, up, m
    sigma: NDArray[np.float64]  # (n,): what the receiver believes of a horizontal axis, m
    blocked: NDArray[np.bool_]  # (n,): inside a multipath burst


def gnss_errors(t: ArrayLike, model: GnssModel, *, rng: np.random.Generator, exposure: ArrayLike = 1.0) -> GnssErrors:
    """Draw the errors of one receiver at the given times.

    Parameters
    ----------
    t
        Times in seconds, ascending, shape ``(n,)``; may be empty.
    model
        The statistics.
    rng
        Source of randomness.
    exposure
        Factor on the burst rate at each fix, shape ``(n,)`` or one for all; 0 is open sky.

    Returns
    -------
    GnssErrors
        The processes start in their stationary distribution, so every drive has a bias from its first fix.

    Examples
    --------
    >>> model = GnssModel(1.0, 60.0, 0.3, 5.0, 0.1, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 1.5, 1.5)
    >>> errors = gnss_errors(np.arange(20000.0), model, rng=np.random.default_rng(1))
    >>> errors.error.shape, bool(errors.blocked.any()), float(errors.sigma[0].round(3))
    ((20000, 3), False, 1.049)
    >>> gnss_errors([], model, rng=np.random.default_rng(1)).error.shape
    (0, 3)
    """
    times = np.asarray(t, np.float64)
    rate = model.burst_rate * np.broadcast_to(np.asarray(exposure, np.float64), times.shape)
    steps = np.diff(times, prepend=times[:1])
    n = len(times)
    blocked, scale = _bursts(steps, rate, model.burst_duration, model.burst_median, model.burst_spread, rng)
    base = model.slow_sigma * _gauss_markov(steps, model.slow_time, rng.standard_normal((n, 3)))
    base += model.fast_sigma * _gauss_markov(steps, model.fast_time, rng.standard_normal((n, 3)))
    base += model.white_sigma * rng.standard_normal((n, 3))
    base[:, _VERTICAL] *= model.vertical_ratio
    burst = _gauss_markov(steps, model.burst_time, rng.standard_normal((n, 3)))
    burst = np.sqrt(1.0 - _share(model) ** 2) * burst + _share(model) * rng.standard_normal((n, 3))
    burst[:, _VERTICAL] *= model.burst_vertical_ratio
    calm = np.sqrt(model.slow_sigma**2 + model.fast_sigma**2 + model.white_sigma**2)
    sigma = calm * (1.0 + (scale / calm) ** 2) ** (_AWARENESS / 2.0)
    return GnssErrors(base + scale[:, None] * burst, sigma, blocked)


def _share(model: GnssModel) -> float:
    """Return the white share of the error in a burst, at most 1."""
    return min(model.burst_white, 1.0)


@njit(cache=True)
def _gauss_markov(steps: NDArray[np.float64], time_constant: float, normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit Gauss-Markov processes with the given time steps (s), made from white normal numbers ``(n, k)``."""
    out = normal.copy()
    for i in range(1, len(out)):
        decay = np.exp(-steps[i] / time_constant)
        fresh = np.sqrt(1.0 - decay * decay)
        for axis in range(out.shape[1]):
            out[i, axis] = decay * out[i - 1, axis] + fresh * normal[i, axis]
    return out


@njit(cache=True)
def _bursts(
    steps: NDArray[np.float64],
    rate: NDArray[np.float64],
    duration: float,
    median: float,
    spread: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Draw the bursts: whether each fix is inside one, and the scale of the burst (m, 0 outside).

    A two-state Markov chain in continuous time: bursts begin at ``rate`` and end at ``1 / duration``. Over one
    step the probability of being inside at its end is exact for the step's rate.
    """
    n = len(steps)
    inside = np.zeros(n, np.bool_)
    scale = np.zeros(n)
    active = False
    current = 0.0
    for i in range(n):
        leave = 1.0 / duration
        total = rate[i] + leave
        share = rate[i] / total
        fade = np.exp(-total * steps[i]) if i > 0 else 0.0
        chance = share + ((1.0 - share) if active else -share) * fade
        still = active and rng.random() < np.exp(-leave * steps[i])
        if not still:
            # Given that the old burst has ended, another may have begun within the step.
            survived = np.exp(-leave * steps[i]) if (active and i > 0) else 0.0
            begun = (chance - survived) / max(1.0 - survived, 1e-12)
            active = rng.random() < begun
            if active:
                current = median * np.exp(spread * rng.standard_normal())
        inside[i] = active
        scale[i] = current if active else 0.0
    return inside, scale
