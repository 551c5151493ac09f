"""Screening: which drives can be aligned at all, decided before a bad drive can displace others.

Strategy: every check is a sum or a median over the rows of a drive, so that it is one pass of array code over the
whole fleet. A check needs many rows to fail before it condemns a drive; single bad fixes are left to robust kernels.
"""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet, fix_intervals
from probe2road.fleet.jumps import position_jumps

__all__ = ["rows_of_points", "screen_drives"]

logger = logging.getLogger(__name__)

_SAME_TIME = 0.6  # s; a point belongs to the fix nearest in time, if that is no further away
_LEAST_DRIVEN = 30.0  # m from end to end; a shorter drive shows no road
_MOVED = 3.0  # m; the course of a shorter step is noise
_ROLLED = 1.0  # m; in a shorter step, the vehicle may stand
_JUMPY = 0.1  # share of jumps in the steps, from which a trace is a mix of two drives
_COURSE = 40.0  # degrees, largest median angle between heading and course
_CLOCK = 1.6  # largest factor between distance and speed times time
_STRAY_POINTS = 0.5  # largest share of points that belong to no fix
_FAR_POINTS = 100.0  # m from a point to its fix; no camera sees so far


def screen_drives(fleet: Fleet) -> NDArray[np.str_]:
    """Return what is wrong with each drive.

    Parameters
    ----------
    fleet
        The fleet.

    Returns
    -------
    ndarray of str, shape (n_traces,)
        Why the drive cannot be aligned; empty where it can.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> still = pd.DataFrame({"trace_id": 1, "t": range(50), "x": 446e3, "y": 4636e3})
    >>> moving = still.assign(trace_id=2, x=446e3 + 10.0 * np.arange(50))
    >>> screen_drives(fleet_from_tables(pd.concat([still, moving]), crs="EPSG:32616")).tolist()
    ['does not move', '']
    """
    traces, starts = fleet.traces, fleet.starts
    owner = fleet.owner
    dx, dy = (np.diff(traces[axis].to_numpy(), prepend=np.nan) for axis in "xy")
    step = np.hypot(dx, dy)
    step[starts[:-1]] = np.nan
    interval = fix_intervals(traces["t"])
    speed = traces["speed"].to_numpy(np.float64) if "speed" in traces else np.full(len(step), np.nan)
    jumps = np.bincount(owner[position_jumps(fleet)], minlength=fleet.n_traces)
    steps = np.maximum(np.diff(starts) - 1, 1)

    box = traces.groupby(owner)[["x", "y"]]
    extent = np.hypot(*(box.max() - box.min()).to_numpy().T)
    checks = (
        ("does not move", extent < _LEAST_DRIVEN),
        ("jumps to and fro: two drives with one id?", jumps > _JUMPY * steps),
        ("time and speed contradict the distance", _clock_is_wrong(step, interval, speed, owner)),
        ("heading contradicts the course", _course_is_wrong(traces, dx, dy, step, owner)),
        ("points do not belong to the fixes", _points_are_wrong(fleet)),
    )
    reasons = np.select([failed for _, failed in checks], [reason for reason, _ in checks], "")
    if (reasons != "").any():
        names, counts = np.unique(reasons[reasons != ""], return_counts=True)
        listed = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
        logger.info("rejected %d of %d drives: %s", counts.sum(), fleet.n_traces, listed)
    return reasons


def rows_of_points(fleet: Fleet) -> NDArray[np.int64]:
    """Return the row of the fix that each point was seen from: the fix of the same drive that is nearest in time.

    Returns
    -------
    ndarray of int64, shape (n_points,)
        -1 where the drive has no fix within 0.6 s, or none with a clock.
    """
    traces, points = fleet.traces, fleet.points
    if points.empty:
        return np.zeros(0, np.int64)
    drive = fleet.ids.get_indexer(points["trace_id"])
    # One ascending key for all drives: the drive, then milliseconds since the first fix of all.
    fix_time, point_time = (_milliseconds(table["t"]) for table in (traces, points))
    timed = ~traces["t"].isna().to_numpy()
    found = np.full(len(points), -1, np.int64)
    usable = np.flatnonzero((drive >= 0) & ~points["t"].isna().to_numpy())
    if not timed.any() or len(usable) == 0:
        return found
    first = min(fix_time[timed].min(), point_time[usable].min())
    span = max(fix_time[timed].max(), point_time[usable].max()) - first + 10_000
    rows = np.flatnonzero(timed)
    key = fleet.owner[rows] * span + fix_time[rows] - first
    wanted = drive[usable] * span + point_time[usable] - first
    after = np.clip(np.searchsorted(key, wanted), 1, len(key) - 1) if len(key) > 1 else np.zeros(len(wanted), np.int64)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(key[after] - wanted) < np.abs(key[before] - wanted), after, before)
    close = np.abs(key[nearest] - wanted) <= _SAME_TIME * 1000.0
    found[usable[close]] = rows[nearest[close]]
    return found


def _clock_is_wrong(
    step: NDArray[np.float64], interval: NDArray[np.float64], speed: NDArray[np.float64], owner: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Tell which drives cover a distance that does not agree with their speeds and times."""
    before = np.concatenate([speed[:1], speed[:-1]])
    expected = (speed + before) / 2.0 * interval
    with np.errstate(invalid="ignore"):
        moving = (step > _ROLLED) & (expected > _ROLLED)
    ratio = np.full(len(step), np.nan)
    ratio[moving] = step[moving] / expected[moving]
    median = _median(ratio, owner)
    return (median > _CLOCK) | (median < 1.0 / _CLOCK)


def _course_is_wrong(
    traces: pd.DataFrame,
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    step: NDArray[np.float64],
    owner: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Tell which drives move in a direction that does not agree with their headings: mirrored or swapped axes."""
    if "heading" not in traces:
        return np.zeros(owner[-1] + 1, bool)
    course = np.degrees(np.arctan2(dx, dy))
    off = np.abs((traces["heading"].to_numpy(np.float64) - course + 180.0) % 360.0 - 180.0)
    moved = np.isfinite(step) & (step >= min(_MOVED, np.nanmedian(step)))
    return _median(np.where(moved, off, np.nan), owner) > _COURSE


def _points_are_wrong(fleet: Fleet) -> NDArray[np.bool_]:
    """Tell which drives have mostly points that do not fit any time or place of the drive."""
    if fleet.points.empty:
        return np.zeros(fleet.n_traces, bool)
    rows = rows_of_points(fleet)
    drive = fleet.ids.get_indexer(fleet.points["trace_id"])
    stray = rows < 0
    seen = ~stray
    away = [fleet.points[axis].to_numpy()[seen] - fleet.traces[axis].to_numpy()[rows[seen]] for axis in "xy"]
    stray[seen] = np.hypot(*away) > _FAR_POINTS
    known = drive >= 0
    total = np.bincount(drive[known], minlength=fleet.n_traces)
    strays = np.bincount(drive[known], weights=stray[known], minlength=fleet.n_traces)
    return strays > _STRAY_POINTS * np.maximum(total, 1)


def _milliseconds(times: pd.Series) -> NDArray[np.int64]:
    return times.to_numpy(dtype="datetime64[ms]").astype(np.int64)


def _median(values: NDArray[np.float64], owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the median of the finite values of each drive; NaN where there are none."""
    return pd.Series(values).groupby(owner).median().to_numpy()
