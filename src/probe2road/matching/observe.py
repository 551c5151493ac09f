"""The observations of the matching model: key fixes, times, courses, spreads, and altitudes relative to the graph."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet
from probe2road.matching.candidates import altitude_at, nearest_points, new_scratch
from probe2road.matching.models import RouteModel
from probe2road.matching.network import States
from probe2road.matching.viterbi import Observations

__all__ = ["observe", "sampling_interval", "seconds"]

_CLOCKLESS_SPEED = 15.0  # m/s, to estimate times of traces without a clock
_SLOW = 2.0  # m/s, below which a receiver's heading is noise
_AGREE = 2.0  # m, range of the altitudes of all roads near a fix, below which they show the bias of the trace
_BIAS_REACH = 30  # key fixes on either side, over which the median of the bias is taken


def seconds(fleet: Fleet) -> NDArray[np.float64]:
    """Return the times of the fixes in seconds, estimated from the driven distance for a trace without a clock."""
    time = fleet.traces["t"].to_numpy(dtype="datetime64[ns]")
    known = ~np.isnat(time)
    origin = time[known].min() if known.any() else np.datetime64(0, "ns")
    value = (time - origin) / np.timedelta64(1, "s")
    step = np.hypot(*(np.diff(fleet.traces[axis].to_numpy(), prepend=0.0) for axis in "xy"))
    return np.asarray(np.where(known, value, np.cumsum(step) / _CLOCKLESS_SPEED), np.float64)


def sampling_interval(t: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the median time between the fixes of every trace, s; 0 for a trace with only one fix.

    Examples
    --------
    >>> sampling_interval(np.array([0.0, 1, 2, 0, 30, 9]), np.array([0, 3, 5, 6])).tolist()
    [1.0, 30.0, 0.0]
    """
    step = np.diff(t)
    return np.array([np.median(step[low : high - 1]) if high - low > 1 else 0.0 for low, high in pairwise(starts)])


def observe(fleet: Fleet, t: NDArray[np.float64], states: States, model: RouteModel) -> Observations:
    """Compute the observations of a model from the fixes of a fleet.

    The course of a fix is its ``heading`` where the column has one and the vehicle moves, else the direction
    from the key fix before to the key fix after. ``accuracy`` widens the spread and never narrows it below the
    model's. Altitudes are used where both the trace and the graph have them.
    """
    traces, starts = fleet.traces, fleet.starts
    x, y = (np.ascontiguousarray(traces[axis].to_numpy(np.float64)) for axis in "xy")
    key = _key_fixes(x, y, starts, model.spacing)
    course_x, course_y, kappa = _courses(x, y, t, starts, key, model)
    if "heading" in traces:
        heading = np.radians(traces["heading"].to_numpy(np.float64, na_value=np.nan))
        known = np.isfinite(heading)
        if "speed" in traces:
            known &= ~(traces["speed"].to_numpy(np.float64, na_value=np.nan) < _SLOW)
        course_x, course_y = np.where(known, np.sin(heading), course_x), np.where(known, np.cos(heading), course_y)
        kappa = np.where(known, model.heading_weight, kappa)
    sigma = np.full(len(x), model.sigma)
    if "accuracy" in traces:
        sigma = np.fmax(sigma, traces["accuracy"].to_numpy(np.float64, na_value=np.nan))
    z = np.ascontiguousarray(traces["z"].to_numpy(np.float64, na_value=np.nan))
    if np.isfinite(z).any() and np.isfinite(states.z).any():
        z = z - _vertical_bias(states, x, y, z, starts, key, model.radius)
    else:
        z = np.full(len(x), np.nan)
    return Observations(x, y, t, sigma, course_x, course_y, kappa, z, key)


@njit(cache=True)
def _key_fixes(
    x: NDArray[np.float64], y: NDArray[np.float64], starts: NDArray[np.int64], spacing: float
) -> NDArray[np.bool_]:
    """Mark the first and last fix of every trace, and fixes at least the spacing away from the last marked fix."""
    key = np.zeros(len(x), np.bool_)
    for trace in range(len(starts) - 1):
        last = -1
        for i in range(starts[trace], starts[trace + 1]):
            if last < 0 or np.hypot(x[i] - x[last], y[i] - y[last]) >= spacing:
                key[i] = True
                last = i
        if last >= 0 and starts[trace + 1] - 1 > last:
            i = starts[trace + 1] - 1
            key[i] = x[i] != x[last] or y[i] != y[last]
    return key


def _courses(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    t: NDArray[np.float64],
    starts: NDArray[np.int64],
    key: NDArray[np.bool_],
    model: RouteModel,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the direction from the key fix before to the key fix after, and its weight; shape (fixes,) each.

    A fix without a key fix before, or none soon enough, uses itself. The weight grows with the distance
    covered, because noise turns short chords most.
    """
    course_x, course_y, kappa = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    rows = np.flatnonzero(key)
    if model.course_weight == 0 or len(rows) < 2:
        return course_x, course_y, kappa
    trace = np.searchsorted(starts, rows, side="right")
    joined = (np.diff(trace) == 0) & (np.diff(t[rows]) <= model.course_interval)
    ahead, behind = np.append(joined, False), np.append(False, joined)
    place = np.arange(len(rows))
    after, before = rows[place + ahead], rows[place - behind]
    dx, dy = x[after] - x[before], y[after] - y[before]
    size = np.hypot(dx, dy)
    moving = size > 0
    course_x[rows[moving]], course_y[rows[moving]] = dx[moving] / size[moving], dy[moving] / size[moving]
    kappa[rows] = model.course_weight * np.minimum(size / (4.0 * model.sigma), 1.0)
    return course_x, course_y, kappa


@njit(cache=True)
def _vertical_bias(
    states: States,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    starts: NDArray[np.int64],
    key: NDArray[np.bool_],
    radius: float,
) -> NDArray[np.float64]:
    """Estimate by how much the altitudes of a trace are too high, shape (fixes,); NaN if it cannot be estimated.

    Strategy: vertical errors drift slowly. Where all roads near a fix have about one altitude, the difference to it
    is a sample of the error, whichever road was driven. The error at any fix is the median of the samples around
    it, so that a passage below a bridge, where the roads disagree, takes its error from before and after.
    """
    bias = np.full(len(z), np.nan)
    scratch = new_scratch(len(states.x))
    samples, rows = np.empty(len(z)), np.empty(len(z), np.int64)
    for trace in range(len(starts) - 1):
        count = 0
        for i in range(starts[trace], starts[trace + 1]):
            if not key[i] or not np.isfinite(z[i]):
                continue
            n_points = nearest_points(states, x[i], y[i], radius, i, scratch)
            lowest, highest, nearest, height = np.inf, -np.inf, np.inf, np.nan
            for c in range(n_points):
                value = altitude_at(states, scratch.point[c], scratch.along[c])
                if not np.isfinite(value):
                    continue
                lowest, highest = min(lowest, value), max(highest, value)
                if scratch.distance[c] < nearest:
                    nearest, height = scratch.distance[c], value
            if highest - lowest <= _AGREE:
                samples[count], rows[count] = z[i] - height, i
                count += 1
        if count == 0:
            continue
        middle = 0
        value, centre = np.nan, -1
        for i in range(starts[trace], starts[trace + 1]):
            while middle + 1 < count and abs(rows[middle + 1] - i) <= abs(rows[middle] - i):
                middle += 1
            if middle != centre:
                low, high = max(middle - _BIAS_REACH, 0), min(middle + _BIAS_REACH + 1, count)
                value, centre = np.median(samples[low:high]), middle
            bias[i] = value
    return bias
