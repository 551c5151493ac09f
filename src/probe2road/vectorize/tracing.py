"""From a skeleton to a multigraph of pixel lines.

Strategy
--------
The skeleton is a sparse set of pixels sorted by row and column, so memory follows the length of the roads and
not the area. Two pixels are linked when they share a side, or when they touch at a corner and no third pixel
joins them: a staircase is then an ordinary path. Pixels with two links form lines, all others are nodes;
junction pixels that touch are one node. Nothing depends on where the pixels lie, only on how they lie to each
other.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.errors import InputError

__all__ = ["PixelGraph", "pixel_links", "trace_pixels"]

logger = logging.getLogger(__name__)

_REACH = 1.4143  # px; a node stands for pixels no farther than a diagonal step


@dataclass(frozen=True)
class PixelGraph:
    """The result of `trace_pixels`: nodes, and lines of pixels between them.

    Rows and columns count from the centre of the top left pixel and may be fractional at nodes. N nodes,
    L lines, P vertices of all lines one after the other.

    Attributes
    ----------
    node_row, node_col
        Shape (N,). Where the nodes are.
    start, stop
        Shape (L,), int64. The nodes at which the lines start and stop.
    row, col
        Shape (P,). The vertices; the first and last of a line are its nodes.
    offsets
        Shape (L + 1,), int64. Line i has the vertices ``offsets[i]`` up to ``offsets[i + 1]``.
    """

    node_row: NDArray[np.float64]
    node_col: NDArray[np.float64]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]
    row: NDArray[np.float64]
    col: NDArray[np.float64]
    offsets: NDArray[np.int64]


def trace_pixels(row: NDArray[np.int64], col: NDArray[np.int64]) -> PixelGraph:
    """Trace the pixels of a skeleton into a multigraph of pixel lines.

    Junction pixels that touch (crossing number 3 and more, and squares of 2 x 2) become one node at their
    centroid, unless they reach farther than a diagonal step from it: then each is a node. Dead ends are nodes.
    A closed line without junctions gets one node, its first pixel in reading order. Loops and parallel lines are
    kept. Every pixel lies within a diagonal step of a line, except isolated pixels and squares of 2 x 2, which
    have no direction: they are dropped and counted in the log.

    Parameters
    ----------
    row, col
        The pixels, each once, sorted by row and then column, as `probe2road.vectorize.skeleton.skeleton_pixels` lists
        them.

    Returns
    -------
    PixelGraph
        Nodes in reading order of their first pixel, then those of closed lines. Moving all pixels by the same
        step moves the result by this step.

    Raises
    ------
    InputError
        If the pixels are not sorted or not unique.

    Notes
    -----
    METHOD 0.1 row 14. The fringe walk of DeepMG and Biagioni (METHOD 3.5) loses loops and parallel edges; this
    one does not.

    Examples
    --------
    A T of five pixels has one junction and three dead ends:

    >>> from probe2road.vectorize.skeleton import skeleton_pixels
    >>> graph = trace_pixels(*skeleton_pixels(np.array([[1, 1, 1], [0, 1, 0], [0, 1, 0]])))
    >>> graph.start.tolist(), graph.stop.tolist()
    ([0, 1, 1], [1, 2, 3])
    """
    row, col = np.asarray(row, np.int64), np.asarray(col, np.int64)
    step_row, step_col = np.diff(row), np.diff(col)
    if ((step_row < 0) | ((step_row == 0) & (step_col <= 0))).any():
        raise InputError("pixels are not sorted by row and column, or repeat", where="trace_pixels")
    links = pixel_links(row, col)
    kept, junction = _kept_links(links)
    node, node_row, node_col = _nodes(row, col, links, kept, junction)
    start, stop, sizes, path, seen = _lines(row, col, links, kept, node, node_row, node_col)
    ring, ring_sizes, ring_path = _rings(links, kept, seen)
    ring_node = len(node_row) + np.arange(len(ring))
    path = np.concatenate([path, ring_path])
    node_row, node_col = np.append(node_row, row[ring]), np.append(node_col, col[ring])
    graph = _with_line_ends(
        PixelGraph(
            node_row=node_row,
            node_col=node_col,
            start=np.append(start, ring_node),
            stop=np.append(stop, ring_node),
            row=row[path].astype(np.float64),
            col=col[path].astype(np.float64),
            offsets=np.concatenate([[0], np.cumsum(np.append(sizes, ring_sizes))]),
        )
    )
    n_nodes = len(graph.node_row)
    logger.info(
        "traced %d pixels into %d nodes and %d lines, dropped %d isolated spots",
        len(row),
        n_nodes,
        len(start),
        len(node_row) - n_nodes,
    )
    return graph


def _with_line_ends(graph: PixelGraph) -> PixelGraph:
    """Add the nodes at both ends of every line to its pixels, and drop nodes without lines."""
    used = np.zeros(len(graph.node_row), bool)
    used[graph.start], used[graph.stop] = True, True
    number = np.cumsum(used) - 1
    heads, tails = graph.offsets[:-1], graph.offsets[1:]
    places = np.stack([heads, tails], axis=1).reshape(-1)
    ends = np.stack([graph.start, graph.stop], axis=1).reshape(-1)
    return PixelGraph(
        node_row=graph.node_row[used],
        node_col=graph.node_col[used],
        start=number[graph.start],
        stop=number[graph.stop],
        row=np.insert(graph.row, places, graph.node_row[ends]),
        col=np.insert(graph.col, places, graph.node_col[ends]),
        offsets=graph.offsets + 2 * np.arange(len(graph.offsets)),
    )


@njit(cache=True)
def pixel_links(row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the eight neighbours of every pixel, clockwise from north, -1 for none; shape (n, 8).

    One pointer runs along the row above, so that all neighbours are found in one pass over the sorted pixels.
    """
    n_pixels = len(row)
    links = np.full((n_pixels, 8), -1, np.int32)
    above = 0
    for pixel in range(n_pixels):
        r, c = row[pixel], col[pixel]
        if pixel > 0 and row[pixel - 1] == r and col[pixel - 1] == c - 1:
            links[pixel, 6], links[pixel - 1, 2] = pixel - 1, pixel
        while row[above] < r - 1 or (row[above] == r - 1 and col[above] < c - 1):
            above += 1
        other = above
        while row[other] == r - 1 and col[other] <= c + 1:
            turn = col[other] - c  # -1, 0, 1: north-west, north, north-east
            links[pixel, turn % 8], links[other, 4 + turn] = other, pixel
            other += 1
    return links


@njit(cache=True)
def _kept_links(links: NDArray[np.int32]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Drop diagonal links between pixels that a third pixel connects; tell which pixels are junctions.

    What is left of the links of a pixel of a thin line is its crossing number. The pixels of a full square of
    2 x 2 count as junctions too: their links go around the square and nowhere else.
    """
    n_pixels = len(links)
    kept = links >= 0
    junction = np.zeros(n_pixels, np.bool_)
    for pixel in range(n_pixels):
        count = 0
        for k in range(0, 8, 2):
            before, after = links[pixel, k] >= 0, links[pixel, (k + 2) % 8] >= 0
            if kept[pixel, k + 1] and (before or after):
                kept[pixel, k + 1] = False
                junction[pixel] |= before and after
            count += kept[pixel, k] + kept[pixel, k + 1]
        junction[pixel] |= count > 2
    return kept, junction


@njit(cache=True)
def _nodes(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    links: NDArray[np.int32],
    kept: NDArray[np.bool_],
    junction: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the node of every pixel, -1 for none, and the centroid of every node."""
    n_pixels = len(row)
    node = np.full(n_pixels, -1)
    node_row, node_col = np.empty(n_pixels), np.empty(n_pixels)
    n_nodes = 0
    for first in range(n_pixels):
        if node[first] >= 0 or (not junction[first] and kept[first].sum() == 2):
            continue
        node[first] = n_nodes
        cluster = [first]
        place = 0
        while junction[first] and place < len(cluster):
            for other in links[cluster[place]]:
                if other >= 0 and junction[other] and node[other] < 0:
                    node[other] = n_nodes
                    cluster.append(other)
            place += 1
        members = np.array(cluster)
        r, c = row[members].mean(), col[members].mean()
        if (np.hypot(row[members] - r, col[members] - c) <= _REACH).all():
            node_row[n_nodes], node_col[n_nodes] = r, c
            n_nodes += 1
            continue
        for member in np.sort(members):
            node[member], node_row[n_nodes], node_col[n_nodes] = n_nodes, row[member], col[member]
            n_nodes += 1
    return node, node_row[:n_nodes].copy(), node_col[:n_nodes].copy()


@njit(cache=True)
def _lines(
    row: NDArray[np.int64],
    col: NDArray[np.int64],
    links: NDArray[np.int32],
    kept: NDArray[np.bool_],
    node: NDArray[np.int64],
    node_row: NDArray[np.float64],
    node_col: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Follow the lines between nodes: return their start, stop, sizes and inner pixels, and which pixels were seen.

    A loop whose pixels all lie within reach of its node runs around a hole of a pixel: the node stands for it.
    """
    most = kept[node >= 0].sum()
    start, stop, sizes = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    path = np.empty(len(row), np.int64)
    seen = node >= 0
    n_lines = filled = 0
    for first in range(len(row)):
        here = node[first]
        if here < 0:
            continue
        for k in range(8):
            second = links[first, k]
            if not kept[first, k] or (node[second] < 0 and seen[second]):
                continue
            if node[second] >= 0 and (node[second] == here or second < first):
                continue
            size, last = _walk(first, second, links, kept, seen, path, filled)
            inside = path[filled : filled + size]
            near = np.hypot(row[inside] - node_row[here], col[inside] - node_col[here]) <= _REACH
            if node[last] == here and near.all():
                continue
            start[n_lines], stop[n_lines], sizes[n_lines] = here, node[last], size
            n_lines += 1
            filled += size
    return start[:n_lines], stop[:n_lines], sizes[:n_lines], path[:filled], seen


@njit(cache=True)
def _rings(
    links: NDArray[np.int32], kept: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Follow the closed lines without a node: return their first pixels, and the sizes and pixels of the rest."""
    ring, sizes = np.empty(len(seen) // 4 + 1, np.int64), np.empty(len(seen) // 4 + 1, np.int64)
    path = np.empty(len(seen), np.int64)
    n_rings = filled = 0
    for first in range(len(seen)):
        if seen[first]:
            continue
        seen[first] = True
        second = links[first, int(np.argmax(kept[first]))]
        ring[n_rings] = first
        sizes[n_rings], _ = _walk(first, second, links, kept, seen, path, filled)
        filled += sizes[n_rings]
        n_rings += 1
    return ring[:n_rings], sizes[:n_rings], path[:filled]


@njit(cache=True)
def _walk(
    before: int,
    pixel: int,
    links: NDArray[np.int32],
    kept: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    path: NDArray[np.int64],
    filled: int,
) -> tuple[int, int]:
    """Follow a line up to a pixel that was seen before; write the pixels on the way to ``path`` from ``filled`` on.

    Returns how many they are, and the pixel it ends at.
    """
    size = 0
    while not seen[pixel]:
        seen[pixel] = True
        path[filled + size] = pixel
        size += 1
        for k in range(8):
            onward = links[pixel, k]
            if kept[pixel, k] and onward != before:
                before, pixel = pixel, onward
                break
    return size, pixel
