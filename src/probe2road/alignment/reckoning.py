"""Dead reckoning: motion between fixes from heading and speed, and positions smoothed with it.

Strategy
--------
Among tall buildings a receiver jumps by tens of metres from one second to the next, and the vehicle does not. How far
it was recorded from its reckoned path is the error of the receiver plus the drift of dead reckoning, and the drift is
slow: the running median over some seconds before and after keeps what is slow and drops bursts. Scale and direction of
the reckoned path are fitted to the positions of each drive first, because a speedometer may be a few per cent off and a
compass a degree. All of it is array code over the fixes of the whole fleet; the medians are compiled.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numba import njit
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet, fix_intervals, trace_breaks

__all__ = ["fixes_course", "reckoned_steps", "steadying", "wrapped"]

_COURSE_STEP = 2.0  # m; shorter steps leave the course as it was
_BRIDGED = 10.0  # s between fixes, up to which heading and speed give the motion
_STEADY_TIME = 20.0  # s before and after a fix over which the median is taken
_STEADY_FIXES = 41  # most fixes for the median; of denser ones, some are skipped evenly
_LEG_TIME = 10.0  # s, length of the legs to which the reckoned path is fitted
_LEG = 50.0  # m, least length of a leg
_LEAST_LEGS = 10


def wrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles wrapped to the range -pi to pi."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi, np.float64)


def fixes_course(fleet: Fleet, breaks: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the direction of travel at every fix: the recorded heading, or the course of the positions without one.

    Parameters
    ----------
    fleet
        The fleet.
    breaks
        Fixes that no motion leads to, shape ``(n,)``.

    Returns
    -------
    ndarray, shape (n,)
        Radians counter-clockwise from east. A standing vehicle keeps its direction.
    """
    traces = fleet.traces
    xy = traces[["x", "y"]].to_numpy(np.float64)
    n = len(xy)
    before = np.maximum(np.arange(n) - 1, 0)
    after = np.minimum(np.arange(n) + 1, n - 1)
    before[breaks] = np.flatnonzero(breaks)
    ends = np.append(breaks[1:], True)
    after[ends] = np.flatnonzero(ends)
    leg = xy[after] - xy[before]
    course = np.arctan2(leg[:, 1], leg[:, 0])
    moving = np.hypot(*leg.T) >= _COURSE_STEP
    chain = np.cumsum(breaks) - 1
    # The course of the last moving fix before in the chain, or else of the first one after.
    last = np.maximum.accumulate(np.where(moving, np.arange(n), -1))
    following = np.minimum.accumulate(np.where(moving, np.arange(n), n - 1)[::-1])[::-1]
    source = np.where((last >= 0) & (chain[last] == chain), last, following)
    course = course[np.where(chain[source] == chain, source, np.arange(n))]
    if "heading" not in traces:
        return course
    heading = np.pi / 2.0 - np.radians(traces["heading"].to_numpy(np.float64))
    return wrapped(np.where(np.isfinite(heading), heading, course))


def reckoned_steps(fleet: Fleet, theta: NDArray[np.float64], breaks: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the motion from the fix before to every fix, from heading and speed.

    Parameters
    ----------
    fleet
        The fleet.
    theta
        Direction of travel at every fix, radians counter-clockwise from east, shape ``(n,)``.
    breaks
        Fixes that no motion leads to, shape ``(n,)``.

    Returns
    -------
    ndarray, shape (n, 2)
        Metres east and north; NaN where it is not known.
    """
    traces = fleet.traces
    motion = np.full((len(traces), 2), np.nan)
    if "speed" not in traces or "heading" not in traces:
        return motion
    speed = traces["speed"].to_numpy(np.float64)
    length = (speed + np.roll(speed, 1)) / 2.0 * fix_intervals(fleet.traces["t"])
    middle = theta - wrapped(theta - np.roll(theta, 1)) / 2.0
    motion[:, 0], motion[:, 1] = length * np.cos(middle), length * np.sin(middle)
    motion[breaks] = np.nan
    return motion


def steadying(fleet: Fleet) -> NDArray[np.float64]:
    """Return the correction of every fix that makes it follow its reckoned path, at the place where GNSS has that path.

    Parameters
    ----------
    fleet
        The fleet; drives without heading, speed or clock stay as they are.

    Returns
    -------
    ndarray, shape (n, 2)
        Metres east and north.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(60), "x": 446e3 + 10.0 * np.arange(60), "y": 4636e3})
    >>> table.loc[30, "y"] += 40.0  # a reflection
    >>> fleet = fleet_from_tables(table.assign(heading=90.0, speed=10.0), crs="EPSG:32616")
    >>> steadying(fleet)[29:32].tolist()
    [[0.0, 0.0], [0.0, -40.0], [0.0, 0.0]]
    """
    breaks = np.zeros(len(fleet.traces), bool)
    breaks[fleet.starts[:-1]] = True
    steps = reckoned_steps(fleet, fixes_course(fleet, trace_breaks(fleet)), breaks)
    interval = fix_intervals(fleet.traces["t"])
    with np.errstate(invalid="ignore"):
        breaks |= ~(np.isfinite(steps).all(axis=1) & (interval <= _BRIDGED))
    steps[breaks] = 0.0
    xy = fleet.traces[["x", "y"]].to_numpy(np.float64)
    seconds = np.cumsum(np.where(breaks, 0.0, interval))
    chain = np.cumsum(breaks) - 1
    path = np.cumsum(_fitted(xy, steps, seconds, chain, fleet.owner), axis=0)
    error = xy - path
    return _running_median(error, seconds, chain) - error


def _fitted(
    xy: NDArray[np.float64],
    steps: NDArray[np.float64],
    seconds: NDArray[np.float64],
    chain: NDArray[np.int64],
    owner: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Rotate and scale the reckoned steps (n, 2) of each drive by their median difference from the positions."""
    n = len(xy)
    ends = np.minimum(np.searchsorted(seconds, seconds + _LEG_TIME), n - 1)
    path = np.cumsum(steps, axis=0)
    moved, reckoned = ((part[ends] - part) @ np.array([1.0, 1.0j]) for part in (xy, path))
    leg = (chain[ends] == chain) & (seconds[ends] >= seconds + _LEG_TIME)
    leg &= (np.abs(reckoned) >= _LEG) & (np.abs(moved) >= _LEG)
    ratio = moved[leg] / reckoned[leg]
    by_drive = pd.DataFrame({"stretch": np.abs(ratio), "turn": np.angle(ratio)}).groupby(owner[leg])
    enough = by_drive.size() >= _LEAST_LEGS
    median = by_drive.median()[enough]
    factor = np.ones(owner[-1] + 1 if n else 0, np.complex128)
    factor[median.index.to_numpy(np.int64)] = median["stretch"] * np.exp(1.0j * median["turn"])
    fitted = (steps @ np.array([1.0, 1.0j])) * factor[owner]
    return np.column_stack([fitted.real, fitted.imag])


@njit(cache=True)
def _running_median(
    values: NDArray[np.float64], seconds: NDArray[np.float64], chain: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the median of each column (n, 2) over the fixes of the same chain that are near in time.

    Of two values in the middle it is the upper one, not their mean: no fix is put half way across a jump.
    """
    n = len(values)
    result = np.empty_like(values)
    first = 0
    last = 0  # one behind the last fix of the window
    for i in range(n):
        while chain[first] != chain[i] or seconds[first] < seconds[i] - _STEADY_TIME:
            first += 1
        last = max(last, i)
        while last < n and chain[last] == chain[i] and seconds[last] <= seconds[i] + _STEADY_TIME:
            last += 1
        stride = (last - first - 1) // _STEADY_FIXES + 1
        # Fixes are counted from this fix, so that both sides have the same weight.
        begin = i - (i - first) // stride * stride
        for column in range(2):
            window = np.sort(values[begin:last:stride, column])
            result[i, column] = window[len(window) // 2]
    return result
