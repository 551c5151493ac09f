"""Contraction of short edges: two junctions that are one place become one node.

Strategy
--------
Contraction works in rounds: each round contracts every edge that is the shortest candidate at both of its nodes, so
that clusters of junctions grow from their closest pairs and nothing depends on the order of the edges. Which edges are
candidates is asked again in every round, because each contraction changes the lines around it.

An edge is short for one of two reasons. Thinning leaves such edges where roads meet, and then contracting it puts the
lines where they were, but for the width of a road. Or it is a piece of something small, such as the side of a
roundabout, and then lines go astray. So a contraction is tried first: the lines within the circle that it redraws are
compared with those that it would draw, and the largest distance between the two is its shift.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.graph.topology import Topology, end_nodes

__all__ = ["contract_short_edges"]

_FADE = 1.5  # times the distance of two contracted nodes, within which edges lead straight to the new node
_SAMPLE = 0.5  # m between the places of a line of which the distance to other lines is taken


def contract_short_edges(
    network: Topology, *, max_length: float, max_shift: float | None
) -> tuple[Topology, NDArray[np.int64]]:
    """Contract edges between two junctions that are at most ``max_length`` (m) long, the shortest first.

    Only those are contracted that move no line by more than ``max_shift`` (m); other edges between their nodes vanish
    with them. If it is None, all are; other edges between their nodes become loops then, unless the ring that they were
    part of is a hole in the mask, of at most ``2 max_length``. Returns the network and, per node row, the row of the
    node that now stands for it. Rows stay; contracted nodes are without edges.
    """
    stands_for = np.arange(len(network.position))
    while True:
        length = _lengths(network)
        short = _shortest_candidates(network, length, max_length, max_shift)
        if len(short) == 0:
            return network, stands_for
        hole = 2 * max_length if max_shift is None else np.inf
        network, moved_to = _contracted(network, length, short, hole)
        stands_for = moved_to[stands_for]


def _lengths(network: Topology) -> NDArray[np.float64]:
    """Return the length of every edge in plan."""
    step = np.hypot(*np.diff(network.vertices[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    return along[network.offsets[1:] - 1] - along[network.offsets[:-1]]


def _shortest_candidates(
    network: Topology, length: NDArray[np.float64], max_length: float, max_shift: float | None
) -> NDArray[np.int64]:
    """List the edges to contract in this round; no two of them share a node."""
    u, v = network.u, network.v
    degree = np.bincount(end_nodes(u, v), minlength=len(network.position))
    candidate = np.flatnonzero((length <= max_length) & (u != v) & (degree[u] >= 3) & (degree[v] >= 3))
    if max_shift is not None:
        candidate = candidate[_shifts_of(network, candidate) <= max_shift]
    candidate = candidate[np.argsort(length[candidate], kind="stable")]
    best = np.full(len(network.position), len(candidate))
    rank = np.arange(len(candidate))
    np.minimum.at(best, u[candidate], rank)
    np.minimum.at(best, v[candidate], rank)
    return candidate[(best[u[candidate]] == rank) & (best[v[candidate]] == rank)]


def _meeting(network: Topology, edges: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the node that replaces both nodes of each edge, and within how many metres of it lines are led to it."""
    u, v = network.u[edges], network.v[edges]
    weight, position = network.weight[:, None], network.position
    middle = (weight[u] * position[u] + weight[v] * position[v]) / (weight[u] + weight[v])
    return middle, _FADE * np.hypot(*(position[u] - position[v]).T)


def _shifts_of(network: Topology, edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how far (m) the contraction of each edge would move lines."""
    ends = end_nodes(network.u, network.v)
    order = np.argsort(ends, kind="stable")
    first = np.searchsorted(ends[order], np.arange(len(network.position) + 1))
    middle, radius = _meeting(network, edges)
    plan = network.vertices[:, :2].copy()
    return _shifts(edges, network.u, network.v, plan, network.offsets, first, order, middle, radius)


@njit(cache=True)
def _shifts(
    candidate: NDArray[np.int64],
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    plan: NDArray[np.float64],
    offsets: NDArray[np.int64],
    first: NDArray[np.int64],
    order: NDArray[np.int64],
    middle: NDArray[np.float64],
    radius: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return, for each candidate, the distance of old and new lines (m).

    ``order[first[n] : first[n + 1]]`` are the ends at node n. Old lines are the edge itself, others between its nodes,
    and of all further edges what lies within the circle; new lines lead straight from the middle to where these leave
    it.
    """
    shift = np.zeros(len(candidate))
    for place in range(len(candidate)):
        one, two = u[candidate[place]], v[candidate[place]]
        around = np.concatenate((order[first[one] : first[one + 1]], order[first[two] : first[two + 1]]))
        size = (offsets[around // 2 + 1] - offsets[around // 2]).sum()
        old, new = np.empty((size, 4)), np.empty((len(around), 4))
        n_old = n_new = 0
        for end in around:
            edge = end // 2
            line = plan[offsets[edge] : offsets[edge + 1]]
            if end % 2:
                line = line[::-1]
            if min(u[edge], v[edge]) == min(one, two) and max(u[edge], v[edge]) == max(one, two):
                n_old += _copy_segments(line, len(line) - 1.0, old[n_old:])
                continue
            until = _exit(line, middle[place], radius[place])
            n_old += _copy_segments(line, until, old[n_old:])
            new[n_new, :2], new[n_new, 2:] = middle[place], _point_at(line, until)
            n_new += 1
        shift[place] = max(_farthest(old[:n_old], new[:n_new]), _farthest(new[:n_new], old[:n_old]))
    return shift


@njit(cache=True)
def _copy_segments(line: NDArray[np.float64], until: float, out: NDArray[np.float64]) -> int:
    """Write the segments ``(x, y, x, y)`` of a line up to a place (vertex and fraction); return how many."""
    count = 0
    while count < until:
        out[count, :2] = line[count]
        out[count, 2:] = line[count + 1] if count + 1 <= until else _point_at(line, until)
        count += 1
    return count


@njit(cache=True)
def _farthest(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the largest distance of a place on segments ``(x, y, x, y)`` to the nearest of other segments."""
    farthest = 0.0
    for segment in one:
        step_x, step_y = segment[2] - segment[0], segment[3] - segment[1]
        pieces = int(np.ceil(np.hypot(step_x, step_y) / _SAMPLE))
        for piece in range(pieces + 1):
            share = piece / max(pieces, 1)
            x, y = segment[0] + share * step_x, segment[1] + share * step_y
            nearest = np.inf
            for line in other:
                along_x, along_y = line[2] - line[0], line[3] - line[1]
                square = along_x**2 + along_y**2
                foot = ((x - line[0]) * along_x + (y - line[1]) * along_y) / square if square > 0.0 else 0.0
                foot = min(max(foot, 0.0), 1.0)
                nearest = min(nearest, np.hypot(line[0] + foot * along_x - x, line[1] + foot * along_y - y))
            farthest = max(farthest, nearest)
    return farthest


def _contracted(
    network: Topology, length: NDArray[np.float64], short: NDArray[np.int64], hole: float
) -> tuple[Topology, NDArray[np.int64]]:
    """Contract edges without common nodes, each to the weighted mean of its nodes."""
    ends = np.stack([network.u[short], network.v[short]])
    kept_node, merged_node = ends.min(axis=0), ends.max(axis=0)
    weight, position = network.weight.copy(), network.position.copy()
    moved_to, radius = np.arange(len(position)), np.zeros(len(position))
    position[kept_node], radius[kept_node] = _meeting(network, short)
    weight[kept_node] += weight[merged_node]
    moved_to[merged_node] = kept_node

    partner = np.full(len(position), -1)
    partner[kept_node], partner[merged_node] = merged_node, kept_node
    contracted = np.full(len(position), np.inf)
    contracted[kept_node], contracted[merged_node] = length[short], length[short]
    # Another edge between the two nodes is the side of a hole, or becomes a loop.
    kept = ~((partner[network.u] == network.v) & (length + contracted[network.u] <= hole))
    kept[short] = False
    u, v = moved_to[network.u], moved_to[network.v]
    vertices, offsets = _rehung(network.vertices, network.offsets, kept, u, v, position, radius)
    kept_rows = np.flatnonzero(kept)
    result = replace(
        network,
        position=position,
        u=u[kept],
        v=v[kept],
        vertices=vertices,
        offsets=offsets,
        weight=weight,
        edge=network.edge[kept_rows],
    )
    return _without_flat_edges(result), moved_to


def _without_flat_edges(network: Topology) -> Topology:
    """Remove edges that have lost all extent: loops with no vertex except their node."""
    fine = _lengths(network) > 0
    if fine.all():
        return network
    count = np.diff(network.offsets)
    return replace(
        network,
        u=network.u[fine],
        v=network.v[fine],
        vertices=network.vertices[np.repeat(fine, count)],
        offsets=np.concatenate([[0], np.cumsum(count[fine])]),
        edge=network.edge[fine],
    )


@njit(cache=True)
def _rehung(
    vertices: NDArray[np.float64],
    offsets: NDArray[np.int64],
    kept: NDArray[np.bool_],
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    position: NDArray[np.float64],
    radius: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Connect the kept edges to the new positions of their nodes; return vertices and offsets.

    Where a node has a radius, what an edge does inside it is replaced by the straight line from the node to
    where the edge leaves the circle, so that the shift fades out within the circle. Loops only move their ends.
    """
    out = np.empty((len(vertices) + 2 * len(u), vertices.shape[1]))
    out_offsets = np.zeros(kept.sum() + 1, np.int64)
    n_edges = filled = 0
    for edge in range(len(u)):
        if not kept[edge]:
            continue
        line = vertices[offsets[edge] : offsets[edge + 1]]
        start, stop = position[u[edge]], position[v[edge]]
        head, tail = 0.0, len(line) - 1.0
        if u[edge] != v[edge]:
            head = _exit(line, start, radius[u[edge]])
            tail -= _exit(line[::-1], stop, radius[v[edge]])
        filled += _copy_part(line, head, tail, start, stop, out[filled:])
        n_edges += 1
        out_offsets[n_edges] = filled
    return out[:filled].copy(), out_offsets


@njit(cache=True)
def _copy_part(
    line: NDArray[np.float64],
    head: float,
    tail: float,
    start: NDArray[np.float64],
    stop: NDArray[np.float64],
    out: NDArray[np.float64],
) -> int:
    """Write start, the part of a line between two places, and stop; return the number of vertices written.

    The ends keep their heights. Where the places have passed each other, only the ends are left.
    """
    last = len(line) - 1
    out[0] = line[0]
    out[0, :2] = start
    filled = 1
    if head < tail:
        if head > 0:
            out[filled] = _point_at(line, head)
            filled += 1
        for place in range(int(np.floor(head)) + 1, int(np.ceil(tail))):
            out[filled] = line[place]
            filled += 1
        if tail < last:
            out[filled] = _point_at(line, tail)
            filled += 1
    out[filled] = line[last]
    out[filled, :2] = stop
    return filled + 1


@njit(cache=True)
def _exit(line: NDArray[np.float64], centre: NDArray[np.float64], radius: float) -> float:
    """Return where a line first leaves a circle around its start: vertex and fraction; its last vertex if never."""
    if radius == 0.0:
        return 0.0
    for place in range(len(line) - 1):
        to_x, to_y = line[place + 1, 0] - centre[0], line[place + 1, 1] - centre[1]
        if np.hypot(to_x, to_y) > radius:
            from_x, from_y = line[place, 0] - centre[0], line[place, 1] - centre[1]
            step_x, step_y = to_x - from_x, to_y - from_y
            # |from + t step| = radius: the larger root, as the segment goes outwards here.
            square = step_x**2 + step_y**2
            half = from_x * step_x + from_y * step_y
            rest = from_x**2 + from_y**2 - radius**2
            fraction = (np.sqrt(max(half**2 - square * rest, 0.0)) - half) / square
            return place + min(max(fraction, 0.0), 1.0)
    return len(line) - 1.0


@njit(cache=True)
def _point_at(line: NDArray[np.float64], place: float) -> NDArray[np.float64]:
    """Interpolate a line at a vertex plus a fraction of the segment after it."""
    before = min(int(place), len(line) - 2)
    return line[before] + (place - before) * (line[before + 1] - line[before])
