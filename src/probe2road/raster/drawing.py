"""Lines drawn into pixel arrays: label masks of road graphs, and traces."""

from __future__ import annotations

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.crs import require_same_crs
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.grid import Grid

__all__ = ["draw_line", "draw_lines", "label_mask"]

_KEEP_NOTHING = np.uint8(0)  # pixels on a line become 1, whatever they were


def label_mask(graph: RoadGraph, grid: Grid, *, width: int = 1) -> NDArray[np.uint8]:
    """Draw the edges of a graph as a mask: 1 on a line, 0 elsewhere.

    Lines of width 1 are Bresenham's, one pixel wide and connected over edges and corners of pixels. Wider lines are
    those dilated to a square of so many pixels (an even width reaches one pixel further up and left). What lies
    outside the grid is left out.

    Parameters
    ----------
    graph
        In the CRS of the grid.
    grid
        Where to draw.
    width
        Pixels.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)

    Raises
    ------
    CRSError
        If graph and grid are in different CRS.
    OptionError
        If the width is below 1.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(900.5, 0.5), (902.5, 0.5), (904.5, 2.5)]], crs="EPSG:32616")
    >>> label_mask(graph, Grid.from_bounds(graph.bounds, crs=graph.crs))
    array([[0, 0, 0, 0, 1],
           [0, 0, 0, 1, 0],
           [1, 1, 1, 0, 0]], dtype=uint8)
    """
    require_same_crs(graph.crs, grid.crs, where="label_mask", what=("the graph is", "the grid is"))
    xy, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), return_index=True)
    return draw_lines(*grid.rowcol(xy[:, 0], xy[:, 1]), owner, grid.shape, width=width)


def draw_lines(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    owner: NDArray[np.int64],
    shape: tuple[int, int],
    *,
    width: int = 1,
) -> NDArray[np.uint8]:
    """Draw lines that are already in pixel coordinates; see `label_mask`.

    Parameters
    ----------
    row, col
        Pixels of v vertices; they may lie outside.
    owner
        Line of each vertex, shape ``(v,)``; the vertices of a line follow each other.
    shape
        ``(rows, cols)`` of the mask.
    width
        Pixels.

    Returns
    -------
    ndarray of uint8, shape (rows, cols)

    Raises
    ------
    OptionError
        If the width is below 1.

    Examples
    --------
    >>> draw_lines(np.array([0, 0]), np.array([1, 3]), np.array([5, 5]), (2, 4), width=2)
    array([[1, 1, 1, 1],
           [0, 0, 0, 0]], dtype=uint8)
    """
    if width < 1:
        raise OptionError(f"width is {width}", where="draw_lines", fix="use 1 pixel or more")
    mask = np.zeros(shape, np.uint8)
    _draw(row, col, owner.astype(np.int64), width // 2, (width - 1) // 2, mask)
    return mask


@njit(inline="always")
def draw_line(
    ends: tuple[int, int, int, int],
    before: int,
    after: int,
    values: NDArray[np.unsignedinteger],
    keep: np.unsignedinteger,
) -> bool:
    """Draw Bresenham's line between two pixels (both included) into an array; pixels outside are ignored.

    Every line is drawn from its northern (then western) end, because Bresenham's choice of pixels is not symmetric:
    so it does not matter which way an edge runs or a trace was driven. The line has ``n`` steps along its major axis,
    of which ``m`` also step along the minor axis: whenever the error, started at n / 2 and reduced by m each step,
    falls below zero and is raised by n again.

    The code is copied into its callers, so that what is constant there (a width of one pixel, what is kept) costs
    nothing.

    Parameters
    ----------
    ends
        Row and column of one end, then of the other.
    before, after
        Pixels up and left, and down and right, to which each pixel of the line is widened.
    values
        Shape ``(rows, cols)``, contiguous, changed in place: one is added to ``values & keep`` in every pixel.
    keep
        Of the type of the values: all bits to count lines, 0 to draw ones.

    Returns
    -------
    bool
        Whether the whole line lies inside.
    """
    rows, cols = values.shape
    r0, c0, r1, c1 = ends
    if r0 > r1 or (r0 == r1 and c0 > c1):
        r0, c0, r1, c1 = r1, c1, r0, c0
    d_row, d_col, east = r1 - r0, abs(c1 - c0), 1 if c1 >= c0 else -1
    steep = d_row > d_col
    n, m = (d_row, d_col) if steep else (d_col, d_row)
    error = n >> 1
    inside = r0 >= before and r1 + after < rows and min(c0, c1) >= before and max(c0, c1) + after < cols
    if inside:
        major, minor = (cols, east) if steep else (east, cols)
        pixels = values.reshape(-1)
        pixel = r0 * cols + c0
        for _ in range(n + 1):
            for i in range(-before, after + 1):
                for j in range(-before, after + 1):
                    pixels[pixel + i * cols + j] = (pixels[pixel + i * cols + j] & keep) + np.uint8(1)
            error -= m
            below = error >> 63  # -1 below zero, else 0: no branch to mispredict
            error += n & below
            pixel += major + (minor & below)
    else:
        r, c = r0, c0
        for _ in range(n + 1):
            if r + after >= 0 and r - before < rows and c + after >= 0 and c - before < cols:
                for i in range(max(r - before, 0), min(r + after + 1, rows)):
                    for j in range(max(c - before, 0), min(c + after + 1, cols)):
                        values[i, j] = (values[i, j] & keep) + np.uint8(1)
            error -= m
            slip = error < 0
            error += n if slip else 0
            r += 1 if steep or slip else 0
            c += east if not steep or slip else 0
    return inside


@njit(cache=True)
def _draw(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    owner: NDArray[np.int64],
    before: int,
    after: int,
    mask: NDArray[np.uint8],
) -> None:
    """Draw lines between the vertices of each owner, widened by ``before`` and ``after`` pixels."""
    for k in range(1, len(row)):
        if owner[k] == owner[k - 1]:
            draw_line((row[k - 1], col[k - 1], row[k], col[k]), before, after, mask, _KEEP_NOTHING)
