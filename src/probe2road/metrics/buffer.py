"""Buffer GEO: which share of each graph lies near the other? It needs no matching, and so ignores duplicate roads."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.bounds import NotEmpty, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import Network
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["BufferGeoOptions", "buffer_geo", "buffer_geo_networks"]


@dataclass(frozen=True)
@checked
class BufferGeoOptions:
    """Parameters of buffer GEO; the defaults are those of Tang et al."""

    radii: Annotated[tuple[Positive[float], ...], NotEmpty()] = (5.0, 10.0, 15.0, 20.0)  # m, one score each
    spacing: Positive[float] = 1.0  # m, the longest stretch that one sample stands for


def buffer_geo(proposal: RoadGraph, reference: RoadGraph, *, options: BufferGeoOptions | None = None) -> list[Score]:
    """Score which share of each graph's length lies within a distance of the other graph.

    A segment that is drawn twice, in either direction, counts once; roads drawn twice side by side count twice and
    cost nothing, so read the lengths in the details beside the score. An empty graph scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `BufferGeoOptions` where None.

    Returns
    -------
    list of Score
        One for each radius; counts are metres.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    Tang et al. 2019, ISPRS International Journal of Geo-Information 8:411. Each segment is cut into equal parts of
    at most ``spacing``, and the middle of a part decides for the whole part.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (0, 0)]], crs="EPSG:32616")
    >>> proposal = graph_from_lines([[(0, 7), (50, 7)]], crs="EPSG:32616")
    >>> [(score.precision, score.recall, score.reference) for score in buffer_geo(proposal, reference)][:2]
    [(0.0, 0.0, 100.0), (1.0, 0.57, 100.0)]
    """
    return buffer_geo_networks(*comparable_networks(proposal, reference), options or BufferGeoOptions())


def buffer_geo_networks(proposal: Network, reference: Network, options: BufferGeoOptions) -> list[Score]:
    """Score normalised networks in the same way as `buffer_geo`."""
    segments = [_distinct_segments(network) for network in (proposal, reference)]
    lengths = [np.hypot(*(part[:, 1] - part[:, 0]).T) for part in segments]
    totals = [float(length.sum()) for length in lengths]
    gaps, weights = [], []
    for own, other in ((0, 1), (1, 0)):
        xy, weight = _middles(segments[own], lengths[own], options.spacing)
        gaps.append(_distance(xy, segments[other], max(options.radii)))
        weights.append(weight)
    scores = []
    for radius in options.radii:
        near = [
            min(float(weight[gap <= radius].sum()), total)  # by rounding, the sum of parts can exceed the total
            for gap, weight, total in zip(gaps, weights, totals, strict=True)
        ]
        score = Score.from_counts(
            "buffer_geo",
            matched_proposal=near[0],
            proposal=totals[0],
            matched_reference=near[1],
            reference=totals[1],
            parameters={"radius": radius, "spacing": options.spacing},
            details={"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
        )
        scores.append(score)
    return scores


def _distinct_segments(network: Network) -> NDArray[np.float64]:
    """Return the straight segments of all edges without duplicates in either direction, shape (n, 2 ends, 2)."""
    pieces = np.stack([network.xy[:-1], network.xy[1:]], axis=1) if len(network.xy) else np.empty((0, 2, 2))
    inner = np.ones(len(pieces), bool)
    inner[network.first[1:-1] - 1] = False  # from the end of an edge to the start of the next
    pieces = pieces[inner & (pieces[:, 0] != pieces[:, 1]).any(axis=1)]
    backward = (pieces[:, 0, 0] > pieces[:, 1, 0]) | (
        (pieces[:, 0, 0] == pieces[:, 1, 0]) & (pieces[:, 0, 1] > pieces[:, 1, 1])
    )
    pieces[backward] = pieces[backward, ::-1]
    return np.unique(pieces, axis=0)


def _middles(
    segments: NDArray[np.float64], length: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cut segments into equal parts; return the midpoints of the parts, shape (S, 2), and their lengths, shape (S,)."""
    count = np.ceil(length / spacing).astype(np.int64)
    owner = np.repeat(np.arange(len(count)), count)
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    share = ((rank + 0.5) / count[owner])[:, None]
    return segments[owner, 0] * (1.0 - share) + segments[owner, 1] * share, (length / np.maximum(count, 1))[owner]


def _distance(xy: NDArray[np.float64], segments: NDArray[np.float64], limit: float) -> NDArray[np.float64]:
    """Return the distance from points to the nearest segment, shape (S,); infinity beyond the limit."""
    gap = np.full(len(xy), np.inf)
    if len(xy) == 0 or len(segments) == 0:
        return gap
    tree = shapely.STRtree(shapely.linestrings(segments))
    (row, _), distance = tree.query_nearest(
        shapely.points(xy), max_distance=limit * 1.001, return_distance=True, all_matches=False
    )
    gap[row] = distance
    return gap
