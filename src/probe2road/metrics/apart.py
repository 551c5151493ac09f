"""Roads kept apart: whether two roads that run close beside each other are two in the other graph, too."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.bounds import Positive
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.network import Network, locate
from probe2road.metrics.normalise import comparable_networks
from probe2road.metrics.projection import direction_over
from probe2road.metrics.sampling import sample_edges
from probe2road.metrics.scores import Score
from probe2road.options import checked

__all__ = ["ApartOptions", "apart", "apart_networks"]


@dataclass(frozen=True)
@checked
class ApartOptions:
    """Parameters of the score of roads kept apart."""

    least: Positive[float] = 6.0  # m between two roads, from which the places between them count
    most: Positive[float] = 9.0  # m between two roads, up to which they count
    spacing: Positive[float] = 11.0  # m between places along a road
    max_angle: Positive[float] = 30.0  # degrees between roads that run beside each other, as undirected lines
    span: Positive[float] = 2.0  # m to either side, over which the direction of a road is measured

    def __post_init__(self) -> None:
        """Refuse a range with nothing in it."""
        if self.least >= self.most:
            fault = f"least is {self.least:g} and most is {self.most:g}"
            raise OptionError(fault, where="ApartOptions", fix="use least < most")


def apart(proposal: RoadGraph, reference: RoadGraph, *, options: ApartOptions | None = None) -> Score:
    """Score whether roads that run close beside each other are two roads in the other graph, too.

    A place is a sample of a road and the next road to its left or right, at a distance in the range of the options.
    It is kept apart if a section across both meets two roads of the other graph, one nearer to either road than half
    of the least distance. Recall is the share of the reference's places that the proposal keeps apart. Precision is
    the share of the proposal's places that the reference has too. A graph without such places scores 0.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS.
    options
        The parameters; `ApartOptions` where None.

    Returns
    -------
    Score
        Counts are places.

    Raises
    ------
    CRSError
        If a graph is not in metres.

    Notes
    -----
    Our own. Both graphs are normalised first, as for `probe2road.metrics.geo.geo`. A place counts from either road.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> two = graph_from_lines([[(0, 0), (110, 0)], [(0, 8), (110, 8)]], crs="EPSG:32616")
    >>> one = graph_from_lines([[(0, 4), (110, 4)]], crs="EPSG:32616")
    >>> score = apart(two, two)
    >>> score.reference, score.recall, apart(one, two).recall
    (18.0, 1.0, 0.0)
    """
    return apart_networks(*comparable_networks(proposal, reference), options or ApartOptions())


def apart_networks(proposal: Network, reference: Network, options: ApartOptions) -> Score:
    """Score normalised networks in the same way as `apart`."""
    (kept, places), (back, proposed) = (
        _kept(one, other, options) for one, other in ((reference, proposal), (proposal, reference))
    )
    return Score.from_counts(
        "apart",
        matched_proposal=back,
        proposal=proposed,
        matched_reference=kept,
        reference=places,
        parameters=asdict(options),
        details={"proposal_km": round(proposal.km, 3), "reference_km": round(reference.km, 3)},
    )


def _kept(network: Network, other: Network, options: ApartOptions) -> tuple[int, int]:
    """Count the places of a network that the other keeps apart, and all its places."""
    start, ahead, left = _sections(network, options)
    reach, half = options.most, options.least / 2.0
    # The next road on the section of a place; the road of the place itself lies at 0.
    section, offset = _crossings(network, start, ahead, left, (half, reach), options)
    gap = np.full(len(start), np.inf)
    np.minimum.at(gap, section, offset)
    places = np.flatnonzero((gap >= options.least) & (gap < options.most))
    start, ahead, left, gap = start[places], ahead[places], left[places], gap[places]
    section, offset = _crossings(other, start, ahead, left, (-half, reach + half), options)
    near, far = (np.zeros(len(places), bool) for _ in range(2))
    near[section[np.abs(offset) <= half]] = True
    far[section[np.abs(offset - gap[section]) <= half]] = True
    return int((near & far).sum()), len(places)


def _sections(network: Network, options: ApartOptions) -> tuple[NDArray[np.float64], ...]:
    """Return places, the direction of their road, and the direction of a section to its left or right, each (S, 2)."""
    samples = sample_edges(network, options.spacing)
    inner = (samples.offset > 0) & (samples.offset < network.length[samples.edge])  # at an end, roads meet
    edge, offset = samples.edge[inner], samples.offset[inner]
    place, _ = locate(network, edge, offset)
    ahead = direction_over(network, edge, offset, options.span)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    return np.tile(place, (2, 1)), np.tile(ahead, (2, 1)), np.concatenate([left, -left])


def _crossings(
    network: Network,
    start: NDArray[np.float64],
    ahead: NDArray[np.float64],
    aside: NDArray[np.float64],
    between: tuple[float, float],
    options: ApartOptions,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return where roads of about the direction ahead cross sections: rows of sections, and distances along them."""
    ends = np.stack([start + bound * aside for bound in between], axis=1)
    sections = shapely.linestrings(ends)
    section, edge = shapely.STRtree(network.lines).query(sections, predicate="intersects")
    points, row = shapely.get_parts(shapely.intersection(sections[section], network.lines[edge]), return_index=True)
    section, edge, at = section[row], edge[row], shapely.get_coordinates(shapely.centroid(points))
    along = shapely.line_locate_point(network.lines[edge], shapely.points(at))
    cosine = np.abs((direction_over(network, edge, along, options.span) * ahead[section]).sum(axis=1))
    alike = cosine >= np.cos(np.radians(options.max_angle))
    offset = ((at - start[section]) * aside[section]).sum(axis=1)
    return section[alike], offset[alike]
