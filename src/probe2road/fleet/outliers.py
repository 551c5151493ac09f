"""Fixes and points at impossible positions, found before they affect the area and the CRS of a run.

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
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from probe2road.bounds import AtLeast, Positive
from probe2road.errors import InputError
from probe2road.fleet.tables import run_starts
from probe2road.options import checked

__all__ = ["OutlierOptions", "impossible_fixes", "main_area", "without_impossible_fixes", "without_impossible_points"]

logger = logging.getLogger(__name__)

_EARTH = 6_371_000.0  # m, radius
_METRES_PER_DEGREE = 111_000.0  # of latitude
_PLACE = 100_000.0  # m, side of the squares that tell one area from another
_SMALL = 0.2  # of the fixes of the largest area; an area with no more does not decide the CRS
_NAMED = 5  # fixes in one warning


@dataclass(frozen=True)
@checked
class OutlierOptions:
    """Which fixes and points are left out because no vehicle can have been there."""

    drop: bool = True  # whether any are left out
    min_jump: Positive[float] = 5000.0  # m; a shorter step is left to what breaks traces
    max_speed: Positive[float] = 100.0  # m/s over a step; faster is not driven
    step_factor: Positive[float] = 50.0  # x the median step of a trace without clock is too far for a step
    max_fixes: Annotated[int, AtLeast(1)] = 5  # longest piece of a trace that is left out
    null_island: Positive[float] = 10_000.0  # m around longitude and latitude 0, where there is only sea
    point_distance: Positive[float] = 5000.0  # m from the box of its trace, beyond which a semantic point is left out


def impossible_fixes(traces: pd.DataFrame, crs: CRS, *, options: OutlierOptions | None = None) -> NDArray[np.bool_]:
    """Mark the fixes at positions where no vehicle can have been.

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
        main = np.flatnonzero(~small)
        for piece in np.flatnonzero(small):
            # Between a long piece and one at a wrong place, a short one can be at the right place.
            before, after = main[main < piece][-1:], main[main > piece][:1]
            ends = np.concatenate([cuts[before + 1] - 1, np.repeat(cuts[piece + 1] - 1, len(after))])
            begins = np.concatenate([np.repeat(cuts[piece], len(before)), cuts[after]])
            if _too_far(kept, crs, starts, ends, begins, options).all():
                bad[rows[cuts[piece] : cuts[piece + 1]]] = True
    return bad


def main_area(traces: pd.DataFrame, crs: CRS) -> NDArray[np.bool_]:
    """Mark the fixes that may decide the CRS of a run: all but those of small areas far away from the others.

    An area is what hangs together in squares of 100 km; it is small with a fifth of the fixes of the largest one, or
    less. So neither a stray trace nor fixes that are kept, although no vehicle can have been there, decide how a fleet
    is measured.

    Parameters
    ----------
    traces
        Checked traces, at least one fix.
    crs
        CRS of their coordinates.

    Returns
    -------
    ndarray of bool, shape (n_fixes,)

    Examples
    --------
    >>> table = pd.DataFrame({"x": [9.0, 9.1, 9.2, 9.3, 9.4, 2.0], "y": 48.0})
    >>> main_area(table, CRS.from_epsg(4326)).tolist()
    [True, True, True, True, True, False]
    """
    side = _PLACE / (_METRES_PER_DEGREE if crs.is_geographic else 1.0)
    x, y = (np.floor(traces[axis].to_numpy() / side).astype(np.int64) for axis in "xy")
    if np.ptp(x) <= 1 and np.ptp(y) <= 1:
        return np.ones(len(traces), bool)
    width = np.ptp(x) + 1
    keys, place, count = np.unique((y - y.min()) * width + x - x.min(), return_inverse=True, return_counts=True)
    places = np.column_stack([keys % width, keys // width])
    near = cKDTree(places).sparse_distance_matrix(cKDTree(places), 1.5, output_type="coo_matrix")
    areas, area = connected_components(near, directed=False)
    size = np.bincount(area, count, minlength=areas)
    return np.asarray((size > _SMALL * size.max())[area[place]])


def without_impossible_fixes(
    traces: pd.DataFrame, crs: CRS, *, options: OutlierOptions | None = None, where: object = None
) -> pd.DataFrame:
    """Return the traces without `impossible_fixes`, with a warning about the fixes left out.

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
    """Return the semantic points that lie near their traces, with a warning about the points left out.

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
    """Mark fixes to which no vehicle can have driven from the fix before."""
    x, y = (traces[axis].to_numpy() for axis in "xy")
    far = np.zeros(len(x), bool)
    far[1:] = _distance(x[:-1], y[:-1], x[1:], y[1:], crs) > options.min_jump
    far[starts[:-1]] = False
    rows = np.flatnonzero(far)
    far[rows] = _too_far(traces, crs, starts, rows - 1, rows, options)
    return far


def _too_far(
    traces: pd.DataFrame,
    crs: CRS,
    starts: NDArray[np.int64],
    first: NDArray[np.int64],
    second: NDArray[np.int64],
    options: OutlierOptions,
) -> NDArray[np.bool_]:
    """Tell whether no vehicle can have driven from some fixes to later ones of their traces."""
    x, y = (traces[axis].to_numpy() for axis in "xy")
    time = traces["t"].to_numpy(dtype="datetime64[ns]")
    step = _distance(x[first], y[first], x[second], y[second], crs)
    seconds = (time[second] - time[first]) / np.timedelta64(1, "s")
    limit = options.max_speed * np.maximum(seconds, 1.0)
    for place in np.flatnonzero(np.isnan(seconds)):
        trace = np.searchsorted(starts, first[place], side="right") - 1
        own = slice(starts[trace], starts[trace + 1])
        steps = _distance(x[own][:-1], y[own][:-1], x[own][1:], y[own][1:], crs)
        limit[place] = options.step_factor * float(np.median(steps))
    return step > np.maximum(limit, options.min_jump)


def _distance(
    x: NDArray[np.float64], y: NDArray[np.float64], to_x: NDArray[np.float64], to_y: NDArray[np.float64], crs: CRS
) -> NDArray[np.float64]:
    """Return distances (m), along the globe if the coordinates are degrees."""
    if not crs.is_geographic:
        return np.hypot(to_x - x, to_y - y)
    lon, lat, to_lon, to_lat = (np.radians(angle) for angle in (x, y, to_x, to_y))
    share = np.sin((to_lat - lat) / 2) ** 2 + np.cos(lat) * np.cos(to_lat) * np.sin((to_lon - lon) / 2) ** 2
    return np.asarray(2.0 * _EARTH * np.arcsin(np.sqrt(np.clip(share, 0.0, 1.0))))
