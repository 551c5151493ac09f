"""Points on graphs: along every edge, and outward from a centre up to a network distance.

Strategy of `sample_around`. From each centre (a node, or a position on an edge) Dijkstra's algorithm finds the
network distance of every node in reach. Along an edge that distance rises away from the centre, so an edge
belongs to a branch that enters it from one end, or to two branches that enter from both ends and meet where
their distances are equal. A branch is followed from the centre outward: its samples are the points whose
network distance is a multiple of the spacing, and its end, which is a dead end, the place where two branches
meet, or the radius, where the edge is cut. Thus samples depend on the shape of the roads around the centre and
not on how edges are cut, drawn or numbered, and a stretch that two branches share is sampled once. Samples at
nodes are recognised by the node, so that a node is sampled once however many edges meet there.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.metrics.network import EPSILON, Network, locate

__all__ = ["Centres", "Samples", "component_roots", "sample_around", "sample_edges"]


@dataclass(frozen=True)
class Centres:
    """Centres to sample around, one of three kinds each.

    Attributes
    ----------
    node
        Shape (C,): a node, or -1.
    edge, offset
        Shape (C,): a position on an edge where ``node`` is -1; ``edge`` -1 as well for no centre at all.
    """

    node: NDArray[np.int64]
    edge: NDArray[np.int64]
    offset: NDArray[np.float64]

    @classmethod
    def from_nodes(cls, node: NDArray[np.int64]) -> Centres:
        """Centre on nodes."""
        return cls(np.asarray(node, np.int64), np.full(len(node), -1, np.int64), np.zeros(len(node)))

    @classmethod
    def from_positions(cls, edge: NDArray[np.int64], offset: NDArray[np.float64]) -> Centres:
        """Centre on positions on edges; an edge of -1 has no samples."""
        return cls(np.full(len(edge), -1, np.int64), np.asarray(edge, np.int64), np.asarray(offset, np.float64))


@dataclass(frozen=True)
class Samples:
    """Sample points of many centres, one centre after the other.

    Attributes
    ----------
    first
        Shape (C + 1,): the samples of centre ``c`` are ``first[c]`` to ``first[c + 1]``.
    edge, offset
        Shape (S,): where they lie.
    xy, direction
        Shape (S, 2): coordinates, and the unit direction of their edge.
    """

    first: NDArray[np.int64]
    edge: NDArray[np.int64]
    offset: NDArray[np.float64]
    xy: NDArray[np.float64]
    direction: NDArray[np.float64]


def sample_edges(network: Network, spacing: float, *, shift: float | None = None) -> Samples:
    """Sample every edge at its start, then every ``spacing`` metres, and at its end; shared points once.

    The end is always sampled, so the last interval may be short. Polyline vertices are not kept. A spacing that
    is not positive gives no samples.

    Parameters
    ----------
    network
        The graph.
    spacing
        Metres along the edge.
    shift
        Distance of the second sample from the start, metres, at most ``spacing``; by default the spacing.

    Returns
    -------
    Samples
        Of one centre, in edge order; of samples with identical coordinates the first is kept.

    Notes
    -----
    METHOD 6.1 (b), steps 2 and 3.

    Examples
    --------
    >>> from probe2road.metrics.network import network_from_graph
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(0, 0), (12, 0)]], crs="EPSG:32616"))
    >>> sample_edges(network, 5.0).xy[:, 0].tolist()
    [0.0, 5.0, 10.0, 12.0]
    """
    if not spacing > 0:
        return _samples(network, np.zeros(2, np.int64), np.empty(0, np.int64), np.empty(0))
    second = spacing if shift is None else shift
    inner = np.maximum(np.ceil((network.length - second - EPSILON) / spacing), 0).astype(np.int64)
    count = np.where(network.length > 0, inner + 2, 0)
    edge = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    offset = np.where(rank == 0, 0.0, second + (rank - 1) * spacing)
    offset = np.where(rank == count[edge] - 1, network.length[edge], offset)
    xy, _ = locate(network, edge, offset)
    _, kept = np.unique(np.round(xy / EPSILON).astype(np.int64), axis=0, return_index=True)
    kept.sort()
    return _samples(network, np.array([0, len(kept)]), edge[kept], offset[kept])


def sample_around(network: Network, centres: Centres, *, radius: float, spacing: float, ends: bool = True) -> Samples:
    """Sample the part of a graph within a network distance of each centre, from the centre outward.

    Parameters
    ----------
    network
        The graph.
    centres
        Where to start; a centre that is nowhere, or a node without edges, has no samples.
    radius
        Largest network distance, metres; infinity for the whole component.
    spacing
        Network distance between samples, metres.
    ends
        Whether to sample the ends of branches too: dead ends, where branches meet, and the radius.

    Returns
    -------
    Samples
        The centre first, then by the order in which Dijkstra's algorithm settles nodes.

    Examples
    --------
    >>> from probe2road.metrics.network import network_from_graph
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616"))
    >>> centre = Centres.from_positions(np.array([0]), np.array([15.0]))
    >>> sorted(sample_around(network, centre, radius=30.0, spacing=11.0).xy[:, 0].tolist())
    [0.0, 4.0, 15.0, 26.0, 37.0, 45.0]
    """
    first, edge, offset = _sample_around(
        centres.node, centres.edge, centres.offset, float(radius), float(spacing), ends,
        network.u, network.v, network.length, network.incident_first, network.incident_edge,
    )  # fmt: skip
    return _samples(network, first, edge, offset)


def component_roots(network: Network) -> NDArray[np.int64]:
    """Return the lowest node of every connected component that has an edge, ascending.

    Examples
    --------
    >>> from probe2road.metrics.network import network_from_graph
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> lines = [[(0, 0), (9, 0)], [(50, 0), (60, 0)], [(9, 0), (9, 9)]]
    >>> component_roots(network_from_graph(graph_from_lines(lines, crs="EPSG:32616"))).tolist()
    [0, 2]
    """
    n = len(network.node_xy)
    graph = coo_array((np.ones(len(network.u), np.int8), (network.u, network.v)), shape=(n, n))
    _, label = connected_components(graph.tocsr(), directed=False)
    _, roots = np.unique(label, return_index=True)
    roots = np.sort(roots).astype(np.int64)
    return roots[network.degree[roots] > 0]


def _samples(
    network: Network, first: NDArray[np.int64], edge: NDArray[np.int64], offset: NDArray[np.float64]
) -> Samples:
    return Samples(first, edge, offset, *locate(network, edge, offset))


@njit(cache=True)
def _sample_around(
    centre_node: NDArray[np.int64],
    centre_edge: NDArray[np.int64],
    centre_offset: NDArray[np.float64],
    radius: float,
    spacing: float,
    ends: bool,
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    length: NDArray[np.float64],
    incident_first: NDArray[np.int64],
    incident_edge: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Collect the samples of all centres; see the module for the strategy.

    A centre on an edge splits it into a half towards u and a half towards v, whose other ends lie at distance 0.
    ``parent`` holds the edge over which a node was reached: an edge, or one of the two halves.
    """
    n_nodes = len(incident_first) - 1
    distance = np.full(n_nodes, np.inf)
    parent = np.full(n_nodes, -1, np.int64)
    edge_seen, node_seen = np.full(len(u), -1, np.int64), np.full(n_nodes, -1, np.int64)
    edges, offsets = [0 for _ in range(0)], [0.0 for _ in range(0)]  # empty, but of a type that numba can tell
    first = np.zeros(len(centre_node) + 1, np.int64)
    for c in range(len(centre_node)):
        node, e = centre_node[c], centre_edge[c]
        at = min(max(centre_offset[c], 0.0), length[e]) if e >= 0 and node < 0 else 0.0
        settled = _reach(node, e, at, radius, u, v, length, incident_first, incident_edge, distance, parent)
        if node < 0 and e >= 0:
            edge_seen[e] = c
            edges.append(e)
            offsets.append(at)
            for half in range(2):
                end, stop = (u[e], 0.0) if half == 0 else (v[e], length[e])
                if abs(at - stop) <= EPSILON:
                    node_seen[end] = c  # the centre is that node, and is sampled already
                _walk(e, at, stop, 0.0, distance[end], parent[end] == -2 - half, False,
                      radius, spacing, ends, c, u, v, length, node_seen, edges, offsets)  # fmt: skip
        for n in settled:
            level = spacing * np.round(distance[n] / spacing)
            degree = incident_first[n + 1] - incident_first[n]
            if abs(distance[n] - level) <= EPSILON or (ends and degree == 1 and n != node):
                e = parent[n] if parent[n] >= 0 else (centre_edge[c] if parent[n] < -1 else -1)
                if e < 0 and degree > 0:
                    e = incident_edge[incident_first[n]]
                if e >= 0 and node_seen[n] != c:
                    node_seen[n] = c
                    edges.append(e)
                    offsets.append(0.0 if u[e] == n else length[e])
            for k in range(incident_first[n], incident_first[n + 1]):
                e = incident_edge[k]
                if edge_seen[e] == c:
                    continue
                edge_seen[e] = c
                a, b = u[e], v[e]
                _walk(e, 0.0, length[e], distance[a], distance[b], parent[b] == e and a != b,
                      parent[a] == e and a != b, radius, spacing, ends, c, u, v, length,
                      node_seen, edges, offsets)  # fmt: skip
        for n in settled:
            distance[n], parent[n] = np.inf, -1
        first[c + 1] = len(edges)
    return first, np.array(edges, np.int64), np.array(offsets, np.float64)


@njit(cache=True)
def _reach(
    node: int,
    edge: int,
    at: float,
    radius: float,
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    length: NDArray[np.float64],
    incident_first: NDArray[np.int64],
    incident_edge: NDArray[np.int64],
    distance: NDArray[np.float64],
    parent: NDArray[np.int64],
) -> list[int]:
    """Fill the distance of every node within the radius and the edge it was reached over; list them nearest first.

    Nodes reached straight from a centre on an edge have the parent -2 (its half towards u) or -3 (towards v).
    """
    heap = [(0.0, 0) for _ in range(0)]
    settled = [0 for _ in range(0)]
    if node >= 0:
        distance[node] = 0.0
        heappush(heap, (0.0, node))
    elif edge >= 0:
        for half in range(2):
            end, far = (u[edge], at) if half == 0 else (v[edge], length[edge] - at)
            if far <= radius + EPSILON and far < distance[end]:
                distance[end], parent[end] = far, -2 - half
                heappush(heap, (far, end))
    while len(heap) > 0:
        here, n = heappop(heap)
        if here > distance[n]:
            continue
        settled.append(n)
        for k in range(incident_first[n], incident_first[n + 1]):
            e = incident_edge[k]
            if e == edge and node < 0:
                continue  # that way lies the centre
            other = v[e] if u[e] == n else u[e]
            far = here + length[e]
            if far <= radius + EPSILON and far < distance[other]:
                distance[other], parent[other] = far, e
                heappush(heap, (far, other))
    return settled


@njit(cache=True)
def _walk(
    e: int,
    a: float,
    b: float,
    at_a: float,
    at_b: float,
    a_to_b: bool,
    b_to_a: bool,
    radius: float,
    spacing: float,
    ends: bool,
    c: int,
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    length: NDArray[np.float64],
    node_seen: NDArray[np.int64],
    edges: list[int],
    offsets: list[float],
) -> None:
    """Sample the stretch of edge ``e`` from offset ``a`` to ``b``, whose ends lie at given network distances.

    ``a_to_b`` and ``b_to_a`` say that the far end is reached over this very stretch. Otherwise branches enter from
    both ends in reach, up to where they meet or to the radius.
    """
    size = abs(b - a)
    through = a_to_b or b_to_a
    meets = not through and at_a + at_b + size <= 2.0 * radius
    for side in range(2):
        start, begin, sign = (a, at_a, np.sign(b - a)) if side == 0 else (b, at_b, np.sign(a - b))
        if begin == np.inf or (through and (a_to_b != (side == 0))):
            continue
        stop = begin + size if through else radius
        if meets:
            stop = (at_a + at_b + size) / 2.0
        level = spacing * (np.floor((begin + EPSILON) / spacing) + 1.0)
        while level < stop - EPSILON:
            edges.append(e)
            offsets.append(start + sign * (level - begin))
            level += spacing
        if through or not ends or (meets and side == 1):
            continue
        end = start + sign * (stop - begin)
        n = u[e] if end <= EPSILON else (v[e] if end >= length[e] - EPSILON else -1)
        if n >= 0:
            if node_seen[n] == c:
                continue
            node_seen[n] = c
        edges.append(e)
        offsets.append(end)
