"""The speed of a vehicle along its path, where it stops, and how it moves laterally in its lane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtri

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.options import checked

__all__ = ["DriverModel", "Journey", "drive_along", "lane_wander"]

_CRAWL = 0.8  # m/s; the slowest that a moving vehicle goes, so that time stays finite at a stop


@dataclass(frozen=True)
@checked
class DriverModel:
    """How drivers choose speeds, stops and their position in the lane."""

    speed_bias: Positive[float] = 1.0  # chosen speed over the limit, median over drivers
    speed_spread: NotNegative[float] = 0.08  # between drivers, standard deviation of the logarithm
    flow_spread: NotNegative[float] = 0.12  # along the road, standard deviation of the logarithm
    flow_length: Positive[float] = 2000.0  # m over which the flow of traffic changes
    jam_share: Share = 0.05  # of the road that is congested
    jam_speed: Positive[float] = 0.35  # speed there over the free speed
    lateral_acceleration: Positive[float] = 2.5  # m/s2 accepted in curves
    acceleration: Positive[float] = 1.3  # m/s2
    deceleration: Positive[float] = 1.8  # m/s2
    yield_stop: Share = 0.7  # probability of a stop where the vehicle gives way
    yield_wait: NotNegative[float] = 4.0  # s, mean of the exponential wait there
    signal_stop: Share = 0.25  # probability of a stop at another junction at grade
    signal_wait: NotNegative[float] = 18.0  # s, mean of the exponential wait there
    lane_bias: NotNegative[float] = 0.36  # m, between vehicles: standard deviation of the place held in the lane
    wander_sigma: NotNegative[float] = 0.22  # m, of the slow weaving of one vehicle
    wander_rate: Positive[float] = 0.85  # 1/s, of the critically damped process that weaves
    lane_change_time: Positive[float] = 6.3  # s, mean
    lane_change_spread: NotNegative[float] = 2.0  # s, standard deviation
    preference_length: Positive[float] = 3000.0  # m over which a driver's preferred lane lasts


@dataclass(frozen=True)
class Journey:
    """The times at which a vehicle passes the samples of its path."""

    time: NDArray[np.float64]  # (n,) s since departure, when the vehicle leaves the sample
    wait: NDArray[np.float64]  # (n,) s that it has stood there before
    speed: NDArray[np.float64]  # (n,) m/s


def drive_along(
    curvature: NDArray[np.float64],
    limit: NDArray[np.float64],
    wait: NDArray[np.float64],
    model: DriverModel,
    *,
    spacing: float,
    rng: np.random.Generator,
) -> Journey:
    """Drive a vehicle along a path, and return when it passes each sample.

    Parameters
    ----------
    curvature
        Of the path (1/m), shape ``(n,)``.
    limit
        Speed limit (m/s), shape ``(n,)``.
    wait
        Seconds to stand at each sample, 0 where the vehicle does not stop, shape ``(n,)``.
    model
        The driver.
    spacing
        Metres between samples.
    rng
        Draws the driver's speed and the traffic flow.

    Examples
    --------
    >>> straight = np.zeros(1000)
    >>> steady = DriverModel(speed_spread=0.0, flow_spread=0.0, jam_share=0.0)
    >>> rng = np.random.default_rng(1)
    >>> journey = drive_along(straight, np.full(1000, 25.0), straight, steady, spacing=1.0, rng=rng)
    >>> float(journey.speed.max()), bool((np.diff(journey.time) > 0).all())
    (25.0, True)
    """
    n = len(limit)
    own = model.speed_bias * np.exp(model.speed_spread * rng.standard_normal())
    flow = np.exp(model.flow_spread * _process(n, spacing / model.flow_length, rng))
    jammed = _process(n, spacing / model.flow_length, rng) > ndtri(1.0 - model.jam_share)
    free = limit * own * flow * np.where(jammed, model.jam_speed, 1.0)
    curved = np.sqrt(model.lateral_acceleration / np.maximum(np.abs(curvature), 1e-6))
    ceiling = np.maximum(np.minimum(free, curved), _CRAWL)
    ceiling[wait > 0] = _CRAWL
    speed = _feasible(ceiling, model.acceleration, model.deceleration, spacing)
    between = spacing / np.maximum((speed[1:] + speed[:-1]) / 2.0, _CRAWL)
    time = np.cumsum(np.concatenate([[0.0], between]) + wait)
    return Journey(time, wait, speed)


def lane_wander(steps: NDArray[np.float64], model: DriverModel, *, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a vehicle's lateral offsets from the middle of its lane.

    A constant of the vehicle plus a critically damped second-order process, whose position and lateral speed are
    both continuous: vehicles weave, they do not jitter.

    Parameters
    ----------
    steps
        Seconds since the pose before, shape ``(n,)``; the first is ignored.
    model
        The driver.
    rng
        Source of randomness.

    Returns
    -------
    ndarray, shape (n,)
        Metres, positive to the right.
    """
    held = np.clip(model.lane_bias * rng.standard_normal(), -2 * model.lane_bias, 2 * model.lane_bias)
    weave = _second_order(steps, model.wander_rate, rng.standard_normal((len(steps), 2)))
    return held + model.wander_sigma * weave


def _process(n: int, step: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a unit Gauss-Markov process along the path, coarsely sampled and interpolated because it changes slowly."""
    stride = max(int(0.02 / step), 1)
    coarse = rng.standard_normal(n // stride + 2)
    decay = np.exp(-stride * step)
    coarse[1:] *= np.sqrt(1.0 - decay * decay)
    return np.interp(np.arange(n), stride * np.arange(len(coarse)), _first_order(coarse, decay))


@njit(cache=True)
def _first_order(values: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    """Filter new white noise by a first-order recursion."""
    out = values.copy()
    for i in range(1, len(out)):
        out[i] += decay * out[i - 1]
    return out


@njit(cache=True)
def _feasible(
    ceiling: NDArray[np.float64], acceleration: float, deceleration: float, spacing: float
) -> NDArray[np.float64]:
    """Lower a speed limit along the path until the vehicle can accelerate and brake to follow it."""
    speed = ceiling.copy()
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 2.0 * acceleration * spacing))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2.0 * deceleration * spacing))
    return speed


@njit(cache=True)
def _second_order(steps: NDArray[np.float64], rate: float, normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Draw a unit critically damped process: autocorrelation ``(1 + rate * lag) * exp(-rate * lag)``.

    The exact transition of the state (position, velocity) over each step; its covariance is what is missing from the
    stationary one, diag(1, rate^2).
    """
    out = np.zeros(len(steps))
    x, v = 0.0, 0.0
    for i in range(len(steps)):
        h = steps[i] if i > 0 else 1e9
        decay = np.exp(-rate * h)
        a, b = (1.0 + rate * h) * decay, h * decay
        c, d = -rate * rate * h * decay, (1.0 - rate * h) * decay
        qxx = max(1.0 - a * a - b * b * rate * rate, 0.0)
        qxv = -(a * c + b * d * rate * rate)
        qvv = max(rate * rate - c * c - d * d * rate * rate, 0.0)
        root = np.sqrt(qxx)
        slope = qxv / root if root > 1e-12 else 0.0
        x, v = (
            a * x + b * v + root * normal[i, 0],
            c * x + d * v + slope * normal[i, 0] + np.sqrt(max(qvv - slope * slope, 0.0)) * normal[i, 1],
        )
        out[i] = x
    return out
