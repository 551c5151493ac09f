"""Skeleton to lines of pixels by the fringe method of Biagioni and DeepMG.

Strategy
--------
How many branches leave a pixel is read off the ring two pixels away from it, its fringe: the pixels of that ring
which a set pixel of the inner ring connects to the centre, in groups around the circle. A pixel in the middle of a
line has two groups; all others are node pixels, or are isolated. Lines are then burnt away: a fire is lit beside a
node, runs along line pixels depth first, and where it meets another node the way it took is a line.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.skeleton import skeleton_pixels
from probe2road.tracing import PixelGraph

__all__ = ["fringe_branches", "trace_fringe"]

logger = logging.getLogger(__name__)

_EMPTY, _LINE, _UNNUMBERED = 0, -1, -2  # kinds of pixels; those of a node have its number plus one
_STEP_ROW, _STEP_COL = (-1, 0, 1, 0, -1, -1, 1, 1), (0, 1, 0, -1, -1, 1, 1, -1)  # neighbours, those beside first


def fringe_branches(skeleton: NDArray[Any]) -> NDArray[np.int64]:
    """Count the branches that leave every pixel of a skeleton.

    Parameters
    ----------
    skeleton
        Shape ``(rows, cols)``; everything that is not zero is skeleton. Outside is background.

    Returns
    -------
    ndarray of int64
        One number for each pixel, in the order of `probe2road.skeleton.skeleton_pixels`.

    Examples
    --------
    The last two pixels of a line have one branch: the fringe does not see the end beside it.

    >>> fringe_branches(np.array([[1, 1, 1, 1, 1, 1]])).tolist()
    [1, 1, 2, 2, 1, 1]
    """
    row, col = skeleton_pixels(skeleton)
    padded = np.zeros((skeleton.shape[0] + 4, skeleton.shape[1] + 4), bool)
    padded[row + 2, col + 2] = True
    return _branches(padded, row + 2, col + 2)


def trace_fringe(skeleton: NDArray[Any], *, min_length: float = 0.0) -> PixelGraph:
    """Trace a skeleton into lines between nodes.

    Node pixels that touch are one node, at their mean rounded down. Lines that return to their own node are
    dropped, and closed lines without a node are never found: that is the published method.
    `probe2road.tracing.trace_pixels` keeps both.

    Parameters
    ----------
    skeleton
        Shape ``(rows, cols)``, thinned; everything that is not zero is skeleton.
    min_length
        Lines up to this long, in pixels along their vertices, are dropped.

    Returns
    -------
    PixelGraph
        Lines start and stop at their nodes; nodes without lines are left out.

    Notes
    -----
    METHOD 3.5 and 4.3. The published programs start one line at most from every node pixel and lose parallel lines;
    here a fire is lit at every line pixel beside a node.

    Examples
    --------
    >>> graph = trace_fringe(np.eye(9, dtype=bool))
    >>> graph.node_row.tolist(), graph.start.tolist(), graph.stop.tolist(), graph.row.tolist()
    ([0.0, 7.0], [0], [1], [0.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
    """
    row, col = skeleton_pixels(skeleton)
    branches = fringe_branches(skeleton)
    kind = np.zeros((skeleton.shape[0] + 2, skeleton.shape[1] + 2), np.int32)
    kind[row[branches == 2] + 1, col[branches == 2] + 1] = _LINE
    at_node = (branches == 1) | (branches > 2)
    node_row, node_col = _number_nodes(kind, row[at_node] + 1, col[at_node] + 1)
    start, stop, sizes, path_row, path_col = _burn(kind, row[at_node] + 1, col[at_node] + 1, node_row, node_col)
    graph = _long_enough(node_row, node_col, start, stop, sizes, path_row, path_col, min_length)
    logger.info("traced %d pixels into %d nodes and %d lines", len(row), len(graph.node_row), len(graph.start))
    return graph


def _long_enough(
    node_row: NDArray[np.float64],
    node_col: NDArray[np.float64],
    start: NDArray[np.int64],
    stop: NDArray[np.int64],
    sizes: NDArray[np.int64],
    row: NDArray[np.float64],
    col: NDArray[np.float64],
    min_length: float,
) -> PixelGraph:
    """Drop short lines and then nodes without lines, and take off the frame of one pixel."""
    line = np.repeat(np.arange(len(sizes)), sizes)
    step = np.hypot(np.diff(row, prepend=0), np.diff(col, prepend=0))
    step[np.cumsum(sizes) - sizes] = 0.0
    kept = np.bincount(line, step, minlength=len(sizes)) > min_length
    start, stop, sizes, vertex = start[kept], stop[kept], sizes[kept], kept[line]
    used = np.unique(np.concatenate([start, stop]))
    return PixelGraph(
        node_row=node_row[used] - 1,
        node_col=node_col[used] - 1,
        start=np.searchsorted(used, start),
        stop=np.searchsorted(used, stop),
        row=row[vertex] - 1,
        col=col[vertex] - 1,
        offsets=np.concatenate([[0], np.cumsum(sizes)]),
    )


@njit(cache=True)
def _branches(padded: NDArray[np.bool_], row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the groups of fringe pixels around pixels of a skeleton that is padded by two."""
    ring_row = np.array([-2, -2, -2, -2, -2, -1, 0, 1, 2, 2, 2, 2, 2, 1, 0, -1])  # clockwise from north-west
    ring_col = np.array([-2, -1, 0, 1, 2, 2, 2, 2, 2, 1, 0, -1, -2, -2, -2, -2])
    branches = np.zeros(len(row), np.int64)
    fringe = np.zeros(16, np.bool_)
    for pixel in range(len(row)):
        for k in range(16):
            fringe[k] = False
            if not padded[row[pixel] + ring_row[k], col[pixel] + ring_col[k]]:
                continue
            # Inner pixels that touch this one: one at a corner, else two or three.
            for r in range(max(ring_row[k] - 1, -1), min(ring_row[k] + 1, 1) + 1):
                for c in range(max(ring_col[k] - 1, -1), min(ring_col[k] + 1, 1) + 1):
                    fringe[k] |= (r != 0 or c != 0) and padded[row[pixel] + r, col[pixel] + c]
        for k in range(16):
            branches[pixel] += fringe[k] and not fringe[k - 1]
    return branches


@njit(cache=True)
def _number_nodes(
    kind: NDArray[np.int32], row: NDArray[np.int64], col: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Write the number of its node plus one into every node pixel; return the nodes' means, rounded down."""
    for pixel in range(len(row)):
        kind[row[pixel], col[pixel]] = _UNNUMBERED
    node_row, node_col = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for pixel in range(len(row)):
        if kind[row[pixel], col[pixel]] != _UNNUMBERED:
            continue
        number = len(node_row) + 1
        kind[row[pixel], col[pixel]] = number
        members = [(row[pixel], col[pixel])]
        place = 0
        while place < len(members):
            r, c = members[place]
            place += 1
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    if kind[r + dr, c + dc] == _UNNUMBERED:
                        kind[r + dr, c + dc] = number
                        members.append((r + dr, c + dc))
        total_row = total_col = 0
        for r, c in members:
            total_row, total_col = total_row + r, total_col + c
        node_row.append(float(total_row // len(members)))
        node_col.append(float(total_col // len(members)))
    return np.array(node_row, np.float64), np.array(node_col, np.float64)


@njit(cache=True)
def _burn(
    kind: NDArray[np.int32],
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    node_row: NDArray[np.float64],
    node_col: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Burn all lines beside node pixels: start and stop nodes, numbers of vertices, and the vertices."""
    start, stop, sizes = [0 for _ in range(0)], [0 for _ in range(0)], [0 for _ in range(0)]
    path_row, path_col = [0.0 for _ in range(0)], [0.0 for _ in range(0)]
    for pixel in range(len(row)):
        here = int(kind[row[pixel], col[pixel]]) - 1
        for k in range(8):
            r, c = row[pixel] + _STEP_ROW[k], col[pixel] + _STEP_COL[k]
            if kind[r, c] != _LINE:
                continue
            there, way_row, way_col = _fire(kind, r, c, here)
            if there < 0:
                continue
            start.append(here)
            stop.append(there)
            sizes.append(len(way_row) + 2)
            path_row.append(node_row[here])
            path_col.append(node_col[here])
            for place in range(len(way_row) - 1, -1, -1):
                path_row.append(float(way_row[place]))
                path_col.append(float(way_col[place]))
            path_row.append(node_row[there])
            path_col.append(node_col[there])
    return (
        np.array(start, np.int64), np.array(stop, np.int64), np.array(sizes, np.int64),
        np.array(path_row, np.float64), np.array(path_col, np.float64),
    )  # fmt: skip


@njit(cache=True)
def _fire(kind: NDArray[np.int32], row: int, col: int, origin: int) -> tuple[int, list[int], list[int]]:
    """Burn line pixels depth first until another node is beside the fire; that node and the way back from it.

    The node is -1 where the fire goes out before.
    """
    rows, cols, parent = [row], [col], [-1]
    stack = [0]
    kind[row, col] = _EMPTY
    way_row, way_col = [0 for _ in range(0)], [0 for _ in range(0)]
    while len(stack) > 0:
        place = stack.pop()
        r, c = rows[place], cols[place]
        for k in range(8):
            there = int(kind[r + _STEP_ROW[k], c + _STEP_COL[k]]) - 1
            if there >= 0 and there != origin:
                while place >= 0:
                    way_row.append(rows[place])
                    way_col.append(cols[place])
                    place = parent[place]
                return there, way_row, way_col
        for k in range(7, -1, -1):  # so that pixels beside come off the stack before those at the corners
            r_next, c_next = r + _STEP_ROW[k], c + _STEP_COL[k]
            if kind[r_next, c_next] == _LINE:
                kind[r_next, c_next] = _EMPTY
                rows.append(r_next)
                cols.append(c_next)
                parent.append(place)
                stack.append(len(rows) - 1)
    return -1, way_row, way_col
