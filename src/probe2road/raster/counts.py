"""From fleet data to count rasters: how many traces, lane markings and road boundaries each pixel has.

Strategy
--------
Every position becomes an integer pixel of one grid for the whole area, once. A trace is then drawn segment by
segment with Bresenham's algorithm straight into a window of that grid; windows are drawn one at a time from
the segments that touch them, so that memory follows the window and not the area. A pixel's count does not
depend on the window that drew it, on the order of the traces, or on the direction a trace was driven.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from probe2road.crs import require_same_crs
from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.fleet.jumps import without_strays
from probe2road.raster.drawing import draw_line
from probe2road.raster.grid import Grid, Window, sparse_zeros

__all__ = [
    "CHANNELS",
    "Grid",
    "count_pixels",
    "dense_grid",
    "fleet_grid",
    "rasterize",
    "rasterize_windows",
    "without_rare",
]

_BESIDE = 20.0  # m, how far from a trace its camera sees

logger = logging.getLogger(__name__)

CHANNELS = ("traces", "lane_markings", "road_boundaries")  # the paper's A, B, C

_CACHED_WINDOW = 1024  # pixels; three channels of one row block stay in the processor's cache
_KEEP = np.uint32(0xFFFFFFFF)  # all bits: lines add to the value of a pixel

_MOST_PIXELS = 20_000_000_000  # where the fleet drove; a byte each is all the memory of a large computer
_MOST_DENSE = 2_000_000_000  # of an ordinary array of a whole area, which takes memory where nobody drove, too
_LONGEST_SIDE = 2**31 - 1  # px, that a GeoTIFF can have
_PLACE = 100.0  # m, side of the squares that show where the fleet drove


def fleet_grid(fleet: Fleet, *, resolution: float = 1.0, margin: float = 50.0) -> Grid:
    """Return the grid that covers all traces of a fleet and a margin (m).

    Raises
    ------
    InputError
        If the fleet has no fixes.
    OptionError
        If the resolution makes more pixels, where the fleet drove, than a computer can hold.
    """
    if fleet.traces.empty:
        raise InputError("no fixes, so there is no area to map", where="fleet")
    grid = Grid.from_bounds(fleet.bounds, resolution=resolution, crs=fleet.crs, margin=margin)
    pixels = grid.rows * grid.cols
    if pixels > _MOST_PIXELS:
        x, y = (np.floor(fleet.traces[axis].to_numpy() / _PLACE).astype(np.int64) for axis in "xy")
        places = len(np.unique((y - y.min()) * (np.ptp(x) + 1) + x - x.min()))
        pixels = min(pixels, round(places * (_PLACE / resolution) ** 2))
    if pixels > _MOST_PIXELS or max(grid.shape) > _LONGEST_SIDE:
        fault = f"resolution is {resolution:g} m, which makes {pixels:,} pixels where the fleet drove"
        raise OptionError(
            f"{fault} ({grid.rows:,} rows and {grid.cols:,} columns in all)",
            where="fleet_grid",
            fix=f"use coarser pixels, for example resolution={resolution * 10:g}, or a smaller area",
        )
    return grid


def dense_grid(fleet: Fleet, *, resolution: float = 1.0) -> Grid:
    """Return the `fleet_grid` of a method that holds its whole area in ordinary arrays.

    Raises
    ------
    InputError
        If the fleet has no fixes.
    OptionError
        If that would be more pixels than are worth it, most of which nobody drove on.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": [1, 2], "x": [0.0, 300_000.0], "y": [0.0, 300_000.0]})
    >>> dense_grid(fleet_from_tables(table, crs="EPSG:32616", keep_crs=True))
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: fleet_grid: the area is too wide for a method that holds all of its 90,060,610,201
    pixels; use a smaller area, or resolution=10
    """
    grid = fleet_grid(fleet, resolution=resolution)
    pixels = grid.rows * grid.cols
    if pixels > _MOST_DENSE:
        fault = f"the area is too wide for a method that holds all of its {pixels:,} pixels"
        raise OptionError(fault, where="fleet_grid", fix=f"use a smaller area, or resolution={resolution * 10:g}")
    return grid


def rasterize(fleet: Fleet, grid: Grid, *, gaps: TraceGaps | None = None) -> NDArray[np.uint32]:
    """Count traces, lane markings and road boundaries per pixel.

    Traces are drawn as polylines: one for every pixel a segment traverses, where the pixel that two segments
    of a trace share counts once, as do repeats of a pixel in a row; a trace that comes back counts again.
    Semantic points are counted per kind. Whatever lies outside the grid is left out.

    Parameters
    ----------
    fleet
        The fleet, in the grid's CRS.
    grid
        Where and how finely to count.
    gaps
        Where traces are broken; the default limits if it is None.

    Returns
    -------
    ndarray of uint32, shape (3, rows, cols)
        The channels in the order of `CHANNELS`.

    Raises
    ------
    CRSError
        If fleet and grid are in different CRS.

    Notes
    -----
    Paper, section III-A "Rasterization"; METHOD 0.1 rows 2 to 5.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(3), "x": [900.5, 902.5, 904.5], "y": [0.5, 0.5, 2.5]})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> rasterize(fleet, Grid.from_bounds(fleet.bounds, crs=fleet.crs))[0]
    array([[0, 0, 0, 0, 1],
           [0, 0, 0, 1, 0],
           [1, 1, 1, 0, 0]], dtype=uint32)
    """
    counts = sparse_zeros((len(CHANNELS), *grid.shape), np.uint32)
    seen = slice(None) if len(fleet.points) else slice(1)  # pages of a channel that is never written use no memory
    for window, part in rasterize_windows(fleet, grid, size=_CACHED_WINDOW, gaps=gaps):
        counts[seen, *window.core] = part[seen]
    return counts


def rasterize_windows(
    fleet: Fleet, grid: Grid, *, size: int = 1024, halo: int = 0, gaps: TraceGaps | None = None
) -> Iterator[tuple[Window, NDArray[np.uint32]]]:
    """Rasterize a fleet window by window, with memory for one window at a time.

    Windows that neither a trace nor a semantic point touches, halo included, are skipped.

    Parameters
    ----------
    fleet, grid, gaps
        As for `rasterize`.
    size
        Rows and columns of a window, pixels.
    halo
        Context around each window, pixels.

    Yields
    ------
    Window, ndarray of uint32
        The window and its counts, shape ``(3, rows + 2 halo, cols + 2 halo)``.
    """
    require_same_crs(fleet.crs, grid.crs, where="rasterize", what=("the traces are", "the grid is"))
    fleet = without_strays(fleet, gaps)
    row, col = grid.rowcol(fleet.traces["x"], fleet.traces["y"])
    breaks = trace_breaks(fleet, gaps)
    point_row, point_col = grid.rowcol(fleet.points["x"], fleet.points["y"])
    channel = fleet.points["kind"].cat.codes.to_numpy(np.int64) + 1  # the channels follow POINT_KINDS
    single = np.ones(len(point_row), bool)
    # For a fleet in two cities, the table of windows has no rows and columns for the area between the cities.
    rows, cols = (
        np.flatnonzero(
            _touched(place, breaks, size, halo, -(-n // size)) | _touched(other, single, size, halo, -(-n // size))
        )
        for place, other, n in ((row, point_row, grid.rows), (col, point_col, grid.cols))
    )
    ranks = _ranks(rows, -(-grid.rows // size)), _ranks(cols, -(-grid.cols // size))
    fixes = _members_of_windows(row, col, breaks, size, halo, *ranks)
    points = _members_of_windows(point_row, point_col, single, size, halo, *ranks)
    for number in range(len(rows) * len(cols)):
        own_fixes, own_points = (members[offsets[number] : offsets[number + 1]] for offsets, members in (fixes, points))
        if own_fixes.size == 0 and own_points.size == 0:
            continue
        at_row, at_col = size * int(rows[number // len(cols)]), size * int(cols[number % len(cols)])
        window = Window(at_row, at_col, min(size, grid.rows - at_row), min(size, grid.cols - at_col), halo)
        top, left = window.row - window.halo, window.col - window.halo
        counts = np.zeros((len(CHANNELS), *window.grid(grid).shape), np.uint32)
        _draw_segments(row, col, breaks, own_fixes, top, left, counts[0])
        _count_points(point_row[own_points] - top, point_col[own_points] - left, channel[own_points], counts)
        yield window, counts


def count_pixels(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    breaks: NDArray[np.bool_],
    point_row: NDArray[np.int64],
    point_col: NDArray[np.int64],
    kind: NDArray[np.int64],
    shape: tuple[int, int],
) -> NDArray[np.uint32]:
    """Count traces and points that are already in pixel coordinates; see `rasterize`.

    Parameters
    ----------
    row, col
        Pixels of f fixes, in driving order; they may lie outside.
    breaks
        True where no segment leads from the fix before; shape ``(f,)``.
    point_row, point_col, kind
        Pixels of p points, and their positions in `probe2road.fleet.contract.POINT_KINDS`.
    shape
        ``(rows, cols)`` of the raster.

    Returns
    -------
    ndarray of uint32, shape (3, rows, cols)

    Examples
    --------
    >>> none = np.zeros(0, np.int64)
    >>> breaks = np.array([True, False])
    >>> count_pixels(np.array([1, 1]), np.array([0, 2]), breaks, none, none, none, (2, 4))[0]
    array([[0, 0, 0, 0],
           [1, 1, 1, 0]], dtype=uint32)
    """
    counts = np.zeros((len(CHANNELS), *shape), np.uint32)
    _draw_segments(row, col, breaks, np.arange(len(row)), 0, 0, counts[0])
    _count_points(point_row, point_col, kind + 1, counts)  # the channels follow POINT_KINDS
    return counts


@njit(cache=True)
def _touched(
    place: NDArray[np.int64], breaks: NDArray[np.bool_], size: int, halo: int, n_windows: int
) -> NDArray[np.bool_]:
    """Mark the windows along one axis that a segment may touch; see `_members_of_windows`."""
    touched = np.zeros(n_windows, np.bool_)
    for fix in range(len(place)):
        before = fix if breaks[fix] else fix - 1
        low, high = min(place[fix], place[before]), max(place[fix], place[before])
        for window in range(max(0, (low - halo) // size), min(n_windows - 1, (high + halo) // size) + 1):
            touched[window] = True
    return touched


def _ranks(windows: NDArray[np.int64], n_windows: int) -> NDArray[np.int64]:
    """Return the number of each window along one axis among the touched ones; -1 for the others."""
    ranks = np.full(n_windows, -1, np.int64)
    ranks[windows] = np.arange(len(windows))
    return ranks


@njit(cache=True)
def _members_of_windows(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    breaks: NDArray[np.bool_],
    size: int,
    halo: int,
    row_ranks: NDArray[np.int64],
    col_ranks: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the fixes whose segment from the fix before may touch a window, for each window of a regular table.

    A fix behind a break stands for itself alone. The ranks number the rows and columns of windows that are touched;
    the others are not in the table. Returns CSR arrays: offsets ``(n_windows + 1,)``, windows row by row, and the
    fixes of each, ascending.
    """
    all_rows, all_cols = len(row_ranks), len(col_ranks)
    window_rows, window_cols = row_ranks.max() + 1, col_ranks.max() + 1
    offsets = np.zeros(window_rows * window_cols + 1, np.int64)
    members = np.empty(0, np.int64)
    only = np.full(len(row), -1, np.int32)  # most segments touch one window, found in the first pass
    for fill in range(2):
        for fix in range(len(row)):
            if only[fix] >= 0:
                members[offsets[only[fix]]] = fix
                offsets[only[fix]] += 1
                continue
            before = fix if breaks[fix] else fix - 1
            low_row, high_row = min(row[fix], row[before]), max(row[fix], row[before])
            low_col, high_col = min(col[fix], col[before]), max(col[fix], col[before])
            top, bottom = max(0, (low_row - halo) // size), min(all_rows - 1, (high_row + halo) // size)
            left, right = max(0, (low_col - halo) // size), min(all_cols - 1, (high_col + halo) // size)
            if top > bottom or left > right:
                continue
            top, bottom = row_ranks[top], row_ranks[bottom]  # windows between them are touched, too
            left, right = col_ranks[left], col_ranks[right]
            if fill == 0 and top == bottom and left == right:
                only[fix] = top * window_cols + left
            for i in range(top, bottom + 1):
                for j in range(left, right + 1):
                    window = i * window_cols + j
                    if fill == 1:
                        members[offsets[window]] = fix
                        offsets[window] += 1
                    else:
                        offsets[window + 1] += 1
        if fill == 0:
            offsets = np.cumsum(offsets)
            members = np.empty(offsets[-1], np.int64)
    offsets[1:] = offsets[:-1].copy()  # filling moved each offset to the end of its window
    offsets[0] = 0
    return offsets, members


@njit(cache=True)
def _draw_segments(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    breaks: NDArray[np.bool_],
    fixes: NDArray[np.int64],
    top: int,
    left: int,
    counts: NDArray[np.uint32],
) -> None:
    """Add the segments that end at the given fixes to counts ``(rows, cols)`` with the corner (top, left).

    The pixel that a segment was driven from belongs to the segment before.
    """
    rows, cols = counts.shape
    for fix in fixes:
        r1, c1 = row[fix] - top, col[fix] - left
        if breaks[fix]:
            if 0 <= r1 < rows and 0 <= c1 < cols:
                counts[r1, c1] += np.uint32(1)
            continue
        r0, c0 = row[fix - 1] - top, col[fix - 1] - left
        if r0 == r1 and c0 == c1:
            continue
        inside = draw_line((r0, c0, r1, c1), 0, 0, counts, _KEEP)
        if inside or (0 <= r0 < rows and 0 <= c0 < cols):
            counts[r0, c0] -= np.uint32(1)


@njit(cache=True)
def _count_points(
    row: NDArray[np.int64], col: NDArray[np.int64], channel: NDArray[np.int64], counts: NDArray[np.uint32]
) -> None:
    """Add points to counts ``(channel, rows, cols)``; points outside are ignored."""
    _, rows, cols = counts.shape
    for point in range(len(row)):
        if 0 <= row[point] < rows and 0 <= col[point] < cols:
            counts[channel[point], row[point], col[point]] += np.uint32(1)


def without_rare(counts: NDArray[np.uint32], grid: Grid, *, least: int) -> NDArray[np.uint32]:
    """Return counts without the pixels that few traces passed, for pictures to be published.

    Parameters
    ----------
    counts
        From `rasterize`, shape ``(channel, row, col)``.
    grid
        Grid of the counts.
    least
        Fewest traces of a pixel that is kept. Semantic points stay within 20 m of such a pixel. 1 keeps everything.

    Examples
    --------
    >>> grid = Grid.from_bounds((0, 0, 3, 1), crs="EPSG:32616")
    >>> without_rare(np.array([[[3, 1, 2]], [[0, 0, 0]], [[0, 0, 0]]], np.uint32), grid, least=2)[0].tolist()
    [[3, 0, 2]]
    """
    if least <= 1:
        return counts
    often = counts[0] >= least
    shown = np.where(often, counts, 0)
    reach = max(1, round(_BESIDE / grid.resolution))
    beside = (
        ndimage.uniform_filter(often.astype(np.float32), 2 * reach + 1, mode="constant") > 0.5 / (2 * reach + 1) ** 2
    )
    shown[1:] = np.where(beside, counts[1:], 0)
    return shown
