"""From a skeleton to lines of pixels, by the fringe method of Biagioni and DeepMG.

Strategy
--------
How many branches leave a pixel is read off the ring two pixels away from it, its fringe: the pixels of that ring
which a set pixel of the inner ring connects to the centre, in groups around the circle. A pixel in the middle of a
line has two groups; all others are node pixels, or are isolated. Lines are then burnt away: a fire is lit beside a
node, runs along line pixels depth first, and where it meets another node the way it took is a line. All of this goes
from pixel to neighbouring pixel, so memory follows the length of the skeleton and not the area.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.vectorize.skeleton import skeleton_pixels
from probe2road.vectorize.tracing import PixelGraph, pixel_links

__all__ = ["fringe_branches", "trace_fringe"]

logger = logging.getLogger(__name__)

_STEP_ROW, _STEP_COL = (-1, -1, 0, 1, 1, 1, 0, -1), (0, 1, 1, 1, 0, -1, -1, -1)  # neighbours, clockwise from north
_BESIDE_FIRST = (0, 2, 4, 6, 1, 3, 5, 7)  # neighbours that share a side, then those at the corners
# Place in the ring, clockwise from north-west, of what lies up to two rows and columns away.
_RING = np.array([[0, 1, 2, 3, 4], [15, -1, -1, -1, 5], [14, -1, -1, -1, 6], [13, -1, -1, -1, 7], [12, 11, 10, 9, 8]])


def fringe_branches(skeleton: NDArray[Any]) -> NDArray[np.int64]:
    """Count the branches that leave every pixel of a skeleton.

    Parameters
    ----------
    skeleton
        Shape ``(rows, cols)``; everything that is not zero is skeleton. Outside is background.

    Returns
    -------
    ndarray of int64
        One number for each pixel, in the order of `probe2road.vectorize.skeleton.skeleton_pixels`.

    Examples
    --------
    The last two pixels of a line have one branch: the fringe does not see the end beside it.

    >>> fringe_branches(np.array([[1, 1, 1, 1, 1, 1]])).tolist()
    [1, 1, 2, 2, 1, 1]
    """
    return _branches(pixel_links(*skeleton_pixels(skeleton)))


def trace_fringe(skeleton: NDArray[Any], *, min_length: float = 0.0) -> PixelGraph:
    """Trace a skeleton into lines between nodes.

    Node pixels that touch are one node, at their mean rounded down. Lines that return to their own node are
    dropped, and closed lines without a node are never found: that is the published method.
    `probe2road.vectorize.tracing.trace_pixels` keeps both.

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
    links = pixel_links(row, col)
    branches = _branches(links)
    node = _node_of_pixel(links, (branches == 1) | (branches > 2))
    node_row, node_col = _rounded_means(node, row), _rounded_means(node, col)
    start, stop, sizes, path = _burn(links, branches == 2, node)
    # Every line begins and ends with the position of its node.
    last = np.cumsum(sizes)
    places, ends = np.stack([last - sizes, last], axis=1).reshape(-1), np.stack([start, stop], axis=1).reshape(-1)
    line_row = np.insert(row[path].astype(np.float64), places, node_row[ends])
    line_col = np.insert(col[path].astype(np.float64), places, node_col[ends])
    graph = _long_enough(node_row, node_col, start, stop, sizes + 2, line_row, line_col, min_length)
    logger.info("traced %d pixels into %d nodes and %d lines", len(node), len(graph.node_row), len(graph.start))
    return graph


def _rounded_means(node: NDArray[np.int64], values: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean position of the pixels of every node, rounded down."""
    known = node >= 0
    total = np.bincount(node[known], values[known])
    return np.asarray(np.floor(total / np.bincount(node[known])))


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
    """Drop short lines, and then the nodes without lines."""
    line = np.repeat(np.arange(len(sizes)), sizes)
    step = np.hypot(np.diff(row, prepend=0), np.diff(col, prepend=0))
    step[np.cumsum(sizes) - sizes] = 0.0
    kept = np.bincount(line, step, minlength=len(sizes)) > min_length
    start, stop, sizes, vertex = start[kept], stop[kept], sizes[kept], kept[line]
    used = np.unique(np.concatenate([start, stop]))
    return PixelGraph(
        node_row=node_row[used],
        node_col=node_col[used],
        start=np.searchsorted(used, start),
        stop=np.searchsorted(used, stop),
        row=row[vertex],
        col=col[vertex],
        offsets=np.concatenate([[0], np.cumsum(sizes)]),
    )


@njit(cache=True)
def _branches(links: NDArray[np.int32]) -> NDArray[np.int64]:
    """Count the groups of fringe pixels around every pixel: pixels at two steps' distance, connected in the ring."""
    branches = np.zeros(len(links), np.int64)
    fringe = np.zeros(16, np.bool_)
    for pixel in range(len(links)):
        fringe[:] = False
        for first in range(8):
            inner = links[pixel, first]
            if inner < 0:
                continue
            for second in range(8):
                down, right = _STEP_ROW[first] + _STEP_ROW[second], _STEP_COL[first] + _STEP_COL[second]
                place = _RING[down + 2, right + 2]
                if place >= 0 and links[inner, second] >= 0:
                    fringe[place] = True
        for place in range(16):
            branches[pixel] += fringe[place] and not fringe[place - 1]
    return branches


@njit(cache=True)
def _node_of_pixel(links: NDArray[np.int32], at_node: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the node of every pixel, -1 for none; touching node pixels form one node, numbered by the first pixel."""
    node = np.full(len(links), -1, np.int64)
    count = 0
    for first in range(len(links)):
        if not at_node[first] or node[first] >= 0:
            continue
        node[first] = count
        stack = [first]
        while len(stack) > 0:
            pixel = stack.pop()
            for other in links[pixel]:
                if other >= 0 and at_node[other] and node[other] < 0:
                    node[other] = count
                    stack.append(int(other))
        count += 1
    return node


@njit(cache=True)
def _burn(
    links: NDArray[np.int32], line: NDArray[np.bool_], node: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Follow all lines beside nodes: return start and stop nodes, numbers of pixels, and the pixels between them."""
    unburnt, parent = line.copy(), np.full(len(links), -1, np.int64)
    start, stop, sizes = [0 for _ in range(0)], [0 for _ in range(0)], [0 for _ in range(0)]
    path = [0 for _ in range(0)]
    for pixel in range(len(links)):
        if node[pixel] < 0:
            continue
        for k in _BESIDE_FIRST:
            first = int(links[pixel, k])
            if first < 0 or not unburnt[first]:
                continue
            last, there = _fire(links, unburnt, parent, node, first, node[pixel])
            if last < 0:
                continue
            before = len(path)
            while last >= 0:
                path.append(last)
                last = parent[last]
            path[before:] = path[before:][::-1]
            start.append(node[pixel])
            stop.append(there)
            sizes.append(len(path) - before)
    return np.array(start, np.int64), np.array(stop, np.int64), np.array(sizes, np.int64), np.array(path, np.int64)


@njit(cache=True)
def _fire(
    links: NDArray[np.int32],
    unburnt: NDArray[np.bool_],
    parent: NDArray[np.int64],
    node: NDArray[np.int64],
    first: int,
    origin: int,
) -> tuple[int, int]:
    """Follow a line from a pixel, depth first, until another node is reached.

    Returns the pixel there and the node, both -1 where the fire goes out before; parents lead back to the first pixel.
    """
    unburnt[first], parent[first] = False, -1
    stack = [first]
    while len(stack) > 0:
        pixel = stack.pop()
        for k in _BESIDE_FIRST:
            other = int(links[pixel, k])
            if other >= 0 and node[other] >= 0 and node[other] != origin:
                return pixel, node[other]
        for k in _BESIDE_FIRST[::-1]:  # so that pixels beside come off the stack before those at the corners
            other = int(links[pixel, k])
            if other >= 0 and unburnt[other]:
                unburnt[other], parent[other] = False, pixel
                stack.append(other)
    return -1, -1
