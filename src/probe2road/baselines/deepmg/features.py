"""The features of DeepMG: eleven planes and a table of neighbours for every cell (METHOD 3.1).

Strategy
--------
Traces are thinned first, so that consecutive fixes are some metres apart: the method was made for taxis that report
every half minute, and takes steps of 5 m to 300 m only. Of a fleet that reports ten times a second it would see
nothing. Thinned fixes and their steps are kept as flat arrays for the whole area. The cells of one window are
computed when they are asked for, from the fixes and steps that touch it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.baselines.deepmg.variants import Variant
from probe2road.bounds import NotNegative, Positive
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, TraceGaps, trace_breaks
from probe2road.options import checked
from probe2road.raster.grid import Grid

__all__ = ["COARSE_CELLS", "PLANES", "FeatureOptions", "Steps", "extract_features", "thin_traces"]

COARSE_CELLS = 8  # along each side of the grid of neighbours that is recorded

_DIRECTIONS = ("n", "ne", "e", "se", "s", "sw", "w", "nw")
PLANES = ("points", "lines", "speed", *(f"direction_{name}" for name in _DIRECTIONS))

_REACH = 300.0  # m to each side, of the grid of neighbours
_MAX_SPEED = 34.0  # m/s; faster steps are left out of the speeds
_FULL_POINTS = 2  # fixes that saturate a cell
_INK = 16  # value of the line of one trace, of 255
_BYTE = 256


@dataclass(frozen=True)
@checked
class FeatureOptions:
    """The features with which a network was trained."""

    resolution: Positive[float] = 2.0  # m, side of a cell; the published 1.95 m, rounded
    spacing: NotNegative[float] = 10.0  # m, least distance of fixes that are kept
    min_step: NotNegative[float] = 5.0  # m; shorter steps say nothing about the road
    max_step: NotNegative[float] = 300.0  # m; longer steps say nothing either

    def __post_init__(self) -> None:
        """Refuse lengths that are out of order."""
        if self.min_step >= self.max_step:
            fault = f"min_step is {self.min_step}, max_step is {self.max_step}"
            raise OptionError(fault, where="FeatureOptions", fix="use min_step < max_step")


@dataclass(frozen=True)
class Steps:
    """N thinned fixes, and the steps to some of them from the fix before.

    Attributes
    ----------
    x, y
        Shape (N,), m.
    trace
        Shape (N,), number of the trace.
    starts
        Shape (R + 1,): runs of fixes without a gap; run r has the fixes ``starts[r]`` to ``starts[r + 1]``.
    valid
        Shape (N,), bool: whether there is a step to the fix, of a length that counts.
    seconds
        Shape (N,): duration of that step; NaN without a clock.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    trace: NDArray[np.int64]
    starts: NDArray[np.int64]
    valid: NDArray[np.bool_]
    seconds: NDArray[np.float64]


def thin_traces(fleet: Fleet, options: FeatureOptions | None = None, *, gaps: TraceGaps | None = None) -> Steps:
    """Thin the traces of a fleet to fixes at a given distance (m), and list the steps between them.

    Fixes are left out, never interpolated. A fleet without fixes gives no steps.

    Parameters
    ----------
    fleet
        The fleet; semantic points are not used.
    options
        None takes the defaults.
    gaps
        Where traces are broken.

    Notes
    -----
    METHOD 3.3, item 4.

    Examples
    --------
    >>> import pandas as pd
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> table = pd.DataFrame({"trace_id": 1, "t": range(6), "x": [0.0, 4, 11, 15, 22, 400], "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> steps = thin_traces(fleet)
    >>> steps.x.tolist(), steps.valid.tolist(), steps.starts.tolist()
    ([0.0, 11.0, 22.0, 400.0], [False, True, True, False], [0, 3, 4])
    """
    options = options or FeatureOptions()
    x, y = (np.ascontiguousarray(fleet.traces[axis].to_numpy(np.float64)) for axis in "xy")
    breaks = trace_breaks(fleet, gaps)
    kept = np.flatnonzero(_spaced(x, y, breaks, options.spacing))
    run = np.cumsum(breaks)[kept] - 1
    first = np.diff(run, prepend=-1) != 0
    x, y = x[kept], y[kept]
    length = np.hypot(np.diff(x, prepend=0.0), np.diff(y, prepend=0.0))
    time = fleet.traces["t"].to_numpy(dtype="datetime64[ns]")[kept]
    seconds = np.diff(time, prepend=np.datetime64("NaT", "ns")) / np.timedelta64(1, "s")
    return Steps(
        x=x,
        y=y,
        trace=fleet.owner[kept],
        starts=np.append(np.flatnonzero(first), len(kept)),
        valid=~first & (length > options.min_step) & (length < options.max_step),
        seconds=np.where(first, np.nan, seconds),
    )


def extract_features(steps: Steps, grid: Grid, variant: Variant) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Compute the features of the cells of a grid.

    Parameters
    ----------
    steps
        Thinned traces of any extent.
    grid
        The cells.
    variant
        Decides how counts are scaled and which neighbours are recorded.

    Returns
    -------
    ndarray of float32, shape (11, rows, cols)
        The planes in the order of `PLANES`: fixes, traces, mean speed (-1 where unknown) and shares of directions.
    ndarray of uint8, shape (16, rows, cols)
        128 bits for each cell, packed along the first axis. The first 64 tell in which of 8 x 8 cells around it
        (rows from north to south) traces were at the next fix, the others where they were at the fix before.

    Notes
    -----
    METHOD 3.1; items 2 and 5 of METHOD 3.3 are decided by the variant.
    """
    rows, cols = grid.shape
    row, col = grid.rowcol(steps.x, steps.y)
    cell = np.where((row >= 0) & (row < rows) & (col >= 0) & (col < cols), row * cols + col, -1)
    stop = _near(steps, grid)
    count = np.bincount(cell[cell >= 0], minlength=rows * cols)
    ink = _ink(steps, stop, grid)
    planes = np.empty((len(PLANES), rows * cols), np.float32)
    planes[0] = np.minimum(count / _FULL_POINTS, 1.0) if variant.saturate else np.log10(1.0 + count)
    planes[1] = np.minimum(ink, 255.0) / 255.0 if variant.saturate else np.log10(1.0 + ink / _INK)
    planes[2] = _speeds(steps, stop, cell, rows * cols)
    planes[3:] = _directions(steps, stop, cell, rows * cols, wraps=variant.saturate)
    neighbours = _neighbours(steps, stop, cell, grid, variant.local_cells)
    return planes.reshape(-1, rows, cols), neighbours.reshape(-1, rows, cols)


def _near(steps: Steps, grid: Grid) -> NDArray[np.int64]:
    """List the fixes whose step may touch the grid, including the half cell of ink on either side."""
    left, bottom, right, top = grid.bounds
    stop = np.flatnonzero(steps.valid)
    touching = np.ones(len(stop), bool)
    for place, low, high in ((steps.x, left, right), (steps.y, bottom, top)):
        touching &= np.maximum(place[stop - 1], place[stop]) >= low - grid.resolution
        touching &= np.minimum(place[stop - 1], place[stop]) <= high + grid.resolution
    return stop[touching]


def _ink(steps: Steps, stop: NDArray[np.int64], grid: Grid) -> NDArray[np.float64]:
    """Return the ink of all traces in each cell, shape (cells,)."""
    ink = np.zeros(grid.shape)
    col, row = (steps.x - grid.left) / grid.resolution - 0.5, (grid.top - steps.y) / grid.resolution - 0.5
    _draw_traces(col[stop - 1], row[stop - 1], col[stop], row[stop], steps.trace[stop], ink)
    return ink.ravel()


@njit(cache=True)
def _spaced(
    x: NDArray[np.float64], y: NDArray[np.float64], breaks: NDArray[np.bool_], spacing: float
) -> NDArray[np.bool_]:
    """Mark the first fix of every run, and fixes at least the spacing (m) away from the last marked fix."""
    kept = breaks.copy()
    last = 0
    for i in range(len(x)):
        kept[i] |= np.hypot(x[i] - x[last], y[i] - y[last]) >= spacing
        if kept[i]:
            last = i
    return kept


def _speeds(steps: Steps, stop: NDArray[np.int64], cell: NDArray[np.int64], n_cells: int) -> NDArray[np.float64]:
    """Return the mean speed of the steps that start in each cell, from -1 (0 m/s, or unknown) to 1 (34 m/s)."""
    start = cell[stop - 1]
    length = np.hypot(steps.x[stop] - steps.x[stop - 1], steps.y[stop] - steps.y[stop - 1])
    with np.errstate(divide="ignore"):
        speed = length / steps.seconds[stop]
    used = (start >= 0) & (speed <= _MAX_SPEED)  # a NaN is not
    total = np.bincount(start[used], weights=speed[used], minlength=n_cells)
    count = np.bincount(start[used], minlength=n_cells)
    return (total / np.maximum(count, 1) / _MAX_SPEED - 0.5) * 2.0


def _directions(
    steps: Steps, stop: NDArray[np.int64], cell: NDArray[np.int64], n_cells: int, *, wraps: bool
) -> NDArray[np.float64]:
    """Return the share of each of eight directions in the steps that start in each cell, shape (8, cells).

    Counts of the published code are bytes, which start again at 0 after 255.
    """
    start = cell[stop - 1]
    bearing = np.degrees(np.arctan2(steps.x[stop] - steps.x[stop - 1], steps.y[stop] - steps.y[stop - 1]))
    direction = ((bearing + 22.5) % 360.0 // 45.0).astype(np.int64)
    inside = start >= 0
    count = np.bincount(direction[inside] * n_cells + start[inside], minlength=8 * n_cells).reshape(8, n_cells)
    count = count % _BYTE if wraps else count
    return count / np.maximum(count.sum(axis=0), 1)


def _neighbours(
    steps: Steps, stop: NDArray[np.int64], cell: NDArray[np.int64], grid: Grid, local_cells: int
) -> NDArray[np.uint8]:
    """Return, packed as bits, from and to which neighbours traces went, shape (16, cells)."""
    flags = np.zeros((2 * COARSE_CELLS**2, grid.rows * grid.cols), bool)
    for first_bit, here, other in ((0, stop - 1, stop), (COARSE_CELLS**2, stop, stop - 1)):
        inside = cell[here] >= 0
        own, there = cell[here][inside], other[inside]
        centre_x, centre_y = grid.xy(own // grid.cols, own % grid.cols)
        col = np.floor((steps.x[there] - centre_x + _REACH) * local_cells / (2 * _REACH)).astype(np.int64)
        row = np.floor((centre_y - steps.y[there] + _REACH) * local_cells / (2 * _REACH)).astype(np.int64)
        known = (np.minimum(row, col) >= 0) & (np.maximum(row, col) < COARSE_CELLS)
        flags[first_bit + (row * COARSE_CELLS + col)[known], own[known]] = True
    return np.packbits(flags, axis=0)


@njit(cache=True)
def _draw_traces(
    col0: NDArray[np.float64],
    row0: NDArray[np.float64],
    col1: NDArray[np.float64],
    row1: NDArray[np.float64],
    trace: NDArray[np.int64],
    ink: NDArray[np.float64],
) -> None:
    """Add the anti-aliased lines of traces to ink ``(rows, cols)``; each trace adds its darkest ink of each cell.

    Places are in cells from the centre of the top left cell. Steps are sorted by trace. For each column of a flat
    step (row of a steep one) the two cells beside the line share the ink by their distances from it (Wu 1991).
    """
    rows, cols = ink.shape
    seen = np.full((rows, cols), -1, np.int64)
    own = np.zeros((rows, cols))
    for step in range(len(trace)):
        steep = abs(row1[step] - row0[step]) > abs(col1[step] - col0[step])
        a0, b0 = (row0[step], col0[step]) if steep else (col0[step], row0[step])
        a1, b1 = (row1[step], col1[step]) if steep else (col1[step], row1[step])
        if a0 > a1:
            a0, b0, a1, b1 = a1, b1, a0, b0
        slope = (b1 - b0) / (a1 - a0)
        for a in range(max(int(np.rint(a0)), 0), min(int(np.rint(a1)), (rows if steep else cols) - 1) + 1):
            b = b0 + slope * (a - a0)
            low = int(np.floor(b))
            for side in range(2):
                row, col = (a, low + side) if steep else (low + side, a)
                if row < 0 or row >= rows or col < 0 or col >= cols:
                    continue
                value = np.rint(_INK * (1.0 - abs(b - (low + side))))
                if seen[row, col] != trace[step]:
                    seen[row, col], own[row, col] = trace[step], 0.0
                ink[row, col] += max(value - own[row, col], 0.0)
                own[row, col] = max(value, own[row, col])
