"""Sampling of graphs: points along every edge, and outward from a centre up to a network distance.

Strategy of `sample_around`. From each centre (a node, or a position on an edge) Dijkstra's algorithm finds the
network distance of every node in reach. Along an edge that distance rises away from the centre, so an edge
belongs to a branch that enters it from one end, or to two branches that enter from both ends and meet where
their distances are equal. A centre on an edge becomes a node first, and the edge two halves, which are edges like
others. A branch is followed from the centre outward: its samples are the points whose network distance is a
multiple of the spacing, and its end, which is a dead end, the place where two branches meet, or the radius,
where the edge is cut. Thus samples depend on the shape of the roads around the centre and
not on how edges are cut, drawn or numbered, and a stretch that two branches share is sampled once. Samples at
nodes are recognised by the node, so that a node is sampled once however many edges meet there.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.metrics.network import EPSILON, Network, locate

__all__ = ["Centres", "Samples", "component_roots", "sample_around", "sample_edges"]


@dataclass(frozen=True)
class Centres:
    """Centres of sampling, each of one of three kinds.

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
        """Return centres at nodes."""
        return cls(np.asarray(node, np.int64), np.full(len(node), -1, np.int64), np.zeros(len(node)))

    @classmethod
    def from_positions(cls, edge: NDArray[np.int64], offset: NDArray[np.float64]) -> Centres:
        """Return centres at positions on edges; a centre on edge -1 has no samples."""
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
    """Sample every edge at its start, at every ``spacing`` metres, and at its end; shared points appear once.

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
    """Sample the part of a graph within a network distance of each centre, in order from the centre outward.

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
    limits = _Limits(float(radius), float(spacing), ends)
    first, edge, offset = _sample_around(centres.node, centres.edge, centres.offset, _roads(network), limits)
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


class _Roads(NamedTuple):
    """Stretches of road between nodes: all edges, then two halves of the edge that the centre is on.

    There are R = E + 2 stretches. The last node is the centre on an edge, where the two halves begin.
    """

    u: NDArray[np.int64]  # (R,)
    v: NDArray[np.int64]  # (R,)
    edge: NDArray[np.int64]  # (R,) edge of the stretch
    begin: NDArray[np.float64]  # (R,) m, offset on the edge at u
    end: NDArray[np.float64]  # (R,) m, the same at v
    incident_first: NDArray[np.int64]  # (N + 2,)
    incident: NDArray[np.int64]  # (R * 2 - 2,) stretches at each node, ascending but for halves


class _Reached(NamedTuple):
    """The state of Dijkstra's algorithm at every node, shape (N + 1,) each; reset after each centre."""

    distance: NDArray[np.float64]  # m
    over: NDArray[np.int64]  # stretch over which the node was reached; -1 for the centre


class _Sink(NamedTuple):
    """The collected samples as growing lists, and the last centre that sampled each node, shape (N + 1,)."""

    edge: list[int]
    offset: list[float]
    node_seen: NDArray[np.int64]


class _Limits(NamedTuple):
    """The limits of sampling; see `sample_around`."""

    radius: float
    spacing: float
    ends: bool


class _Branch(NamedTuple):
    """A part of an edge to sample: its start (offset, network distance), and its end (network distance)."""

    edge: int
    offset: float  # m
    sign: float  # 1 if the offset grows along the branch, else -1
    distance: float  # m
    stop: float  # m, network distance


def _roads(network: Network) -> _Roads:
    """Return the stretches of a network, with space for the halves of the edge that a centre is on."""
    n_edges = len(network.u)
    spare = np.zeros(2, np.int64)
    return _Roads(
        u=np.concatenate([network.u, spare]),
        v=np.concatenate([network.v, spare]),
        edge=np.concatenate([np.arange(n_edges), spare]),
        begin=np.zeros(n_edges + 2),
        end=np.concatenate([network.length, spare]),
        incident_first=np.append(network.incident_first, 2 * n_edges + 2),
        incident=np.concatenate([network.incident_edge, [n_edges, n_edges + 1]]),
    )


@njit(cache=True)
def _sample_around(
    node: NDArray[np.int64],
    edge: NDArray[np.int64],
    offset: NDArray[np.float64],
    roads: _Roads,
    limits: _Limits,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Collect the samples around all centres (see `Centres`); the strategy is at the top of the module."""
    n_nodes = len(roads.incident_first) - 1
    reached = _Reached(np.full(n_nodes, np.inf), np.full(n_nodes, -1, np.int64))
    sink = _new_sink(n_nodes)
    walked = np.full(len(roads.u), -1, np.int64)  # the last centre for which each stretch was sampled
    first = np.zeros(len(node) + 1, np.int64)
    for centre in range(len(node)):
        on_edge = node[centre] < 0 and edge[centre] >= 0
        root = n_nodes - 1 if on_edge else node[centre]
        if on_edge:
            _split(roads, edge[centre], offset[centre])
            _sample_centre(roads, root, sink, centre)
        settled = _reach(root, limits.radius, roads, reached)
        for n in settled:
            if _is_sample(n, root, roads, reached, limits) and sink.node_seen[n] != centre:
                _sample_node(n, roads, reached, sink, centre)
            for k in range(roads.incident_first[n], roads.incident_first[n + 1]):
                stretch = roads.incident[k]
                if walked[stretch] != centre:
                    walked[stretch] = centre
                    _walk(stretch, roads, reached, limits, sink, centre)
        for n in settled:
            reached.distance[n], reached.over[n] = np.inf, -1
        if on_edge:
            _mend(roads)
        first[centre + 1] = len(sink.edge)
    return first, np.array(sink.edge, np.int64), np.array(sink.offset, np.float64)


@njit(cache=True)
def _new_sink(n_nodes: int) -> _Sink:
    """Return empty lists of samples.

    The comprehensions, which tell the compiler the types of empty lists, stand apart, because numba drops writes to
    the arrays of a local named tuple, as in ``reached.distance[n] = 0.0``, from a function that holds one.
    """
    return _Sink([0 for _ in range(0)], [0.0 for _ in range(0)], np.full(n_nodes, -1, np.int64))


@njit(cache=True)
def _split(roads: _Roads, edge: int, offset: float) -> None:
    """Replace an edge by two halves that lead from the centre on it to u and to v."""
    offset = min(max(offset, 0.0), roads.end[edge])
    for side in range(2):
        half = len(roads.u) - 2 + side
        node, stop = (roads.v[edge], roads.end[edge]) if side else (roads.u[edge], 0.0)
        roads.u[half], roads.v[half], roads.edge[half] = len(roads.incident_first) - 2, node, edge
        roads.begin[half], roads.end[half] = offset, stop
        for k in range(roads.incident_first[node], roads.incident_first[node + 1]):
            if roads.incident[k] == edge:  # a loop is listed twice, once for each half
                roads.incident[k] = half
                break


@njit(cache=True)
def _mend(roads: _Roads) -> None:
    """Replace the two halves by their edge again."""
    for half in range(len(roads.u) - 2, len(roads.u)):
        node = roads.v[half]
        for k in range(roads.incident_first[node], roads.incident_first[node + 1]):
            if roads.incident[k] == half:
                roads.incident[k] = roads.edge[half]


@njit(cache=True)
def _sample_centre(roads: _Roads, root: int, sink: _Sink, centre: int) -> None:
    """Sample a centre on an edge; a node at the same position then counts as sampled, too."""
    sink.node_seen[root] = centre
    half = roads.incident[roads.incident_first[root]]
    sink.edge.append(roads.edge[half])
    sink.offset.append(roads.begin[half])
    for k in range(roads.incident_first[root], roads.incident_first[root + 1]):
        half = roads.incident[k]
        if abs(roads.end[half] - roads.begin[half]) <= EPSILON:
            sink.node_seen[roads.v[half]] = centre


@njit(cache=True)
def _reach(root: int, radius: float, roads: _Roads, reached: _Reached) -> list[int]:
    """Compute the distances of all nodes within the radius of a node (-1 for none); list the nodes, nearest first."""
    heap = [(0.0, 0) for _ in range(0)]
    settled = [0 for _ in range(0)]
    if root >= 0:
        reached.distance[root] = 0.0
        heappush(heap, (0.0, root))
    while len(heap) > 0:
        here, n = heappop(heap)
        if here > reached.distance[n]:
            continue
        settled.append(n)
        for k in range(roads.incident_first[n], roads.incident_first[n + 1]):
            stretch = roads.incident[k]
            other = roads.v[stretch] if roads.u[stretch] == n else roads.u[stretch]
            far = here + abs(roads.end[stretch] - roads.begin[stretch])
            if far <= radius + EPSILON and far < reached.distance[other]:
                reached.distance[other], reached.over[other] = far, stretch
                heappush(heap, (far, other))
    return settled


@njit(cache=True, inline="always")
def _is_sample(n: int, root: int, roads: _Roads, reached: _Reached, limits: _Limits) -> bool:
    """Tell whether a reached node is a sample: at a multiple of the spacing, or as a dead end."""
    level = limits.spacing * np.round(reached.distance[n] / limits.spacing)
    dead_end = roads.incident_first[n + 1] - roads.incident_first[n] == 1 and n != root
    return abs(reached.distance[n] - level) <= EPSILON or (limits.ends and dead_end)


@njit(cache=True, inline="always")
def _sample_node(n: int, roads: _Roads, reached: _Reached, sink: _Sink, centre: int) -> None:
    """Sample a node as an end of the edge over which it was reached; the centre as an end of its first edge."""
    stretch = reached.over[n]
    if stretch < 0:
        if roads.incident_first[n] == roads.incident_first[n + 1]:
            return
        stretch = roads.incident[roads.incident_first[n]]
    edge = roads.edge[stretch]
    sink.node_seen[n] = centre
    sink.edge.append(edge)
    sink.offset.append(0.0 if roads.u[edge] == n else roads.end[edge])


@njit(cache=True)
def _walk(stretch: int, roads: _Roads, reached: _Reached, limits: _Limits, sink: _Sink, centre: int) -> None:
    """Sample the parts of a stretch that are in reach.

    If one end was reached over this stretch, one branch passes through, and the node at its end is sampled separately.
    Otherwise branches enter from both ends that are in reach, and stop where they meet or at the radius.
    """
    u, v, edge = roads.u[stretch], roads.v[stretch], roads.edge[stretch]
    begin, end = roads.begin[stretch], roads.end[stretch]
    at_u, at_v, size = reached.distance[u], reached.distance[v], abs(end - begin)
    onward, back = np.sign(end - begin), np.sign(begin - end)
    if u != v and reached.over[v] == stretch:
        _sample_levels(_Branch(edge, begin, onward, at_u, at_u + size), limits.spacing, sink)
        return
    if u != v and reached.over[u] == stretch:
        _sample_levels(_Branch(edge, end, back, at_v, at_v + size), limits.spacing, sink)
        return
    meets = at_u + at_v + size <= 2.0 * limits.radius
    stop = (at_u + at_v + size) / 2.0 if meets else limits.radius
    if at_u < np.inf:
        branch = _Branch(edge, begin, onward, at_u, stop)
        _sample_levels(branch, limits.spacing, sink)
        if limits.ends:
            _sample_end(branch, roads, sink, centre)
    if at_v < np.inf:
        branch = _Branch(edge, end, back, at_v, stop)
        _sample_levels(branch, limits.spacing, sink)
        if limits.ends and not meets:  # else the other branch has sampled this end
            _sample_end(branch, roads, sink, centre)


@njit(cache=True, inline="always")
def _sample_levels(branch: _Branch, spacing: float, sink: _Sink) -> None:
    """Sample a branch at multiples of the spacing, without its ends."""
    level = spacing * (np.floor((branch.distance + EPSILON) / spacing) + 1.0)
    while level < branch.stop - EPSILON:
        sink.edge.append(branch.edge)
        sink.offset.append(branch.offset + branch.sign * (level - branch.distance))
        level += spacing


@njit(cache=True, inline="always")
def _sample_end(branch: _Branch, roads: _Roads, sink: _Sink, centre: int) -> None:
    """Sample the end of a branch, unless it is a node that was sampled before."""
    offset = branch.offset + branch.sign * (branch.stop - branch.distance)
    node = -1
    if offset <= EPSILON:
        node = roads.u[branch.edge]
    elif offset >= roads.end[branch.edge] - EPSILON:
        node = roads.v[branch.edge]
    if node >= 0:
        if sink.node_seen[node] == centre:
            return
        sink.node_seen[node] = centre
    sink.edge.append(branch.edge)
    sink.offset.append(offset)
