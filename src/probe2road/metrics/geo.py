"""GEO: are the roads where the reference has them? One-to-one matching of points sampled along both graphs."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.matching import Matching, candidate_pairs, match_one_to_one
from probe2road.metrics.network import Network
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.sampling import Samples, sample_edges
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["HE_BALAKRISHNAN_2022", "GeoOptions", "GeoSamples", "geo", "geo_networks", "geo_samples"]


@dataclass(frozen=True)
@checked
class GeoOptions:
    """Parameters of GEO; the defaults are the paper's."""

    spacing: Positive[float] = 11.0  # m between samples
    radius: Positive[float] = 6.0  # m, the largest distance of a match, inclusive
    matching: Matching = "greedy"  # greedy in proposal order, global (nearest pairs first) or optimal
    max_angle: NotNegative[float] | None = None  # degrees between the roads of matched samples, undirected; None: any
    phases: Positive[int] = 1  # sampling origins of the proposal to pool; 1 is the metric itself


@dataclass(frozen=True)
class GeoSamples:
    """The samples behind a score, with their places: A of the proposal, B of the reference.

    Attributes
    ----------
    proposal_xy, reference_xy
        Shapes (A, 2) and (B, 2), metres.
    proposal_matched, reference_matched
        Shapes (A,) and (B,): whether the sample has a partner on the other side. Both sum to the same number.
    """

    proposal_xy: NDArray[np.float64]
    proposal_matched: NDArray[np.bool_]
    reference_xy: NDArray[np.float64]
    reference_matched: NDArray[np.bool_]


# METHOD 6.1 (a), with the direction test of its second version. Their strict "<" makes no difference to real data.
HE_BALAKRISHNAN_2022 = GeoOptions(spacing=0.25, radius=1.0, matching="global", max_angle=60.0)


def geo(proposal: RoadGraph, reference: RoadGraph, *, options: GeoOptions | None = None) -> Score:
    """Score whether the proposal's roads lie where the reference has roads.

    Both graphs are normalised first: the proposal goes to the reference's CRS, nodes of degree 2 are merged.
    An empty graph scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `GeoOptions` where None.

    Returns
    -------
    Score
        Counts are samples.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    METHOD 6.1 (b). Along one straight edge the phase between the two sets of samples is fixed, so an edge with a
    lateral offset of 3 m to 6 m matches all or nothing; ``phases`` pools several origins to smooth that out. With
    more than one phase even identical graphs can score slightly below 1, because the phases move one of them.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> proposal = graph_from_lines([[(0, 0), (6, 0)]], crs="EPSG:32616")
    >>> reference = graph_from_lines([[(0, 0), (6, 0), (12, 0)]], crs="EPSG:32616")
    >>> print(geo(proposal, reference))
    geo P 1.000 R 0.667 F1 0.800 (spacing=11.0, radius=6.0, matching=greedy, max_angle=None, phases=1)
    """
    return geo_networks(*comparable_networks(proposal, reference), options or GeoOptions())


def geo_networks(proposal: Network, reference: Network, options: GeoOptions) -> Score:
    """Score normalised networks in the same way as `geo`."""
    targets = sample_edges(reference, options.spacing)
    matched = proposed = 0
    for phase in range(options.phases):
        shift = options.spacing * (1.0 - phase / options.phases)
        samples = _match_samples(sample_edges(proposal, options.spacing, shift=shift), targets, options)
        matched += int(samples.proposal_matched.sum())
        proposed += len(samples.proposal_matched)
    return Score.from_counts(
        "geo",
        matched_proposal=matched,
        proposal=proposed,
        matched_reference=matched,
        reference=len(targets.edge) * options.phases,
        parameters=asdict(options),
        details={"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
    )


def geo_samples(proposal: Network, reference: Network, options: GeoOptions) -> GeoSamples:
    """Return the positions of the samples of normalised networks, and which matched, for maps and resampling.

    Only the first sampling origin is taken, whatever ``options.phases``: with one phase the sums over the samples
    are the counts of `geo_networks`. An empty network has no samples.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> sides = [graph_from_lines([[(0, 0), (end, 0)]], crs="EPSG:32616") for end in (6, 12)]
    >>> samples = geo_samples(*comparable_networks(*sides), GeoOptions())
    >>> samples.reference_xy[:, 0].tolist(), samples.reference_matched.tolist()
    ([0.0, 11.0, 12.0], [True, True, False])
    """
    return _match_samples(sample_edges(proposal, options.spacing), sample_edges(reference, options.spacing), options)


def _match_samples(samples: Samples, targets: Samples, options: GeoOptions) -> GeoSamples:
    """Match the samples for one sampling origin."""
    pairs = candidate_pairs(
        samples.xy,
        targets.xy,
        radius=options.radius,
        a_direction=samples.direction,
        b_direction=targets.direction,
        max_angle=options.max_angle,
    )
    partner = match_one_to_one(pairs, (len(samples.edge), len(targets.edge)), how=options.matching)
    taken = np.zeros(len(targets.edge), np.bool_)
    taken[partner[partner >= 0]] = True
    return GeoSamples(samples.xy, partner >= 0, targets.xy, taken)
