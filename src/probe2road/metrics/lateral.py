"""Lateral error: how far beside the reference's roads do the proposal's roads lie? In metres, not as a share."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from probe2road.bounds import Positive
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import EPSILON, Network, locate
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.projection import direction_over, project_along
from probe2road.metrics.sampling import sample_edges
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["LateralOptions", "lateral", "lateral_gaps", "lateral_networks"]


@dataclass(frozen=True)
@checked
class LateralOptions:
    """Parameters of the lateral error."""

    spacing: Positive[float] = 2.0  # m between samples
    radius: Positive[float] = 6.0  # m, the largest distance from a sample to a road of the other graph, inclusive
    max_angle: Positive[float] = 30.0  # degrees between the sample's road and the other, as undirected lines
    span: Positive[float] = 2.0  # m to either side, over which the direction of a road is measured


def lateral(proposal: RoadGraph, reference: RoadGraph, *, options: LateralOptions | None = None) -> Score:
    """Measure how far the proposal's roads lie beside those of the reference.

    Both graphs are normalised first, as for `geo`. Only samples with a road of about their direction within the
    radius have an error, so that none exceeds the radius: read the errors beside the precision, which is the share
    of the proposal that has one. Samples are not matched one to one. An empty graph scores 0 and has no error.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `LateralOptions` where None.

    Returns
    -------
    Score
        Counts are samples with a road of the other graph beside them, and all samples. The details hold
        ``median_m``, ``p95_m`` and ``rms_m`` of the errors of the proposal's samples, None where there is none.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    The distance is to the nearest position on the road, which is perpendicular to it. Beyond a road's end it is taken
    to the prolongation of the road, so that a road that is too long or too short has no error for that.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (200, 0)]], crs="EPSG:32616")
    >>> proposal = graph_from_lines([[(0, 1.5), (100, 1.5)], [(150, 0), (150, 100)]], crs="EPSG:32616")
    >>> score = lateral(proposal, reference)
    >>> score.details["median_m"], score.matched_proposal, score.proposal
    (1.5, 51.0, 102.0)
    """
    return lateral_networks(*comparable_networks(proposal, reference), options or LateralOptions())


def lateral_networks(proposal: Network, reference: Network, options: LateralOptions) -> Score:
    """Score normalised networks in the same way as `lateral`."""
    _, gap = lateral_gaps(proposal, reference, options=options)
    _, back = lateral_gaps(reference, proposal, options=options)
    error = gap[np.isfinite(gap)]
    median, p95 = np.quantile(error, [0.5, 0.95]) if len(error) else (None, None)
    rms = np.sqrt((error**2).mean()) if len(error) else None
    return Score.from_counts(
        "lateral",
        matched_proposal=len(error),
        proposal=len(gap),
        matched_reference=np.isfinite(back).sum(),
        reference=len(back),
        parameters=asdict(options),
        details={
            name: None if value is None else round(float(value), 3)
            for name, value in (("median_m", median), ("p95_m", p95), ("rms_m", rms))
        }
        | {"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
    )


def lateral_gaps(
    network: Network, other: Network, *, options: LateralOptions
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sample a network, and measure the distance of each sample to the road beside it in the other network.

    Returns
    -------
    xy, gap
        Shapes (S, 2) and (S,), metres; the gap is infinite where no road of about the same direction is near.
    """
    samples = sample_edges(network, options.spacing)
    gap = np.full(len(samples.edge), np.inf)
    edge, offset = project_along(
        samples.xy,
        direction_over(network, samples.edge, samples.offset, options.span),
        other,
        radius=options.radius,
        max_angle=options.max_angle,
        span=options.span,
    )
    found = np.flatnonzero(edge >= 0)
    edge, offset = edge[found], offset[found]
    foot, direction = locate(other, edge, offset)
    away = samples.xy[found] - foot
    beside = np.abs(away[:, 0] * direction[:, 1] - away[:, 1] * direction[:, 0])
    at_end = (offset <= EPSILON) | (offset >= other.length[edge] - EPSILON)
    gap[found] = np.where(at_end, beside, np.hypot(*away.T))
    return samples.xy, gap
