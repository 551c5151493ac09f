"""APLS, the average path length similarity: are the routes as long as in the reference? Both ways, by control points.

Strategy. Control points of one graph are snapped onto the other. Both graphs are cut at those points, so that one
Dijkstra run from each point on either graph gives the lengths of all routes, and the two square matrices of lengths
are compared. Then the graphs change places.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from probe2road.bounds import NotNegative, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.topology import shortest_arcs
from probe2road.metrics.network import EPSILON, Network, locate
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["AplsOptions", "apls", "apls_networks"]


@dataclass(frozen=True)
@checked
class AplsOptions:
    """Parameters of APLS; the defaults are those of its authors' program."""

    snap: Positive[float] = 4.0  # m from a control point to the other graph; 6 to 8 suits highways at 1 m accuracy
    spacing: Positive[float] = 50.0  # m between control points along an edge
    max_points: Positive[int] = 1000  # most control points; of more, these are chosen at random
    min_length: NotNegative[float] = 0.001  # m; shorter routes are not compared
    seed: NotNegative[int] = 0  # of the random choice


def apls(proposal: RoadGraph, reference: RoadGraph, *, options: AplsOptions | None = None) -> Score:
    """Score a proposal by the lengths of its routes, compared with those of the reference.

    Both graphs are normalised first, as for `geo`. An empty graph scores 0, and so does one without any route.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `AplsOptions` where None.

    Returns
    -------
    Score
        ``recall`` is the similarity over routes of the reference, ``precision`` that over routes of the proposal,
        ``f1`` their harmonic mean, which is APLS. Counts are routes; "matched" is the sum of their similarities.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    METHOD 6.4. Control points are all nodes and points along the edges. A route scores 1 - min(1, |L - L'| / L),
    and 0 where an end has no snapped partner or the other graph has no route.

    Examples
    --------
    A gap in the middle cuts the routes through it:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (200, 0)]], crs="EPSG:32616")
    >>> proposal = graph_from_lines([[(0, 0), (90, 0)], [(110, 0), (200, 0)]], crs="EPSG:32616")
    >>> score = apls(proposal, reference)
    >>> round(score.precision, 3), round(score.recall, 3)
    (1.0, 0.2)
    """
    return apls_networks(*comparable_networks(proposal, reference), options or AplsOptions())


def apls_networks(proposal: Network, reference: Network, options: AplsOptions) -> Score:
    """Score normalised networks in the same way as `apls`."""
    proposed_similar, proposed = _similarity(proposal, reference, options)
    wanted_similar, wanted = _similarity(reference, proposal, options)
    return Score.from_counts(
        "apls",
        matched_proposal=proposed_similar,
        proposal=proposed,
        matched_reference=wanted_similar,
        reference=wanted,
        parameters=asdict(options),
        details={"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
    )


def _similarity(network: Network, other: Network, options: AplsOptions) -> tuple[float, int]:
    """Sum the similarities of the routes between control points of one network, and count those routes."""
    edge, offset = _control_points(network, options)
    if len(edge) == 0:
        return 0.0, 0
    length = _route_lengths(network, edge, offset)
    there_edge, there_offset = _snap(locate(network, edge, offset)[0], other, options.snap)
    found = np.flatnonzero(there_edge >= 0)
    there = np.full(length.shape, np.inf)
    if len(found):
        there[np.ix_(found, found)] = _route_lengths(other, there_edge[found], there_offset[found])
    routes = np.triu(np.isfinite(length) & (length >= options.min_length), k=1)
    length, there = length[routes], there[routes]
    return float((1.0 - np.minimum(1.0, np.abs(length - there) / length)).sum()), len(length)


def _control_points(network: Network, options: AplsOptions) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Place control points at all nodes with edges and along all edges; of too many, choose some at random."""
    nodes = np.flatnonzero(network.degree > 0)
    at_node = network.incident_edge[network.incident_first[nodes]]
    start = np.where(network.u[at_node] == nodes, 0.0, network.length[at_node])
    count = np.maximum(np.ceil((network.length - EPSILON) / options.spacing).astype(np.int64) - 1, 0)
    edge = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    edge, offset = np.concatenate([at_node, edge]), np.concatenate([start, (rank + 1) * options.spacing])
    if len(edge) > options.max_points:
        drawn = np.random.default_rng(options.seed).choice(len(edge), options.max_points, replace=False)
        drawn.sort()
        edge, offset = edge[drawn], offset[drawn]
    return edge, offset


def _snap(xy: NDArray[np.float64], other: Network, radius: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the closest position on another network, on the lowest edge for ties; edge -1 if no edge is near."""
    edge, offset = np.full(len(xy), -1, np.int64), np.zeros(len(xy))
    if len(other.lines) == 0:
        return edge, offset
    points = shapely.points(xy)
    row, candidate = shapely.STRtree(other.lines).query_nearest(points, max_distance=radius + EPSILON)
    order = np.lexsort((candidate, row))
    kept = order[np.unique(row[order], return_index=True)[1]]
    edge[row[kept]] = candidate[kept]
    offset[row[kept]] = shapely.line_locate_point(other.lines[candidate[kept]], points[row[kept]])
    return edge, offset


def _route_lengths(network: Network, edge: NDArray[np.int64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of the shortest routes between positions, shape (S, S); infinity if there is no route.

    Every edge becomes a chain through its positions; positions are numbered behind the nodes.
    """
    n_nodes, n_edges = len(network.node_xy), len(network.u)
    owner = np.concatenate([np.arange(n_edges), edge, np.arange(n_edges)])
    along = np.concatenate([np.zeros(n_edges), np.clip(offset, 0.0, network.length[edge]), network.length])
    stop = np.concatenate([network.u, n_nodes + np.arange(len(edge)), network.v])
    kind = np.repeat([0, 1, 2], [n_edges, len(edge), n_edges])
    order = np.lexsort((kind, along, owner))
    owner, along, stop = owner[order], along[order], stop[order]
    same = owner[1:] == owner[:-1]
    arcs = shortest_arcs(stop[:-1][same], stop[1:][same], np.diff(along)[same], n_nodes + len(edge))
    positions = n_nodes + np.arange(len(edge))
    return dijkstra(arcs, directed=False, indices=positions)[:, positions]
