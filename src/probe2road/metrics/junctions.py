"""Junction connectivity: do roads that meet or cross in the reference connect alike? Measured by pairs of arms.

Strategy. The reference is cut at its junctions and wherever two of its edges cross in plan, which is where a mask
shows a junction, real or not. Each piece between two such places is an arm of both. For each pair of arms of a place,
the question is the same in both graphs: is there a short route from a position on one arm to a position on the other?
In the reference the positions are known; in the proposal they are on the nearest edges with about their directions.
The length of a route is a distance between nodes, from Dijkstra's algorithm with a limit, and the rest on the edges.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from probe2road.bounds import Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import EPSILON, Network, locate, shortest_arcs
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.projection import direction_over, project_along
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = [
    "JunctionOptions",
    "JunctionPairs",
    "crossings_without_node",
    "junction_pairs",
    "junctions",
    "junctions_networks",
    "routes_within",
]

_BATCH = 512  # nodes from which distances are computed at a time; limits memory


@dataclass(frozen=True)
@checked
class JunctionOptions:
    """Parameters of junction connectivity; the defaults are those of the refinement's junction suite."""

    arm: Positive[float] = 35.0  # m from a place at which its arms are looked up, at most half the arm
    radius: Positive[float] = 10.0  # m from that position to an edge of the proposal, inclusive
    max_angle: Positive[float] = 30.0  # degrees between the two, as undirected lines
    span: Positive[float] = 2.0  # m to either side, over which the direction of a road is measured
    detour: Positive[float] = 1.5  # a route connects two arms up to this factor times the distance over their place ...
    slack: Positive[float] = 20.0  # m, plus this length
    same_node: Positive[float] = 4.0  # m; crossings this close to a common node do not count


@dataclass(frozen=True)
class JunctionPairs:
    """K pairs of arms at the junctions and crossings of a reference.

    Attributes
    ----------
    xy
        Shape (K, 2): where their junction or crossing lies, metres.
    true, said
        Shape (K,): whether the reference, and whether the proposal connects the two.
    junctions, crossings
        How many places of either kind there are.
    arms, arms_found
        How many arms these have, and how many of them have an edge of the proposal beside them.
    """

    xy: NDArray[np.float64]
    true: NDArray[np.bool_]
    said: NDArray[np.bool_]
    junctions: int
    crossings: int
    arms: int
    arms_found: int


@dataclass(frozen=True)
class _Arms:
    """Arms, sorted by their places; shape (A,) each. Places are nodes, followed by crossings."""

    place: NDArray[np.int64]
    edge: NDArray[np.int64]
    offset: NDArray[np.float64]  # m along the edge, position at which the arm is looked up
    reach: NDArray[np.float64]  # m from the place to that position


def junctions(proposal: RoadGraph, reference: RoadGraph, *, options: JunctionOptions | None = None) -> Score:
    """Score whether arms are connected as in the reference, wherever its roads meet or cross.

    Both graphs are normalised first, as for `geo`. Places are the nodes of the reference with three edges or more,
    and the points where two of its edges cross in plan without a node, as at a bridge. Every pair of arms of a place
    is one decision. A graph without such a place, and an empty graph, score 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `JunctionOptions` where None.

    Returns
    -------
    Score
        Counts are pairs of arms: those that both graphs connect, of those that the proposal connects (precision) and
        of those that the reference connects (recall). The details hold the numbers of places and of arms.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    Both graphs answer by one rule. An arm is looked up 35 m from its place, or half way to the next place where that
    is nearer; two arms connect if the shortest way between these spots is at most 1.5 times the sum of their distances
    from the place, and 20 m. So the truth comes from the distances in the reference too: the arms of a junction
    always connect and so do both sides of a bridge's road, while the road over and the road under it connect only if
    a short ramp joins them. A proposal is wrong at a bridge only if its way is shorter than the rule allows; arms that
    it does not have connect to nothing. Where it has a junction and the reference has nothing, nothing is asked: iTOPO
    sees that. Roads one exactly above the other do not cross, nor does an edge that crosses itself.

    Examples
    --------
    A bridge that is taken for a junction: of six pairs of arms two connect.

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> arms = [[(0, 0), (90, 0)], [(0, 0), (-90, 0)], [(0, 0), (0, 90)], [(0, 0), (0, -90)]]
    >>> proposal = graph_from_lines(arms, crs="EPSG:32616")
    >>> reference = graph_from_lines([[(-90, 0), (90, 0)], [(0, -90), (0, 90)]], crs="EPSG:32616")
    >>> score = junctions(proposal, reference)
    >>> score.matched_proposal, score.proposal, score.reference, score.details["crossings"]
    (2.0, 6.0, 2.0, 1)
    """
    return junctions_networks(*comparable_networks(proposal, reference), options or JunctionOptions())


def junctions_networks(proposal: Network, reference: Network, options: JunctionOptions) -> Score:
    """Score normalised networks in the same way as `junctions`."""
    pairs = junction_pairs(proposal, reference, options=options)
    both = int(np.count_nonzero(pairs.true & pairs.said))
    return Score.from_counts(
        "junctions",
        matched_proposal=both,
        proposal=int(np.count_nonzero(pairs.said)),
        matched_reference=both,
        reference=int(np.count_nonzero(pairs.true)),
        parameters=asdict(options),
        details={
            "junctions": pairs.junctions,
            "crossings": pairs.crossings,
            "arms": pairs.arms,
            "arms_not_found": pairs.arms - pairs.arms_found,
            "proposal_km": round(proposal.km, 3),
            "reference_km": round(reference.km, 3),
        },
    )


def junction_pairs(proposal: Network, reference: Network, options: JunctionOptions) -> JunctionPairs:
    """Return for every pair of arms of the reference whether each network connects it, for maps and resampling."""
    i, j, crossing_xy = crossings_without_node(reference, options.same_node)
    arms = _arms(reference, i, j, crossing_xy, options.arm)
    one, other = _pairs(arms.place)
    limit = options.detour * (arms.reach[one] + arms.reach[other]) + options.slack
    xy, _ = locate(reference, arms.edge, arms.offset)
    direction = direction_over(reference, arms.edge, arms.offset, options.span)
    edge, offset = project_along(
        xy, direction, proposal, radius=options.radius, max_angle=options.max_angle, span=options.span
    )
    return JunctionPairs(
        xy=np.concatenate([reference.node_xy, crossing_xy])[arms.place[one]],
        true=routes_within(reference, arms.edge, arms.offset, one, other, limit),
        said=routes_within(proposal, edge, offset, one, other, limit),
        junctions=int(np.count_nonzero(reference.degree > 2)),
        crossings=len(crossing_xy),
        arms=len(arms.place),
        arms_found=int(np.count_nonzero(edge >= 0)),
    )


def crossings_without_node(
    network: Network, same_node: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Find where two edges cross in plan without sharing a node nearby: their rows, and the points, shape (X, 2).

    Parameters
    ----------
    network
        The graph.
    same_node
        Metres; a crossing this close to a common node of the two is none.
    """
    lines = network.lines
    i, j = shapely.STRtree(lines).query(lines, predicate="intersects")
    i, j = i[i < j], j[i < j]
    parts, pair = shapely.get_parts(shapely.intersection(lines[i], lines[j]), return_index=True)
    is_point = shapely.get_type_id(parts) == shapely.GeometryType.POINT  # lines are roads above each other
    i, j, xy = i[pair[is_point]], j[pair[is_point]], shapely.get_coordinates(parts[is_point])
    apart = np.ones(len(i), bool)
    for own in (network.u[i], network.v[i]):
        near = np.hypot(*(xy - network.node_xy[own]).T) < same_node
        apart &= ~(near & ((own == network.u[j]) | (own == network.v[j])))
    return i[apart], j[apart], xy[apart]


def _arms(network: Network, i: NDArray[np.int64], j: NDArray[np.int64], xy: NDArray[np.float64], reach: float) -> _Arms:
    """Cut edges at junctions and crossings; every piece is an arm of the places at its ends."""
    n_edges, n_nodes = len(network.u), len(network.node_xy)
    crossed = np.concatenate([i, j])
    at_crossing = shapely.line_locate_point(network.lines[crossed], shapely.points(np.tile(xy, (2, 1))))
    junction = np.where(network.degree > 2, np.arange(n_nodes), -1)
    edge = np.concatenate([np.arange(n_edges), crossed, np.arange(n_edges)])
    offset = np.concatenate([np.zeros(n_edges), at_crossing, network.length])
    place = np.concatenate([junction[network.u], n_nodes + np.tile(np.arange(len(xy)), 2), junction[network.v]])
    kind = np.repeat([0, 1, 2], [n_edges, len(crossed), n_edges])
    order = np.lexsort((kind, offset, edge))
    edge, offset, place = edge[order], offset[order], place[order]
    piece = np.flatnonzero((edge[1:] == edge[:-1]) & (np.diff(offset) > EPSILON))
    out = np.minimum(reach, (offset[piece + 1] - offset[piece]) / 2.0)
    arms = _Arms(
        place=np.concatenate([place[piece], place[piece + 1]]),
        edge=np.tile(edge[piece], 2),
        offset=np.concatenate([offset[piece] + out, offset[piece + 1] - out]),
        reach=np.tile(out, 2),
    )
    order = np.argsort(arms.place, kind="stable")
    order = order[arms.place[order] >= 0]
    return _Arms(arms.place[order], arms.edge[order], arms.offset[order], arms.reach[order])


def _pairs(place: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the pairs of rows of the same place, the lower row first, in the order of the places."""
    row = np.arange(len(place))
    later = np.searchsorted(place, place, side="right") - row - 1
    one = np.repeat(row, later)
    return one, one + 1 + np.arange(len(one)) - np.repeat(np.cumsum(later) - later, later)


def routes_within(
    network: Network,
    edge: NDArray[np.int64],
    offset: NDArray[np.float64],
    one: NDArray[np.int64],
    other: NDArray[np.int64],
    limit: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Tell which pairs of positions are connected by a route within the pair's limit, in whatever direction.

    Parameters
    ----------
    network
        The graph.
    edge, offset
        Shape (A,): positions; edge -1 is nowhere, and connected to nothing.
    one, other
        Shape (K,): the rows of the two positions of each pair.
    limit
        Shape (K,): the longest route that counts, metres.
    """
    connected = np.zeros(len(one), bool)
    found = np.flatnonzero((edge[one] >= 0) & (edge[other] >= 0))
    if len(found) == 0:
        return connected
    start_edge, start = edge[one[found]], offset[one[found]]
    stop_edge, stop = edge[other[found]], offset[other[found]]
    # The four routes from an end of the one edge to an end of the other, shape (4, K), and that along the same edge.
    (exit_node, to_exit), (entry, from_entry) = _ends(network, start_edge, start), _ends(network, stop_edge, stop)
    exit_node, to_exit = exit_node[[0, 0, 1, 1]], to_exit[[0, 0, 1, 1]]
    entry, from_entry = entry[[0, 1, 0, 1]], from_entry[[0, 1, 0, 1]]
    largest = float(limit[found].max())
    between = _distances(network, exit_node.ravel(), entry.ravel(), limit=largest).reshape(exit_node.shape)
    along = np.where(start_edge == stop_edge, np.abs(start - stop), np.inf)
    route = np.minimum((to_exit + between + from_entry).min(axis=0), along)
    connected[found] = route <= limit[found] + EPSILON
    return connected


def _ends(
    network: Network, edge: NDArray[np.int64], offset: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the nodes at both ends of edges, and how far positions on the edges lie from them, shape (2, K)."""
    return np.stack([network.u[edge], network.v[edge]]), np.stack([offset, network.length[edge] - offset])


def _distances(network: Network, a: NDArray[np.int64], b: NDArray[np.int64], *, limit: float) -> NDArray[np.float64]:
    """Return the network distances between nodes, pair by pair, shape (K,); infinity beyond the limit."""
    arcs = shortest_arcs(network.u, network.v, network.length, len(network.node_xy))
    sources, row = np.unique(a, return_inverse=True)
    distance = np.full(len(a), np.inf)
    for begin in range(0, len(sources), _BATCH):
        own = np.flatnonzero((row >= begin) & (row < begin + _BATCH))
        batch = dijkstra(arcs, directed=False, indices=sources[begin : begin + _BATCH], limit=limit)
        distance[own] = batch[row[own] - begin, b[own]]
    return distance
