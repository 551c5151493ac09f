"""Lines drawn into a grid: masks of road graphs."""

from __future__ import annotations

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

from probe2road.crs import require_same_crs
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.raster.grid import Grid

__all__ = ["draw_lines", "label_mask"]


def label_mask(graph: RoadGraph, grid: Grid, *, width: int = 1) -> NDArray[np.uint8]:
    """Draw the edges of a graph as lines: 1 on a line, 0 elsewhere.

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
    """Draw lines that are in pixel coordinates already; see `label_mask`.

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


@njit(cache=True)
def _draw(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    owner: NDArray[np.int64],
    before: int,
    after: int,
    mask: NDArray[np.uint8],
) -> None:
    """Set the pixels of Bresenham's lines between the vertices of each owner, and ``before``/``after`` around them.

    Every line is drawn from its northern (then western) end, so that it does not matter which way an edge runs.
    """
    for k in range(1, len(row)):
        if owner[k] != owner[k - 1]:
            continue
        a, b = k - 1, k
        if row[a] > row[b] or (row[a] == row[b] and col[a] > col[b]):
            a, b = b, a
        r, c = row[a], col[a]
        d_row, d_col = row[b] - row[a], abs(col[b] - col[a])
        east = 1 if col[b] >= col[a] else -1
        steps, minor = max(d_row, d_col), min(d_row, d_col)
        error = steps // 2
        for _ in range(steps + 1):
            for i in range(max(r - before, 0), min(r + after + 1, mask.shape[0])):
                for j in range(max(c - before, 0), min(c + after + 1, mask.shape[1])):
                    mask[i, j] = 1
            error -= minor
            slip = error < 0
            error += steps if slip else 0
            r += 1 if d_row > d_col or slip else 0
            c += east if d_row <= d_col or slip else 0
