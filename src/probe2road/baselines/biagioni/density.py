"""From traces to the density that Biagioni and Eriksson thin: blurred lines, closed, as ranks of density levels.

Strategy
--------
Windows are drawn, blurred and closed one at a time, with a halo, and those without a trip are skipped. In a window,
every trip is drawn with anti-aliased lines into a scratch image of its own, which its last segment hands over to the
sum and clears: a trip counts once per pixel, however often it passes. What is kept of the density is the rank of the
highest level that it reaches, one byte per pixel, because thinning asks for nothing else.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.raster.grid import Grid, Window

__all__ = ["LEVELS", "blur", "blur_kernel", "close_with_disk", "level_ranks", "trip_lines"]

logger = logging.getLogger(__name__)

LINE_VALUE = 32  # of a pixel in the middle of a trip's line
LEVELS = np.array([*range(1, 16), *(2**k for k in range(4, 17))])  # density, ascending

_WINDOW = 1024  # pixels; side of the windows that are blurred one at a time


def trip_lines(fleet: Fleet, grid: Grid, *, gaps: TraceGaps | None = None) -> NDArray[np.int32]:
    """Sum the lines of trips: each is anti-aliased, one pixel wide, has the value 32, and counts once per pixel.

    Lines run between the centres of the fixes' pixels, as those of OpenCV do unless told otherwise. What lies outside
    the grid is left out.

    Parameters
    ----------
    fleet
        The fleet, in the grid's CRS.
    grid
        Where to draw.
    gaps
        Where traces are broken; a trip broken in two still counts once per pixel.

    Returns
    -------
    ndarray of int32, shape (rows, cols)

    Examples
    --------
    Three passes of two trips along the middle of a row of pixels:

    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> x = [901.5, 904.5, 901.5, 901.5, 904.5]
    >>> table = pd.DataFrame({"trace_id": [1, 1, 1, 2, 2], "t": range(5), "x": x, "y": 1.5})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> trip_lines(fleet, Grid.from_bounds((900, 0, 905.5, 2.5), crs="EPSG:32616"))
    array([[ 0,  0,  0,  0,  0,  0],
           [ 0, 64, 64, 64, 64,  0],
           [ 0,  0,  0,  0,  0,  0]], dtype=int32)
    """
    return _drawn(_segments(fleet, grid, gaps), Window(0, 0, *grid.shape))


def blur_kernel(sigma: float, half_width: int) -> NDArray[np.float64]:
    """Return a Gaussian cut off at a half-width (both in pixels) that sums to one, shape ``(2 half_width + 1,)``."""
    kernel = np.exp(-(np.arange(-half_width, half_width + 1) ** 2) / (2 * sigma**2))
    return np.asarray(kernel / kernel.sum())


def blur(lines: NDArray[Any], kernel: NDArray[np.float64]) -> NDArray[np.float32]:
    """Blur lines in both directions; pixels outside count as empty.

    Examples
    --------
    The ridge that one trip raises (METHOD 4.2), with the sigma of the code and with that of the paper:

    >>> lines = np.zeros((81, 81))
    >>> lines[40] = 32
    >>> [round(float(blur(lines, blur_kernel(*shape))[40, 40]), 1) for shape in ((2.9, 8), (8.5, 26))]
    [4.4, 1.5]
    """
    rows = ndimage.correlate1d(lines.astype(np.float32), kernel, axis=0, mode="constant")
    return np.asarray(ndimage.correlate1d(rows, kernel, axis=1, mode="constant"))


def close_with_disk(values: NDArray[Any], radius: int) -> NDArray[Any]:
    """Close a grey image with a disk (radius in pixels): pits smaller than the disk are filled up to their rim.

    Examples
    --------
    >>> close_with_disk(np.pad([[3, 3, 3], [3, 1, 3], [3, 3, 3]], 2), 1)[3]
    array([0, 0, 3, 3, 3, 0, 0])
    """
    return -_dilated(-_dilated(values, radius), radius)


def level_ranks(
    fleet: Fleet, grid: Grid, kernel: NDArray[np.float64], *, closing: int, gaps: TraceGaps | None = None
) -> NDArray[np.uint8]:
    """Draw all trips, blur and round the result, close it with a disk, and return the rank of its density levels.

    Parameters
    ----------
    fleet, grid, gaps
        As for `trip_lines`.
    kernel
        From `blur_kernel`.
    closing
        Radius of the disk, pixels.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)
        How many of `LEVELS` the density of a pixel reaches, 0 to 28.
    """
    ranks = np.zeros(grid.shape, np.uint8)
    segments = _segments(fleet, grid, gaps)
    driven = 0
    for window in grid.windows(_WINDOW, halo=len(kernel) // 2 + 2 * closing):
        lines = _drawn(segments, window)
        if not lines.any():
            continue
        density = close_with_disk(np.rint(blur(lines, kernel)).astype(np.int32), closing)
        ranks[window.core] = np.searchsorted(LEVELS, density[window.inner], side="right")
        driven += 1
    logger.info("density of %d windows, highest level %d", driven, LEVELS[ranks.max() - 1] if ranks.any() else 0)
    return ranks


def _segments(fleet: Fleet, grid: Grid, gaps: TraceGaps | None) -> NDArray[np.int64]:
    """Return the trip, the row and column of the start, and those of the end of all segments; shape ``(5, S)``."""
    row, col = grid.rowcol(fleet.traces["x"], fleet.traces["y"])
    end = np.flatnonzero(~trace_breaks(fleet, gaps))
    return np.stack([fleet.owner[end], row[end - 1], col[end - 1], row[end], col[end]])


def _drawn(segments: NDArray[np.int64], window: Window) -> NDArray[np.int32]:
    """Sum the lines of all trips in a window and its halo."""
    shape = window.rows + 2 * window.halo, window.cols + 2 * window.halo
    trip, r0, c0, r1, c1 = segments
    top, left = window.row - window.halo, window.col - window.halo
    touching = (np.maximum(r0, r1) >= top - 1) & (np.minimum(r0, r1) <= top + shape[0])
    touching &= (np.maximum(c0, c1) >= left - 1) & (np.minimum(c0, c1) <= left + shape[1])
    near = np.flatnonzero(touching)
    total = np.zeros(shape, np.int32)
    if len(near):
        ends = r0[near] - top, c0[near] - left, r1[near] - top, c1[near] - left
        _draw_trips(trip[near], *ends, np.zeros(shape, np.uint8), total)
    return total


def _dilated(values: NDArray[Any], radius: int) -> NDArray[Any]:
    """Return the maximum over a disk around every pixel, computed along rows first."""
    height = np.arange(-radius, radius + 1)
    half_width = np.floor(np.sqrt(radius**2 - height**2)).astype(int)
    padded = np.pad(values, ((radius, radius), (0, 0)), mode="edge")
    result = values.copy()
    for width in np.unique(half_width):
        widened = ndimage.maximum_filter1d(padded, 2 * width + 1, axis=1, mode="nearest")
        for step in height[half_width == width]:
            np.maximum(result, widened[radius + step : radius + step + len(values)], out=result)
    return result


@njit(cache=True)
def _draw_trips(
    trip: NDArray[np.int64],
    r0: NDArray[np.int64],
    c0: NDArray[np.int64],
    r1: NDArray[np.int64],
    c1: NDArray[np.int64],
    scratch: NDArray[np.uint8],
    total: NDArray[np.int32],
) -> None:
    """Draw each trip into the scratch image (all zero before and after), and add it to the total."""
    cols = scratch.shape[1]
    touched = [0 for _ in range(0)]
    for segment in range(len(trip)):
        _draw_segment(r0[segment], c0[segment], r1[segment], c1[segment], scratch, touched)
        if segment + 1 < len(trip) and trip[segment + 1] == trip[segment]:
            continue
        for pixel in touched:
            r, c = pixel // cols, pixel % cols
            total[r, c] += scratch[r, c]
            scratch[r, c] = 0
        touched.clear()


@njit(cache=True)
def _draw_segment(r0: int, c0: int, r1: int, c1: int, scratch: NDArray[np.uint8], touched: list[int]) -> None:
    """Set pixels within one pixel of a segment to at least 32 times one minus their distance; list new pixels."""
    rows, cols = scratch.shape
    steep = abs(r1 - r0) > abs(c1 - c0)
    squared = (r1 - r0) ** 2 + (c1 - c0) ** 2
    low, high = (min(r0, r1), max(r0, r1)) if steep else (min(c0, c1), max(c0, c1))
    for major in range(low - 1, high + 2):
        share = 0.0 if high == low else ((major - r0) / (r1 - r0) if steep else (major - c0) / (c1 - c0))
        share = min(max(share, 0.0), 1.0)
        middle = c0 + share * (c1 - c0) if steep else r0 + share * (r1 - r0)
        # One pixel across the line is at most the root of two along the minor axis.
        for minor in range(int(np.ceil(middle - 1.5)), int(np.floor(middle + 1.5)) + 1):
            r, c = (major, minor) if steep else (minor, major)
            if not (0 <= r < rows and 0 <= c < cols):
                continue
            along = 0.0 if squared == 0 else ((r - r0) * (r1 - r0) + (c - c0) * (c1 - c0)) / squared
            along = min(max(along, 0.0), 1.0)
            distance = np.hypot(r - r0 - along * (r1 - r0), c - c0 - along * (c1 - c0))
            value = np.uint8(np.rint(LINE_VALUE * max(1.0 - distance, 0.0)))
            if value > scratch[r, c]:
                if scratch[r, c] == 0:
                    touched.append(r * cols + c)
                scratch[r, c] = value
