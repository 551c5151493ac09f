"""Projection of points of one graph on the other: on the nearest edge along the same line."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.metrics.network import EPSILON, Network, locate

__all__ = ["direction_over", "project_along"]


def project_along(
    xy: NDArray[np.float64],
    direction: NDArray[np.float64],
    network: Network,
    *,
    radius: float,
    max_angle: float,
    span: float = 0.0,
    sense: NDArray[np.int64] | None = None,
    against: float = 0.0,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find the nearest edge in each point's direction, and the position on it to which the point projects.

    Each edge within the radius is represented by its position nearest to the point; those that run across the
    direction there are left out. Among equally near edges the lowest is taken.

    Parameters
    ----------
    xy, direction
        Points and unit directions, shape (S, 2).
    network
        Where to look.
    radius
        Largest distance, inclusive, metres.
    max_angle
        Largest angle between the directions as undirected lines, degrees.
    span
        Metres to either side over which the direction of an edge is taken; 0 for the segment alone.
    sense
        Shape (E,): which way the edges may be driven, 1 along their line, -1 against it, 0 both ways. Then the
        directions of the points are driving directions.
    against
        Metres that are added to the distance of an edge which may only be driven the other way. An edge beside it that
        may be driven takes its place, if it is that little farther; within the radius, both are.

    Returns
    -------
    edge, offset
        Shape (S,): the row of the edge, -1 where there is none, and the distance from its start, metres.

    Examples
    --------
    The edge across is nearer, but runs the other way:

    >>> from probe2road.metrics.network import network_from_graph
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(20, -50), (20, 50)], [(0, 3), (50, 3)]], crs="EPSG:32616"))
    >>> point, east = np.array([[19.0, 0.0]]), np.array([[1.0, 0.0]])
    >>> [part.tolist() for part in project_along(point, east, network, radius=6.0, max_angle=30.0)]
    [[1], [19.0]]

    Of two carriageways, the nearer one is driven the other way:

    >>> network = network_from_graph(graph_from_lines([[(50, 2), (0, 2)], [(0, -5), (50, -5)]], crs="EPSG:32616"))
    >>> ways = {"sense": np.array([1, 1]), "against": 8.0}
    >>> project_along(point, east, network, radius=10.0, max_angle=30.0, **ways)[0].tolist()
    [1]
    """
    edge, offset = np.full(len(xy), -1, np.int64), np.zeros(len(xy))
    if len(xy) == 0 or len(network.lines) == 0:
        return edge, offset
    points = shapely.points(xy)
    row, candidate = shapely.STRtree(network.lines).query(points, predicate="dwithin", distance=radius + EPSILON)
    along = shapely.line_locate_point(network.lines[candidate], points[row])
    cosine = (direction_over(network, candidate, along, span) * direction[row]).sum(axis=1)
    aligned = np.abs(cosine) >= np.cos(np.radians(max_angle)) - 1e-9
    row, candidate, along, cosine = row[aligned], candidate[aligned], along[aligned], cosine[aligned]
    gap = np.round(np.hypot(*(locate(network, candidate, along)[0] - xy[row]).T), 6)
    if sense is not None:
        gap += against * (sense[candidate] * cosine < 0)
    order = np.lexsort((candidate, gap, row))
    kept = order[np.unique(row[order], return_index=True)[1]]
    edge[row[kept]], offset[row[kept]] = candidate[kept], along[kept]
    return edge, offset


def direction_over(
    network: Network, edge: NDArray[np.int64], offset: NDArray[np.float64], span: float
) -> NDArray[np.float64]:
    """Return the unit direction of edges at positions, over ``span`` metres before and after, shape (S, 2).

    Traced lines have steps of a pixel, so that a segment says little about where its road leads. The chord is shorter
    at the ends of an edge. A span of 0 gives the direction of the segment; a chord that closes has direction 0.

    Examples
    --------
    >>> from probe2road.metrics.network import network_from_graph
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = network_from_graph(graph_from_lines([[(0, 0), (4, 0), (4, 4)]], crs="EPSG:32616"))
    >>> place = np.array([0]), np.array([4.0])
    >>> direction_over(network, *place, 0.0).tolist(), direction_over(network, *place, 2.0).round(3).tolist()
    ([[1.0, 0.0]], [[0.707, 0.707]])
    """
    if span == 0.0:
        return locate(network, edge, offset)[1]
    chord = locate(network, edge, offset + span)[0] - locate(network, edge, offset - span)[0]
    return chord / np.maximum(np.hypot(*chord.T), EPSILON)[:, None]
