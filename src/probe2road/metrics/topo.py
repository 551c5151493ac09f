"""TOPO: does a drive from the same place reach the same places? With holes and marbles, in metres.

Strategy. From starts spread along the reference, and their partners on the proposal, marbles are dropped at
regular network distances on both graphs (`sample_around`) and matched one to one. All starts of a batch form one
bipartite graph without edges between starts, so that one call of Hopcroft and Karp's algorithm serves them all.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.bounds import AtLeast, Below, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.matching import match_one_to_one
from probe2road.metrics.network import EPSILON, Network
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.projection import project_along
from probe2road.metrics.sampling import Centres, Samples, component_roots, sample_around
from probe2road.metrics.scores import Score, ratio
from probe2road.options import checked

__all__ = ["TopoOptions", "topo", "topo_networks"]

_BATCH = 512  # starts that are matched together; limits memory


@dataclass(frozen=True)
@checked
class TopoOptions:
    """Parameters of TOPO; the defaults are Sat2Graph's, in metres."""

    start_spacing: Positive[float] = 50.0  # m of network distance between starts on the reference
    start_radius: Positive[float] = 11.0  # m from a start to its partner on the proposal
    start_angle: Positive[float] = 15.0  # degrees between the roads of a start and its partner, as undirected lines
    reach: Positive[float] = 300.0  # m of network distance that is explored
    spacing: Positive[float] = 5.5  # m of network distance between marbles
    radius: Positive[float] = 11.0  # m, the largest distance of a match
    max_angle: Positive[float] = 45.0  # degrees between the roads of two matched marbles, as undirected lines
    margin: Annotated[float, AtLeast(0), Below(0.5)] = 0.0  # share at each side without starts; Sat2Graph has 0.07


def topo(proposal: RoadGraph, reference: RoadGraph, *, options: TopoOptions | None = None) -> Score:
    """Score whether the same places can be reached from the same starts.

    Both graphs are normalised first, as for `geo`. An empty graph scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `TopoOptions` where None.

    Returns
    -------
    Score
        Precision and recall are means over the starts that have a partner, recall multiplied by the share of such
        starts; counts are marbles. Both numbers of starts stand in the details.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    METHOD 6.2. Graphs are taken as undirected. Starts lie at multiples of their spacing from one root in each
    connected component. A start's partner is the nearest proposal edge among those of about its direction.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (1000, 0)]], crs="EPSG:32616")
    >>> proposal = graph_from_lines([[(0, 2), (500, 2)]], crs="EPSG:32616")
    >>> score = topo(proposal, reference)
    >>> round(score.precision, 3), round(score.recall, 3), score.details["starts"], score.details["matched_starts"]
    (1.0, 0.441, 21, 11)
    """
    return topo_networks(*comparable_networks(proposal, reference), options or TopoOptions())


def topo_networks(proposal: Network, reference: Network, options: TopoOptions) -> Score:
    """Score normalised networks in the same way as `topo`."""
    starts = _starts(reference, options)
    edge, offset = project_along(
        starts.xy, starts.direction, proposal, radius=options.start_radius, max_angle=options.start_angle
    )
    paired = np.flatnonzero(edge >= 0)
    matched, proposed, wanted = (np.zeros(len(paired), np.int64) for _ in range(3))
    for begin in range(0, len(paired), _BATCH):
        batch = slice(begin, begin + _BATCH)
        own = paired[batch]
        marbles, holes = (
            sample_around(network, centres, radius=options.reach, spacing=options.spacing, ends=False)
            for network, centres in (
                (proposal, Centres.from_positions(edge[own], offset[own])),
                (reference, Centres.from_positions(starts.edge[own], starts.offset[own])),
            )
        )
        matched[batch] = _matched_marbles(marbles, holes, options)
        proposed[batch], wanted[batch] = np.diff(marbles.first), np.diff(holes.first)
    precision = ratio((matched / np.maximum(proposed, 1)).sum(), len(paired))
    recall = ratio((matched / np.maximum(wanted, 1)).sum(), len(starts.edge))
    return Score(
        "topo",
        precision,
        recall,
        float(matched.sum()),
        float(proposed.sum()),
        float(matched.sum()),
        float(wanted.sum()),
        asdict(options),
        {
            "starts": len(starts.edge),
            "matched_starts": len(paired),
            "proposal_km": round(proposal.km, 3),
            "reference_km": round(reference.km, 3),
        },
    )


def _starts(reference: Network, options: TopoOptions) -> Samples:
    """Distribute starts over the reference, at multiples of the spacing from the root of each component."""
    roots = Centres.from_nodes(component_roots(reference))
    starts = sample_around(reference, roots, radius=np.inf, spacing=options.start_spacing, ends=False)
    if len(starts.edge) == 0:
        return starts
    low, high = reference.xy.min(axis=0), reference.xy.max(axis=0)
    border = options.margin * (high - low)
    kept = ((starts.xy >= low + border) & (starts.xy <= high - border)).all(axis=1)
    return Samples(
        np.array([0, kept.sum()]), starts.edge[kept], starts.offset[kept], starts.xy[kept], starts.direction[kept]
    )


def _matched_marbles(marbles: Samples, holes: Samples, options: TopoOptions) -> NDArray[np.int64]:
    """Count the matches of each start: the largest number of one-to-one pairs of a marble and a hole."""
    orders = [
        np.lexsort((s.xy[:, 0], np.repeat(np.arange(len(s.first) - 1), np.diff(s.first)))) for s in (marbles, holes)
    ]
    a, b = _pairs_of_starts(
        marbles.first, marbles.xy[orders[0]], marbles.direction[orders[0]],
        holes.first, holes.xy[orders[1]], holes.direction[orders[1]],
        options.radius + EPSILON, np.cos(np.radians(options.max_angle)) - 1e-9,
    )  # fmt: skip
    partner = match_one_to_one((a, b, np.zeros(len(a))), (len(marbles.edge), len(holes.edge)), how="optimal")
    total = np.concatenate([[0], np.cumsum(partner >= 0)])
    return total[marbles.first[1:]] - total[marbles.first[:-1]]


@njit(cache=True)
def _pairs_of_starts(
    a_first: NDArray[np.int64],
    a_xy: NDArray[np.float64],
    a_direction: NDArray[np.float64],
    b_first: NDArray[np.int64],
    b_xy: NDArray[np.float64],
    b_direction: NDArray[np.float64],
    radius: float,
    cosine: float,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """List the near pairs of points of the same start along one line; the points of a start are sorted by x."""
    a_of_pair, b_of_pair = [0 for _ in range(0)], [0 for _ in range(0)]
    for start in range(len(a_first) - 1):
        low = b_first[start]
        for a in range(a_first[start], a_first[start + 1]):
            while low < b_first[start + 1] and b_xy[low, 0] < a_xy[a, 0] - radius:
                low += 1
            for b in range(low, b_first[start + 1]):
                if b_xy[b, 0] > a_xy[a, 0] + radius:
                    break
                if np.hypot(a_xy[a, 0] - b_xy[b, 0], a_xy[a, 1] - b_xy[b, 1]) > radius:
                    continue
                dot = a_direction[a, 0] * b_direction[b, 0] + a_direction[a, 1] * b_direction[b, 1]
                if abs(dot) >= cosine:
                    a_of_pair.append(a)
                    b_of_pair.append(b)
    return np.array(a_of_pair, np.int64), np.array(b_of_pair, np.int64)
