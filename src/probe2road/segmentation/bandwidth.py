"""The kernel bandwidth of the density segmenter, from the lateral distances of the traces of one road.

Strategy
--------
Traces are cut into pieces of at most 10 m. Across a piece, the pieces of other traces that run along with it or
against it are lined up by their lateral distance; those within reach that leave no hole belong to the same
road. Their standard deviation is the spread there: lanes, both directions of a street, and the errors of the
receivers together. A hole of five metres is a median strip or a block, so carriageways that stand apart are
not mixed. The median over many places, each weighing as much as it was driven, is the spread of the data set.
Nothing in it depends on the order of the traces or on the direction they were driven.
"""

from __future__ import annotations

import logging

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.fleet.jumps import without_strays
from probe2road.raster.grid import Grid

__all__ = ["estimate_bandwidth", "lateral_spread"]

logger = logging.getLogger(__name__)

_PIECE = 10.0  # m, longest piece of a trace
_STANDING = 1.0  # m; shorter steps have no direction
_REACH = 20.0  # m, lateral distance looked at
_ALONG = 5.0  # m, longitudinal distance looked at
_HOLE = 5.0  # m without traces end a road
_MIN_PIECES = 10  # fewest pieces of a place that counts
_PLACES = 4000  # largest number of places, those with the most traffic
_TURN = np.cos(np.radians(20.0))  # pieces with or against the direction of a place differ by less
_CELL = _REACH + _ALONG  # m; neighbours of a piece are in its cell or the eight around it

_FACTOR = 2.3  # bandwidth over spread: wide enough for a road to be one ridge
_RANGE = (3.0, 15.0)  # m
_STEP = 0.5  # m; the bandwidth is rounded, so that small changes of the data do not change it


def estimate_bandwidth(fleet: Fleet, grid: Grid, *, gaps: TraceGaps | None = None) -> float:
    """Return the kernel bandwidth (m) at which the traces of one road form one ridge.

    2.3 times the lateral spread of the traces, between 3 m and 15 m, in steps of half a metre; 5 m where no
    place has enough traces to tell.

    Parameters
    ----------
    fleet
        The fleet; only its traces are used.
    grid
        Its grid, which anchors where the spread is measured.
    gaps
        Where traces are broken.
    """
    spread = lateral_spread(fleet, grid, gaps=gaps)
    if not np.isfinite(spread):
        logger.info("too few traces to measure their spread: bandwidth 5.0 m")
        return 5.0
    bandwidth = float(np.clip(round(_FACTOR * spread / _STEP) * _STEP, *_RANGE))
    logger.info("traces of one road spread by %.1f m: bandwidth %.1f m", spread, bandwidth)
    return bandwidth


def lateral_spread(fleet: Fleet, grid: Grid, *, gaps: TraceGaps | None = None) -> float:
    """Return the median standard deviation (m) of the traces across a road; NaN if there are too few traces.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.raster.counts import fleet_grid
    >>> drives = [
    ...     pd.DataFrame({"trace_id": k, "t": range(50), "x": 446000 + 9.0 * np.arange(50), "y": 4636000 + k / 10})
    ...     for k in range(21)
    ... ]
    >>> fleet = fleet_from_tables(pd.concat(drives), crs="EPSG:32616")
    >>> round(lateral_spread(fleet, fleet_grid(fleet)), 2)
    0.61
    """
    fleet = without_strays(fleet, gaps, silent=True)
    position, direction = _pieces(fleet, trace_breaks(fleet, gaps))
    cell_row, cell_col = (
        np.floor(np.abs(position[:, axis] - origin) / _CELL).astype(np.int64)
        for axis, origin in ((1, grid.top), (0, grid.left))
    )
    columns = int(cell_col.max(initial=0)) + 3  # a margin, so that no neighbour is in the next row of cells
    cell = (cell_row + 1) * columns + cell_col + 1
    order = np.lexsort((position[:, 1], position[:, 0], cell))
    position, direction, cell = position[order], direction[order], cell[order]
    occupied, first, count = np.unique(cell, return_index=True, return_counts=True)
    busiest = np.lexsort((occupied, -count))[:_PLACES]
    places = first[busiest] + count[busiest] // 2
    spreads = _spreads(position, direction, cell, columns, places)
    order = np.argsort(spreads)[: np.isfinite(spreads).sum()]  # NaN sorts last
    if order.size == 0:
        return float("nan")
    driven = np.cumsum(count[busiest][order])
    return float(spreads[order[np.searchsorted(driven, driven[-1] / 2)]])


def _pieces(fleet: Fleet, breaks: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cut the segments of moving vehicles into equal pieces: midpoints ``(n, 2)`` and unit directions ``(n, 2)``."""
    fixes = fleet.traces[["x", "y"]].to_numpy()
    end = np.flatnonzero(~breaks)
    step = fixes[end] - fixes[end - 1]
    length = np.hypot(*step.T)
    number = np.where(length < _STANDING, 0, np.ceil(length / _PIECE)).astype(np.int64)
    owner = np.repeat(np.arange(len(end)), number)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    along = ((place + 0.5) / number[owner])[:, None]
    return fixes[end - 1][owner] + along * step[owner], step[owner] / length[owner][:, None]


@njit(cache=True)
def _spreads(
    position: NDArray[np.float64],
    direction: NDArray[np.float64],
    cell: NDArray[np.int64],
    columns: int,
    places: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the standard deviation of traces across each place; NaN with too few pieces. Pieces are sorted by cell."""
    result = np.full(len(places), np.nan)
    for number in range(len(places)):
        here = places[number]
        ahead = direction[here]
        offsets = [0.0][:0]
        for row_step in range(-1, 2):
            low = cell[here] + row_step * columns - 1
            for other in range(np.searchsorted(cell, low), np.searchsorted(cell, low + 3)):
                step = position[other] - position[here]
                along = step[0] * ahead[0] + step[1] * ahead[1]
                across = step[1] * ahead[0] - step[0] * ahead[1]
                aligned = abs(direction[other, 0] * ahead[0] + direction[other, 1] * ahead[1])
                if abs(along) <= _ALONG and abs(across) <= _REACH and aligned >= _TURN:
                    offsets.append(across)
        lined_up = np.sort(np.array(offsets))
        own = np.searchsorted(lined_up, 0.0)
        low, high = own, own
        while low > 0 and lined_up[low] - lined_up[low - 1] <= _HOLE:
            low -= 1
        while high + 1 < len(lined_up) and lined_up[high + 1] - lined_up[high] <= _HOLE:
            high += 1
        if high + 1 - low >= _MIN_PIECES:
            result[number] = lined_up[low : high + 1].std()
    return result
