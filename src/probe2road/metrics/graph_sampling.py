"""Graph sampling: one exploration of each whole component, with samples matched one to one and by bearing."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated

import numpy as np

from probe2road.bounds import NotEmpty, Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.matching import Matching, candidate_pairs, match_one_to_one
from probe2road.metrics.network import Network
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.sampling import Centres, Samples, component_roots, sample_around
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["GraphSamplingOptions", "graph_sampling", "graph_sampling_networks"]


@dataclass(frozen=True)
@checked
class GraphSamplingOptions:
    """Parameters of graph sampling."""

    radii: Annotated[tuple[Positive[float], ...], NotEmpty()] = (5.0, 10.0, 15.0)  # m, one score each
    spacing: Positive[float] = 5.0  # m of network distance between samples
    max_angle: Positive[float] = 45.0  # degrees between the roads of matched samples, as undirected lines
    matching: Matching = "greedy"  # in proposal order; global or optimal as in `match_one_to_one`


def graph_sampling(
    proposal: RoadGraph, reference: RoadGraph, *, options: GraphSamplingOptions | None = None
) -> list[Score]:
    """Score the matched samples of both graphs at several distances.

    From the lowest node of every connected component samples are laid every ``spacing`` metres of network
    distance through the whole component. An empty graph scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `GraphSamplingOptions` where None.

    Returns
    -------
    list of Score
        One for each radius; counts are samples.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    The family of Biagioni and Eriksson's holes and marbles, as Aguilar et al. and Hosseini Sereshgi and Wenk use it
    on the sets of mapconstruction.org. One-to-one: a method that draws both directions of a road loses precision.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> proposal = graph_from_lines([[(0, 7), (50, 7)]], crs="EPSG:32616")
    >>> [(score.precision, round(score.recall, 3)) for score in graph_sampling(proposal, reference)]
    [(0.0, 0.0), (1.0, 0.524), (1.0, 0.524)]
    """
    return graph_sampling_networks(*comparable_networks(proposal, reference), options or GraphSamplingOptions())


def graph_sampling_networks(proposal: Network, reference: Network, options: GraphSamplingOptions) -> list[Score]:
    """Score normalised networks in the same way as `graph_sampling`."""
    samples, targets = _explore(proposal, options), _explore(reference, options)
    scores = []
    for radius in options.radii:
        pairs = candidate_pairs(
            samples.xy,
            targets.xy,
            radius=radius,
            a_direction=samples.direction,
            b_direction=targets.direction,
            max_angle=options.max_angle,
        )
        partner = match_one_to_one(pairs, (len(samples.edge), len(targets.edge)), how=options.matching)
        matched = int(np.count_nonzero(partner >= 0))
        parameters = {"radius": radius} | {name: value for name, value in asdict(options).items() if name != "radii"}
        score = Score.from_counts(
            "graph_sampling",
            matched_proposal=matched,
            proposal=len(samples.edge),
            matched_reference=matched,
            reference=len(targets.edge),
            parameters=parameters,
            details={"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
        )
        scores.append(score)
    return scores


def _explore(network: Network, options: GraphSamplingOptions) -> Samples:
    roots = Centres.from_nodes(component_roots(network))
    return sample_around(network, roots, radius=np.inf, spacing=options.spacing, ends=False)
