"""Fixes and points that no vehicle can have been at, found before they decide the area and the CRS of a run.

Strategy
--------
A trace is cut where nobody can have driven from one fix to the next. A piece of a few fixes that much longer pieces
of the same trace surround or follow is a fault of the receiver: the rest of the trace says where the vehicle was. Two
long pieces stay, however far apart: an id that stands for two drives is no fault of a fix. Longitude and latitude 0
are what receivers write before they have a position. Semantic points have no trail of their own, so they are held
against the box of their trace.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.bounds import AtLeast, Positive
from probe2road.errors import InputError
from probe2road.fleet.tables import run_starts
from probe2road.options import checked

__all__ = ["OutlierOptions", "impossible_fixes", "without_impossible_fixes", "without_impossible_points"]

logger = logging.getLogger(__name__)

_EARTH = 6_371_000.0  # m, radius
_METRES_PER_DEGREE = 111_000.0  # of latitude
_NAMED = 5  # fixes in one warning


@dataclass(frozen=True)
@checked
class OutlierOptions:
    """Which fixes and points are left out, because no vehicle can have been there."""

    drop: bool = True  # whether any are left out
    min_jump: Positive[float] = 5000.0  # m; a shorter step is left to what breaks traces
    max_speed: Positive[float] = 100.0  # m/s over a step; faster is not driven
    step_factor: Positive[float] = 50.0  # x the median step of a trace without clock is too far for a step
    max_fixes: Annotated[int, AtLeast(1)] = 5  # longest piece of a trace that is left out
    null_island: Positive[float] = 10_000.0  # m around longitude and latitude 0, where there is only sea
    point_distance: Positive[float] = 5000.0  # m from the box of its trace, beyond which a semantic point is left out


def impossible_fixes(traces: pd.DataFrame, crs: CRS, *, options: OutlierOptions | None = None) -> NDArray[np.bool_]:
    """Mark the fixes that no vehicle can have been at.

    Parameters
    ----------
    traces
        Checked traces, sorted as in a `probe2road.fleet.contract.Fleet`.
    crs
        CRS of their coordinates.
    options
        The defaults where it is None.

    Returns
    -------
    ndarray of bool, shape (n_fixes,)

    Examples
    --------
    >>> table = pd.DataFrame({"trace_id": 1, "x": [0.0, 9.0, 9.0001, 9.0002], "y": [0.0, 48.0, 48.0, 48.0]})
    >>> table["t"] = pd.to_datetime(range(4), unit="s", utc=True)
    >>> impossible_fixes(table, CRS.from_epsg(4326)).tolist()
    [True, False, False, False]
    """
    options = options or OutlierOptions()
    bad = np.zeros(len(traces), bool)
    if not options.drop or len(traces) == 0:
        return bad
    bad |= _at_null_island(traces, crs, options)
    rows = np.flatnonzero(~bad)
    if rows.size == 0:
        return bad
    kept = traces if len(rows) == len(traces) else traces.iloc[rows]
    starts = run_starts(kept["trace_id"])
    jump = _jumps(kept, crs, starts, options)
    for trace in np.unique(np.searchsorted(starts, np.flatnonzero(jump), side="right") - 1):
        first, stop = starts[trace], starts[trace + 1]
        cuts = np.concatenate([[first], first + np.flatnonzero(jump[first:stop]), [stop]])
        size = np.diff(cuts)
        small = (size <= options.max_fixes) & (2 * size <= size.max())
        for piece in np.flatnonzero(small):
            bad[rows[cuts[piece] : cuts[piece + 1]]] = True
    return bad


def without_impossible_fixes(
    traces: pd.DataFrame, crs: CRS, *, options: OutlierOptions | None = None, where: object = None
) -> pd.DataFrame:
    """Return the traces without `impossible_fixes`, and warn of those that are left out.

    Raises
    ------
    InputError
        If there is no other fix.
    """
    bad = impossible_fixes(traces, crs, options=options)
    if not bad.any():
        return traces
    rows = np.flatnonzero(bad)
    ids, x, y = (traces[name].to_numpy() for name in ("trace_id", "x", "y"))
    starts = run_starts(traces["trace_id"])
    place = rows - starts[np.searchsorted(starts, rows, side="right") - 1]
    named = [
        f"trace {ids[row]}, fix {number} at {x[row]:.7g}, {y[row]:.7g}"
        for row, number in zip(rows[:_NAMED], place, strict=False)
    ]
    if bad.all():
        fault = f"no vehicle can have been at any of its fixes ({'; '.join(named)})"
        raise InputError(fault, where=where or "traces", fix="check the columns of the positions, and the CRS")
    logger.warning(
        "left out %d of %d fixes, because no vehicle can have been there: %s%s",
        *(len(rows), len(traces), "; ".join(named), "; ..." if len(rows) > _NAMED else ""),
    )
    return traces[~bad].reset_index(drop=True)


def without_impossible_points(
    points: pd.DataFrame,
    points_crs: CRS,
    traces: pd.DataFrame,
    traces_crs: CRS,
    *,
    options: OutlierOptions | None = None,
) -> pd.DataFrame:
    """Return the semantic points that lie near their traces, and warn of those that are left out.

    Points of a trace that is not there stay: they are seen from somewhere. They are counted in a warning, too.

    Parameters
    ----------
    points
        Checked points.
    points_crs
        CRS of their coordinates.
    traces
        The traces, sorted, with ids of the same type.
    traces_crs
        CRS of theirs.
    options
        The defaults where it is None.
    """
    options = options or OutlierOptions()
    if points.empty:
        return points
    starts = run_starts(traces["trace_id"])
    ids = pd.Index(traces["trace_id"].iloc[starts[:-1]])
    owner = ids.get_indexer(pd.Index(points["trace_id"]))
    alien = owner < 0
    if alien.any():
        shown = ", ".join(map(str, pd.unique(points["trace_id"][alien])[:_NAMED]))
        logger.warning("%d of %d semantic points are of traces that are not there (%s)", alien.sum(), len(alien), shown)
    if not options.drop or points_crs != traces_crs:
        return points
    reach = options.point_distance / (_METRES_PER_DEGREE if traces_crs.is_geographic else 1.0)
    x, y = (points[axis].to_numpy() for axis in "xy")
    aside = np.ones(len(points))
    if traces_crs.is_geographic:
        aside = np.maximum(np.cos(np.radians(np.clip(np.abs(y), 0.0, 85.0))), 0.05)
    boxes = {
        axis: [edge.reduceat(traces[axis].to_numpy(), starts[:-1]) for edge in (np.minimum, np.maximum)]
        for axis in "xy"
    }
    everything = {axis: (low.min(), high.max()) for axis, (low, high) in boxes.items()}
    off = np.zeros(len(points), bool)
    for axis, value, margin in (("x", x, reach / aside), ("y", y, np.full(len(y), reach))):
        low = np.where(alien, everything[axis][0], boxes[axis][0][owner])
        high = np.where(alien, everything[axis][1], boxes[axis][1][owner])
        off |= (value < low - margin) | (value > high + margin)
    if not off.any():
        return points
    rows = np.flatnonzero(off)[:_NAMED]
    who = points["trace_id"].to_numpy()
    named = "; ".join(f"trace {who[row]} at {x[row]:.7g}, {y[row]:.7g}" for row in rows)
    logger.warning(
        "left out %d of %d semantic points, which are more than %g km from their traces: %s%s",
        *(int(off.sum()), len(off), options.point_distance / 1000, named, "; ..." if off.sum() > _NAMED else ""),
    )
    return points[~off].reset_index(drop=True)


def _at_null_island(traces: pd.DataFrame, crs: CRS, options: OutlierOptions) -> NDArray[np.bool_]:
    """Mark positions around longitude and latitude 0."""
    if not crs.is_geographic:
        return np.zeros(len(traces), bool)
    reach = options.null_island / _METRES_PER_DEGREE
    return (np.abs(traces["x"].to_numpy()) < reach) & (np.abs(traces["y"].to_numpy()) < reach)


def _jumps(traces: pd.DataFrame, crs: CRS, starts: NDArray[np.int64], options: OutlierOptions) -> NDArray[np.bool_]:
    """Mark fixes that nobody can have driven to from the fix before."""
    step = _steps(traces["x"].to_numpy(), traces["y"].to_numpy(), crs)
    step[starts[:-1]] = 0.0
    far = step > options.min_jump
    rows = np.flatnonzero(far)
    if rows.size == 0:
        return far
    time = traces["t"].to_numpy(dtype="datetime64[ns]")
    seconds = (time[rows] - time[rows - 1]) / np.timedelta64(1, "s")
    with np.errstate(invalid="ignore"):
        far[rows] = step[rows] > options.max_speed * np.maximum(seconds, 1.0)
    for row in rows[np.isnan(seconds)]:
        trace = np.searchsorted(starts, row, side="right") - 1
        median = np.median(step[starts[trace] + 1 : starts[trace + 1]])
        far[row] = step[row] > options.step_factor * median
    return far


def _steps(x: NDArray[np.float64], y: NDArray[np.float64], crs: CRS) -> NDArray[np.float64]:
    """Return the distance (m) from the row before; across the ball where the coordinates are degrees."""
    if not crs.is_geographic:
        return np.hypot(np.diff(x, prepend=x[:1]), np.diff(y, prepend=y[:1]))
    lon, lat = np.radians(x), np.radians(y)
    half_lat, half_lon = np.diff(lat, prepend=lat[:1]) / 2, np.diff(lon, prepend=lon[:1]) / 2
    before = np.concatenate([lat[:1], lat[:-1]])
    share = np.sin(half_lat) ** 2 + np.cos(lat) * np.cos(before) * np.sin(half_lon) ** 2
    return 2.0 * _EARTH * np.arcsin(np.sqrt(np.clip(share, 0.0, 1.0)))
