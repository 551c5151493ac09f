"""iTOPO: do the roads connect as in the reference? GEO of the surroundings of every junction and dead end.

Strategy. Every node of either graph (degree 1, or 3 and more) is a centre. Its surroundings in its own graph are
what lies within 30 m of network distance; its surroundings in the other graph start at its projection onto the
closest edge within 6 m there (or, as an option, at the closest node). Both are sampled outward from their centres
(`sample_around`), so that two correct junctions yield the same samples however their edges are cut, and the
samples of each pair are matched as in GEO.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from probe2road.bounds import NotNegative, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import EPSILON, Network, locate
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.sampling import Centres, Samples, sample_around
from probe2road.metrics.scores import Score, ratio
from probe2road.options import checked

__all__ = ["ItopoOptions", "Pairs", "itopo", "itopo_networks", "itopo_pairs"]


@dataclass(frozen=True)
@checked
class ItopoOptions:
    """Parameters of iTOPO; the defaults are the paper's, read as METHOD 6.5 recommends."""

    spacing: Positive[float] = 11.0  # m between samples
    radius: Positive[float] = 6.0  # m, the largest distance of a match and of a projection, inclusive
    reach: Positive[float] = 30.0  # m of network distance around a centre
    average: Literal["micro", "macro"] = "micro"  # sums over all pairs, or means of their ratios
    strict: bool = False  # precision from the proposal's nodes only, recall from the reference's only
    tie: NotNegative[float] = 0.1  # m; edges this much farther than the closest tie with it, and the direction decides
    branch: Positive[float] = 10.0  # m over which the direction of a branch is measured
    centre: Literal["projection", "node"] = "projection"  # or the other graph's nearest node, if one is within radius


@dataclass(frozen=True)
class Pairs:
    """Counts of samples around the nodes of one graph, for K pairs of a node and its projection, shape (K,) each.

    Attributes
    ----------
    node
        Row of the node in its network.
    matched, proposal, reference
        Number of matched samples, and of all samples around the node in each graph.
    """

    node: NDArray[np.int64]
    matched: NDArray[np.int64]
    proposal: NDArray[np.int64]
    reference: NDArray[np.int64]


def itopo(proposal: RoadGraph, reference: RoadGraph, *, options: ItopoOptions | None = None) -> Score:
    """Score whether the proposal's roads connect as those of the reference do.

    Both graphs are normalised first, as for `geo`. A node without an edge of the other graph within the radius
    pairs with nothing: all its samples count as wrong (proposal) or missing (reference). An empty graph scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `ItopoOptions` where None.

    Returns
    -------
    Score
        Counts are samples, summed over pairs; the numbers of nodes stand in its details. A macro precision is the
        mean over the pairs with proposal samples, a macro recall that over the pairs with reference samples.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    METHOD 6.5. Each superfluous node of the proposal whose surroundings are right adds matches, so more nodes mean
    more recall: read it beside GEO and the numbers of nodes, or set ``strict``. A junction that is off along a road
    has its projection beside the other junction, so that the samples of the roads that cross slip by as much: four
    arms shifted by (4, 4) m score 12 of 13. ``centre="node"`` pairs the two junctions themselves: 13 of 13.

    Examples
    --------
    A junction where the reference has two roads, one above the other:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> arms = [[(0, 0), (90, 0)], [(0, 0), (-90, 0)], [(0, 0), (0, 90)], [(0, 0), (0, -90)]]
    >>> proposal = graph_from_lines(arms, crs="EPSG:32616")
    >>> reference = graph_from_lines([[(-90, 0), (90, 0)], [(0, -90), (0, 90)]], crs="EPSG:32616")
    >>> score = itopo(proposal, reference)
    >>> score.matched_proposal, score.proposal, score.reference
    (39.0, 45.0, 39.0)
    """
    return itopo_networks(*comparable_networks(proposal, reference), options or ItopoOptions())


def itopo_networks(proposal: Network, reference: Network, options: ItopoOptions) -> Score:
    """Score normalised networks in the same way as `itopo`."""
    around_proposal, around_reference = itopo_pairs(proposal, reference, options=options)
    precision_pairs = [around_proposal] if options.strict else [around_proposal, around_reference]
    recall_pairs = [around_reference] if options.strict else [around_proposal, around_reference]
    proposed = np.concatenate([pairs.proposal for pairs in precision_pairs])
    proposed_matched = np.concatenate([pairs.matched for pairs in precision_pairs])
    wanted = np.concatenate([pairs.reference for pairs in recall_pairs])
    wanted_matched = np.concatenate([pairs.matched for pairs in recall_pairs])
    if options.average == "macro":
        precision, recall = _mean_ratio(proposed_matched, proposed), _mean_ratio(wanted_matched, wanted)
    else:
        precision, recall = ratio(proposed_matched.sum(), proposed.sum()), ratio(wanted_matched.sum(), wanted.sum())
    return Score(
        "itopo_strict" if options.strict else "itopo",
        precision,
        recall,
        float(proposed_matched.sum()),
        float(proposed.sum()),
        float(wanted_matched.sum()),
        float(wanted.sum()),
        asdict(options),
        {
            "proposal_nodes": len(around_proposal.node),
            "reference_nodes": len(around_reference.node),
            "proposal_km": round(proposal.km, 3),
            "reference_km": round(reference.km, 3),
        },
    )


def itopo_pairs(proposal: Network, reference: Network, options: ItopoOptions) -> tuple[Pairs, Pairs]:
    """Return the sample counts of every pair: around the proposal's nodes, and around the reference's nodes."""
    sides = []
    for network, other in ((proposal, reference), (reference, proposal)):
        nodes = np.flatnonzero((network.degree == 1) | (network.degree > 2))
        edge, offset = project_nodes(network, nodes, other, options)
        if options.centre == "node":
            edge, offset = _snap_to_nodes(network.node_xy[nodes], other, edge, offset, options.radius)
        own = sample_around(network, Centres.from_nodes(nodes), radius=options.reach, spacing=options.spacing)
        there = sample_around(
            other, Centres.from_positions(edge, offset), radius=options.reach, spacing=options.spacing
        )
        first, second = (own, there) if network is proposal else (there, own)
        matched = _match_pairs(first.first, first.xy, second.first, second.xy, options.radius + EPSILON)
        sides.append(Pairs(nodes, matched, _counts(first), _counts(second)))
    return sides[0], sides[1]


def project_nodes(
    network: Network, nodes: NDArray[np.int64], other: Network, options: ItopoOptions
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find, for each node, the closest position on another network within the radius.

    Where several edges are as close as the closest, to within ``options.tie``, the one that makes the smallest
    angle with a branch of the node is taken, then one that ends there, then the lowest: at stacked roads distance
    alone decides nothing.

    Returns
    -------
    edge, offset
        Shape (K,); the edge is -1 where there is none.
    """
    edge, offset = np.full(len(nodes), -1, np.int64), np.zeros(len(nodes))
    if len(nodes) == 0 or len(other.lines) == 0:
        return edge, offset
    points = shapely.points(network.node_xy[nodes])
    row, candidate = shapely.STRtree(other.lines).query(points, predicate="dwithin", distance=options.radius + EPSILON)
    along = shapely.line_locate_point(other.lines[candidate], points[row])
    # A line that returns to its own end would be located where it passes there first; the end is meant.
    last = shapely.distance(shapely.get_point(other.lines[candidate], -1), points[row])
    along = np.where(
        last <= shapely.distance(other.lines[candidate], points[row]) + EPSILON, other.length[candidate], along
    )
    xy, direction = locate(other, candidate, along)
    gap = np.hypot(*(xy - network.node_xy[nodes[row]]).T)
    closest = np.full(len(nodes), np.inf)
    np.minimum.at(closest, row, gap)
    tied = gap <= closest[row] + options.tie
    row, candidate, along, direction = row[tied], candidate[tied], along[tied], direction[tied]
    angle = _angle_to_branches(network, nodes[row], direction, options.branch)
    passes = np.minimum(along, other.length[candidate] - along) > EPSILON
    # Angles from cosines near 1 are only accurate to about 1e-6 degrees.
    order = np.lexsort((candidate, passes, np.round(angle, 4), row))
    kept = order[np.unique(row[order], return_index=True)[1]]
    edge[row[kept]], offset[row[kept]] = candidate[kept], along[kept]
    return edge, offset


def _snap_to_nodes(
    xy: NDArray[np.float64],
    other: Network,
    edge: NDArray[np.int64],
    offset: NDArray[np.float64],
    radius: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Move positions to the nearest junction or dead end of the other network, if one is within the radius."""
    nodes = np.flatnonzero((other.degree == 1) | (other.degree > 2))
    if len(nodes) == 0:
        return edge, offset
    gap, nearest = cKDTree(other.node_xy[nodes]).query(xy)
    node = nodes[nearest]
    at_node = other.incident_edge[other.incident_first[node]]
    near = gap <= radius + EPSILON
    start = np.where(other.u[at_node] == node, 0.0, other.length[at_node])
    return np.where(near, at_node, edge), np.where(near, start, offset)


def _angle_to_branches(
    network: Network, nodes: NDArray[np.int64], direction: NDArray[np.float64], reach: float
) -> NDArray[np.float64]:
    """Return the smallest angle between a line through each node and the node's branches, degrees, shape (K,)."""
    count = network.degree[nodes]
    owner = np.repeat(np.arange(len(nodes)), count)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    edge = network.incident_edge[network.incident_first[nodes[owner]] + place]
    cosine = np.zeros(len(nodes))
    for end, sign in ((network.u, 1.0), (network.v, -1.0)):
        here = end[edge] == nodes[owner]
        own, branch = owner[here], edge[here]
        span = np.minimum(reach, network.length[branch] / 2.0)
        target, _ = locate(network, branch, span if sign > 0 else network.length[branch] - span)
        chord = target - network.node_xy[nodes[own]]
        size = np.maximum(np.hypot(*chord.T), EPSILON)
        np.maximum.at(cosine, own, np.abs((chord * direction[own]).sum(axis=1)) / size)
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))


def _counts(samples: Samples) -> NDArray[np.int64]:
    return np.diff(samples.first)


def _mean_ratio(matched: NDArray[np.int64], total: NDArray[np.int64]) -> float:
    """Return the mean of the ratios that are defined; 0 if none is."""
    there = total > 0
    return ratio((matched[there] / total[there]).sum(), there.sum())


@njit(cache=True)
def _match_pairs(
    a_first: NDArray[np.int64],
    a_xy: NDArray[np.float64],
    b_first: NDArray[np.int64],
    b_xy: NDArray[np.float64],
    radius: float,
) -> NDArray[np.int64]:
    """Count the greedy one-to-one matches of every pair: each ``a``, in order, takes the nearest ``b`` that is free."""
    matched = np.zeros(len(a_first) - 1, np.int64)
    used = np.zeros(len(b_xy), np.bool_)
    for pair in range(len(matched)):
        for a in range(a_first[pair], a_first[pair + 1]):
            best, nearest = -1, radius
            for b in range(b_first[pair], b_first[pair + 1]):
                gap = np.hypot(a_xy[a, 0] - b_xy[b, 0], a_xy[a, 1] - b_xy[b, 1])
                if not used[b] and (gap < nearest or (best < 0 and gap <= nearest)):
                    best, nearest = b, gap
            if best >= 0:
                used[best] = True
                matched[pair] += 1
    return matched
