"""The order of roads at places where they cross without meeting: which passes over which."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph

__all__ = ["CLEARANCE", "crossing_layers", "heights_at"]

CLEARANCE = 2.5  # m between the heights of two roads, from which on one passes over the other
_ROUNDS = 10  # layers are as many at most; roads that pass over each other in turns would never come to an end


def crossing_layers(graph: RoadGraph) -> NDArray[np.int64]:
    """Return the layer of every edge, as OpenStreetMap counts them: 0, and one more than whatever it passes over.

    Two edges that cross in plan without sharing a node are compared at the height that each has there. Edges without
    heights, and crossings where the heights differ by less than 2.5 m, say nothing.

    Parameters
    ----------
    graph
        In a metric CRS.

    Returns
    -------
    ndarray of int, shape (E,)
        0 for an edge that passes over nothing.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> road, bridge = [(0, 0, 2), (100, 0, 2)], [(50, -50, 8), (50, 50, 8)]
    >>> crossing_layers(graph_from_lines([road, bridge], crs="EPSG:32616")).tolist()
    [0, 1]
    """
    lines = graph.edges.geometry.to_numpy()
    lower, upper = _passings(lines[has_z := np.flatnonzero(shapely.has_z(lines))])
    lower, upper = has_z[lower], has_z[upper]
    layer = np.zeros(len(lines), np.int64)
    for _ in range(_ROUNDS):
        before = layer.copy()
        np.maximum.at(layer, upper, before[lower] + 1)
        if np.array_equal(layer, before):
            break
    return layer


def _passings(lines: NDArray[np.object_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the positions of the lower and of the upper line of every crossing that heights decide."""
    first, second = shapely.STRtree(lines).query(lines, predicate="crosses")
    first, second = first[first < second], second[first < second]
    points, pair = shapely.get_coordinates(
        shapely.force_2d(shapely.intersection(lines[first], lines[second])), return_index=True
    )
    places = shapely.points(points)
    first, second = first[pair], second[pair]
    above = heights_at(lines[first], places) - heights_at(lines[second], places)
    decided = np.abs(above) >= CLEARANCE
    first, second, above = first[decided], second[decided], above[decided]
    return np.where(above > 0, second, first), np.where(above > 0, first, second)


def heights_at(lines: NDArray[np.object_], places: NDArray[np.object_]) -> NDArray[np.float64]:
    """Return the height of each line at a place on it, metres, shape (n,); NaN where it has none.

    Examples
    --------
    >>> ramp = np.array([shapely.LineString([(0, 0, 2), (100, 0, 8)])])
    >>> heights_at(ramp, shapely.points([[50.0, 0.0]])).tolist()
    [5.0]
    """
    on_line = shapely.line_interpolate_point(lines, shapely.line_locate_point(lines, places))
    return shapely.get_z(on_line)
