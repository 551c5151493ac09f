"""Road networks as flat arrays: chains of edges, and the contraction of short edges.

Strategy
--------
Nodes are rows; an edge has its node rows ``u`` and ``v``, and its vertices lie in one coordinate array from
``offsets[e]`` up to ``offsets[e + 1]``. An edge has two ends: end ``2 e`` is where edge ``e`` starts, end
``2 e + 1`` where it stops, so ``end // 2`` is the edge and ``end ^ 1`` the other end. Contraction works in
rounds: each round contracts every edge that is the shortest candidate at both of its nodes, so that clusters of
junctions grow from their closest pairs and nothing depends on the order of the edges.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

__all__ = ["Topology", "chains", "contract_short_edges", "end_nodes", "joined_lines", "mates"]

_FADE = 1.5  # times the distance of two contracted nodes, within which edges lead straight to the new node


@dataclass(frozen=True)
class Topology:
    """A network of N nodes and E edges with P vertices in D dimensions.

    Attributes
    ----------
    position
        Shape (N, 2), metres.
    u, v
        Shape (E,), node rows.
    vertices
        Shape (P, D), metres; plan coordinates first.
    offsets
        Shape (E + 1,).
    edge
        Shape (E,), the edge rows of the network that this one was made from.
    weight
        Shape (N,), how many junctions have gone into a node.
    """

    position: NDArray[np.float64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    vertices: NDArray[np.float64]
    offsets: NDArray[np.int64]
    edge: NDArray[np.int64]
    weight: NDArray[np.int64]


def end_nodes(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the node of every end, shape (2 E,)."""
    return np.stack([u, v], axis=1).reshape(-1)


def mates(u: NDArray[np.int64], v: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return, for each end, the other end at its node if the node joins exactly two edges, else -1."""
    node = end_nodes(u, v)
    order = np.argsort(node, kind="stable")
    heads = np.flatnonzero(np.diff(node[order], prepend=-1))
    pairs = heads[np.diff(np.append(heads, len(order))) == 2]
    one, other = order[pairs], order[pairs + 1]
    distinct = one // 2 != other // 2  # the two ends of a loop are not joined
    mate = np.full(len(node), -1)
    mate[one[distinct]], mate[other[distinct]] = other[distinct], one[distinct]
    return mate


@njit(cache=True)
def chains(mate: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
    """Follow every chain of mated ends, in the direction of its first edge.

    Returns the members chain by chain, whether each is passed backwards, and where each chain starts.
    """
    n_edges = len(mate) // 2
    members = np.empty(n_edges, np.int64)
    backwards = np.empty(n_edges, np.bool_)
    starts = np.empty(n_edges, np.int64)
    seen = np.zeros(n_edges, np.bool_)
    filled = n_chains = 0
    for edge in range(n_edges):
        if seen[edge]:
            continue
        end = 2 * edge
        while mate[end] >= 0:  # back to where the chain begins, or once around a ring
            end = mate[end] ^ 1
            if end == 2 * edge:
                break
        starts[n_chains] = filled
        n_chains += 1
        while end >= 0 and not seen[end // 2]:
            seen[end // 2] = True
            members[filled], backwards[filled] = end // 2, end % 2 == 1
            filled += 1
            end = mate[end ^ 1]
    return members, backwards, starts[:n_chains]


def joined_lines(
    lines: NDArray[Any], members: NDArray[np.int64], backwards: NDArray[np.bool_], starts: NDArray[np.int64]
) -> NDArray[Any]:
    """Concatenate lines along chains; the vertex that two members share appears once."""
    joined = lines[members[starts]]
    lengths = np.diff(np.append(starts, len(members)))
    moving = np.flatnonzero(np.repeat(lengths > 1, lengths))  # single edges keep their line
    chain = np.repeat(np.arange(len(starts)), lengths)[moving]
    has_z = bool(shapely.has_z(lines).any())
    coordinates, owner = shapely.get_coordinates(lines[members[moving]], include_z=has_z, return_index=True)
    count = np.bincount(owner, minlength=len(moving))
    offset = np.cumsum(count) - count
    place = np.arange(len(coordinates)) - offset[owner]
    flipped = backwards[moving][owner]
    source = offset[owner] + np.where(flipped, count[owner] - 1 - place, place)
    inner = np.diff(chain, prepend=-1) == 0  # members that follow another member of their chain
    wanted = ~(inner[owner] & (place == 0))
    if len(moving):
        names, group = np.unique(chain[owner[wanted]], return_inverse=True)
        joined[names] = shapely.linestrings(coordinates[source[wanted]], indices=group)
    return joined


def contract_short_edges(
    network: Topology, *, max_length: float, max_ring: float
) -> tuple[Topology, NDArray[np.int64]]:
    """Contract edges between two junctions that are at most ``max_length`` long, the shortest first.

    Edges on a ring with a perimeter of more than ``2 max_length`` up to ``max_ring`` are left alone; a smaller
    ring is a hole in the mask and vanishes with its edges. Returns the network and, per node row, the row of
    the node that now stands for it. Rows stay; contracted nodes are without edges.
    """
    stands_for = np.arange(len(network.position))
    while True:
        length = _lengths(network)
        short = _shortest_candidates(network, length, max_length, max_ring)
        if len(short) == 0:
            return network, stands_for
        network, moved_to = _contracted(network, length, short, hole=2 * max_length)
        stands_for = moved_to[stands_for]


def _lengths(network: Topology) -> NDArray[np.float64]:
    """Return the length of every edge in plan."""
    step = np.hypot(*np.diff(network.vertices[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(step)])
    return along[network.offsets[1:] - 1] - along[network.offsets[:-1]]


def _shortest_candidates(
    network: Topology, length: NDArray[np.float64], max_length: float, max_ring: float
) -> NDArray[np.int64]:
    """List the edges to contract in this round; no two of them share a node."""
    u, v = network.u, network.v
    ends = end_nodes(u, v)
    degree = np.bincount(ends, minlength=len(network.position))
    candidate = np.flatnonzero((length <= max_length) & (u != v) & (degree[u] >= 3) & (degree[v] >= 3))
    if len(candidate) == 0:
        return candidate
    order = np.argsort(ends, kind="stable")
    first = np.concatenate([[0], np.cumsum(degree)])
    ring = _ring_lengths(candidate, u, v, length, first, order, max_ring)
    candidate = candidate[(ring <= 2 * max_length) | (ring > max_ring)]
    candidate = candidate[np.argsort(length[candidate], kind="stable")]
    best = np.full(len(network.position), len(candidate))
    rank = np.arange(len(candidate))
    np.minimum.at(best, u[candidate], rank)
    np.minimum.at(best, v[candidate], rank)
    return candidate[(best[u[candidate]] == rank) & (best[v[candidate]] == rank)]


@njit(cache=True)
def _ring_lengths(
    candidate: NDArray[np.int64],
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    length: NDArray[np.float64],
    first: NDArray[np.int64],
    order: NDArray[np.int64],
    limit: float,
) -> NDArray[np.float64]:
    """Return the length of the smallest ring through each candidate edge, infinity beyond the limit (Dijkstra).

    ``order[first[n] : first[n + 1]]`` are the ends at node n.
    """
    ring = np.full(len(candidate), np.inf)
    distance = np.full(len(first) - 1, np.inf)
    for place in range(len(candidate)):
        edge = candidate[place]
        queue = [(length[edge], u[edge])]
        reached = [u[edge]]
        distance[u[edge]] = length[edge]
        while len(queue) > 0:
            so_far, node = heapq.heappop(queue)
            if node == v[edge]:
                ring[place] = so_far
                break
            for end in order[first[node] : first[node + 1]]:
                other = end // 2
                onward = u[other] if end % 2 else v[other]
                total = so_far + length[other]
                if other != edge and total <= limit and total < distance[onward]:
                    distance[onward] = total
                    reached.append(onward)
                    heapq.heappush(queue, (total, onward))
        for node in reached:
            distance[node] = np.inf
    return ring


def _contracted(
    network: Topology, length: NDArray[np.float64], short: NDArray[np.int64], hole: float
) -> tuple[Topology, NDArray[np.int64]]:
    """Contract edges without common nodes, each to the weighted mean of its nodes."""
    ends = np.stack([network.u[short], network.v[short]])
    kept_node, merged_node = ends.min(axis=0), ends.max(axis=0)
    weight, position = network.weight.copy(), network.position.copy()
    weighted = weight[:, None] * position
    total = (weight[kept_node] + weight[merged_node])[:, None]
    position[kept_node] = (weighted[kept_node] + weighted[merged_node]) / total
    weight[kept_node] += weight[merged_node]
    moved_to, radius = np.arange(len(position)), np.zeros(len(position))
    moved_to[merged_node] = kept_node
    radius[kept_node] = _FADE * np.hypot(*(network.position[kept_node] - network.position[merged_node]).T)

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
